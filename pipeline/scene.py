"""Reading posed scenes: a Phototourism download, or any COLMAP model beside its photos; with depth bounds.

A scene folder holds photos (`dense/images` or `images`), a COLMAP model, text or binary (`sparse`,
`sparse/0`, the same under `dense`, or the folder itself), and perhaps a NeRF-W split table (`*.tsv`).
Undistorted pinhole cameras only.

Notation: "COLMAP units" are the model's own lengths, "scene units" are COLMAP units / `Scene.scale`. Cameras
are OpenCV camera-to-world, (3, 4). A photo's near and far are the 0.1 and 99.9 percentiles of the depth z of
*all* points in front of it, and the scale makes the largest far of the scene 5, both as in the released code
of CR-NeRF.
"""

from __future__ import annotations

import csv
import hashlib
import json
import logging
import re
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.colmap import import_pycolmap
from pipeline.errors import CrossrayError
from pipeline.files import resolved, sha256_of

SPLITS = ("train", "val", "test")
MODEL_FILES = ("cameras", "images", "points3D")
POSES = ("frames", "rigs")  # newer models have their poses in these
# Models whose parameters beyond focal lengths and centre are a distortion that vanishes at 0.
PINHOLE_AT_ZERO = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
FAR = 5.0  # the largest far bound of a scene, in scene units

log = logging.getLogger("crossray")


class SceneError(CrossrayError):
    """A scene folder that cannot be read as it is."""


@dataclass(frozen=True)
class ScenePhoto:
    """One photo with its camera. Sizes and intrinsics are those of the photo at full size."""

    name: str  # file name under the images folder, as in the COLMAP model
    key: str  # unique, [a-z0-9_-] only; keys sort as photos do
    image_id: int  # COLMAP's
    split: str  # "train", "val" or "test"
    path: Path
    width: int
    height: int
    intrinsics: tuple[float, float, float, float]  # fx, fy, cx, cy in pixels
    c2w: np.ndarray  # (3, 4) float32, OpenCV camera-to-world, translation in scene units
    near: float  # scene units
    far: float  # scene units


@dataclass(frozen=True)
class Scene:
    """A posed scene: its photos sorted by name, in scene units."""

    name: str
    root: Path
    photos: tuple[ScenePhoto, ...]
    scale: float  # COLMAP units per scene unit
    box: np.ndarray  # (2, 3) float32: 1st and 99th percentile of the points on each axis, scene units
    num_points: int
    dropped: dict[str, str] = field(default_factory=dict)
    """Photos that were left out because their files cannot be used -> the reason."""


def read_scene(
    root: Path, name: str | None = None, *, without: Mapping[str, str] | None = None, drop_missing: bool = False
) -> Scene:
    """Read the scene in the folder `root`; `name` is by default that of its tsv, else of the folder.

    Photos that the split table lists and the model lacks are left out with a warning. Without a table, every
    eighth photo in name order, from the first on, is a test photo.

    Args:
        without: photos to leave out, as if the split table did not list them -> the reason.
        drop_missing: leave out photos whose file is missing, too.

    Raises:
        SceneError: no model, no photos, two photos of one name, a camera that is not an undistorted pinhole, a
            degenerate model (`check_model`), several split tables, or a photo whose file is missing.
    """
    root = resolved(root)
    if not root.is_dir():
        raise SceneError(f"{root}: no such folder; a scene is a folder with photos and a COLMAP model")
    folder, model = find_model(root)
    table = find_table(root)
    by_name = images_by_name(model, folder)
    if not by_name:
        raise SceneError(f"{folder}: the COLMAP model has no registered photo")
    splits = read_splits(table, by_name) if table else hold_out(by_name)
    if not splits:
        raise SceneError(f"{root}: no photo is left; {table} names none that the model in {folder} has")
    dropped = {n: reason for n, reason in (without or {}).items() if n in splits}
    kept = left_over(root, splits, dropped)
    check_model(model, [by_name[n] for n in kept])
    photo_folder = find_photo_folder(root, folder)
    missing = [n for n in kept if not is_photo(photo_folder, n)]
    if missing and not drop_missing:
        outside = is_file(photo_folder / missing[0]) and ", for it is a link that leads out of it"
        raise SceneError(
            f"photo {missing[0]} of the model in {folder} is not in {photo_folder}{outside or ''}; put it there, take "
            "it out of the split table, or let scene.on_bad_photo: drop leave it out"
        )
    dropped |= {n: f"photo {n} is missing" for n in missing}
    images = [by_name[n] for n in left_over(root, splits, dropped)]
    check_undistorted(root, model, images, folder, photo_folder)
    scene = pose_photos(root, name or (table.stem if table else root.name), model, images, splits, photo_folder)
    return replace(scene, dropped=dropped)


def images_by_name(model: Any, folder: Path) -> dict[str, Any]:
    """Photo name -> registered image of a `pycolmap.Reconstruction`.

    Raises:
        SceneError: two have one name.
    """
    found: dict[str, Any] = {}
    for image in (model.images[i] for i in model.reg_image_ids()):
        if found.setdefault(image.name, image) is not image:
            raise SceneError(
                f"{folder}: images {found[image.name].image_id} and {image.image_id} are both named {image.name}; "
                "which camera is the photo's? reconstruct again, or take one out of the model"
            )
    return found


def left_over(root: Path, splits: dict[str, str], dropped: dict[str, str]) -> list[str]:
    """Names of the photos that are not dropped, sorted.

    Raises:
        SceneError: none of them is for training.
    """
    kept = sorted(splits.keys() - dropped)
    if not any(splits[n] == "train" for n in kept):
        first = next(iter(dropped.values()), "")
        left = f", {len(dropped)} were left out, as their files cannot be used ({first})" if dropped else ""
        raise SceneError(
            f"{root}: no training photo among the {len(kept)} posed ones{left}; give some the split 'train'"
        )
    return kept


def pose_photos(
    root: Path, name: str, model: Any, images: list[Any], splits: dict[str, str], photo_folder: Path
) -> Scene:
    """The scene in scene units, from the model in COLMAP units."""
    points = np.stack([p.xyz for p in model.points3D.values()])
    poses = [image.cam_from_world().matrix() for image in images]
    bounds, scale, box = measure(points, poses, [image.name for image in images])
    photos = []
    for i, (image, w2c, (near, far)) in enumerate(zip(images, poses, bounds, strict=True)):
        camera = model.cameras[image.camera_id]
        photos.append(
            ScenePhoto(
                name=image.name,
                key=photo_key(i, image.name),
                image_id=int(image.image_id),
                split=splits[image.name],
                path=photo_folder / image.name,
                width=int(camera.width),
                height=int(camera.height),
                intrinsics=pinhole(camera),
                c2w=camera_to_world(w2c, scale),
                near=near / scale,
                far=far / scale,
            )
        )
    return Scene(name, root, tuple(photos), scale, box, len(points))


def measure(
    points: np.ndarray, poses: list[np.ndarray], names: list[str]
) -> tuple[list[tuple[float, float]], float, np.ndarray]:
    """Depth bounds of every photo in COLMAP units, COLMAP units per scene unit, and the box of the points in scene
    units, from `points` (P, 3) and world-to-camera `poses` (3, 4) in COLMAP units.

    Raises:
        SceneError: as `depth_bounds`, or sizes that float32 cannot hold.
    """
    bounds = [depth_bounds(points, w2c, name) for w2c, name in zip(poses, names, strict=True)]
    scale = float(np.float32(max(far for _, far in bounds)) / FAR)
    box = np.percentile(points / scale, [1, 99], axis=0).astype(np.float32)
    if not (np.isfinite(scale) and np.isfinite(box).all()):
        raise SceneError("the COLMAP model has points so far away that its size is not a number: reconstruct again")
    return bounds, scale, box


def depth_bounds(points: np.ndarray, w2c: np.ndarray, name: str) -> tuple[float, float]:
    """The 0.1 and 99.9 percentiles of the depths z > 0 of `points` (P, 3) seen from `w2c` (3, 4), in COLMAP
    units.
    """
    z = points @ w2c[2, :3] + w2c[2, 3]
    z = z[z > 0]
    if not len(z):
        raise SceneError(f"photo {name} has every 3-D point behind it: its pose is wrong; take it out of the model")
    near, far = np.percentile(z, [0.1, 99.9])
    if not near < far:
        raise SceneError(f"photo {name} has all 3-D points at one depth ({near:g}): too few points for bounds")
    return float(near), float(far)


def camera_to_world(w2c: np.ndarray, scale: float) -> np.ndarray:
    """Invert a rigid world-to-camera (3, 4) and divide its centre by `scale`: (3, 4) float32."""
    rotation = w2c[:, :3].T
    return np.column_stack([rotation, -rotation @ w2c[:, 3] / scale]).astype(np.float32)


def pinhole(camera: Any) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy of a COLMAP camera without distortion."""
    return (
        float(camera.focal_length_x),
        float(camera.focal_length_y),
        float(camera.principal_point_x),
        float(camera.principal_point_y),
    )


def photo_key(index: int, name: str) -> str:
    """The key of photo number `index`: sorts as photos do, free of dots, which would end a webdataset key."""
    slug = re.sub(r"[^a-z0-9_-]+", "-", Path(name).stem.lower())[:40]
    return f"{index:06d}-{slug}"


# Splits


def find_table(root: Path) -> Path | None:
    """The one split table of the scene: in `root`, else in `root/dense`."""
    for folder in (root, root / "dense"):
        tables = sorted(p for p in folder.glob("*.tsv") if not p.name.startswith("."))
        if len(tables) > 1:
            names = ", ".join(t.name for t in tables)
            raise SceneError(f"{folder} has several split tables ({names}): keep the one to use")
        if tables:
            return tables[0]
    return None


def read_splits(table: Path, posed: dict[str, Any]) -> dict[str, str]:
    """Photo name -> split, from NeRF-W's table, for the photos in `posed`.

    Columns are found by name, for scenes differ in their order. Rows with an empty id were excluded by
    NeRF-W's authors. The id itself is not used: photos are matched by name.
    """
    try:
        with table.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file, delimiter="\t", quoting=csv.QUOTE_NONE)
            lacking = {"filename", "id", "split"} - set(reader.fieldnames or ())
            rows = [(number, row) for number, row in enumerate(reader, start=2)]
    except (ValueError, csv.Error) as error:
        raise SceneError(f"{table} cannot be read ({error}): a split table is UTF-8 text with tabs") from error
    if lacking:
        raise SceneError(f"{table}: no column {', '.join(sorted(lacking))}; NeRF-W's tables have filename, id, split")
    splits: dict[str, str] = {}
    without_id = 0
    for number, row in rows:
        name, split = row["filename"] or "", (row["split"] or "").strip()
        name = name if name in posed else name.strip()
        if not (row["id"] or "").strip():
            without_id += 1
            continue
        if split not in SPLITS:
            raise SceneError(f"{table}, line {number}: split {split!r} of {name} is none of {', '.join(SPLITS)}")
        if splits.setdefault(name, split) != split:
            raise SceneError(f"{table}, line {number}: {name} is in {splits[name]} and in {split}; keep one row")
    if without_id:
        log.info("%s: %d rows without an id are left out", table.name, without_id)
    absent = [name for name in splits if name not in posed]
    if absent:
        log.warning("%s: %d photos have no pose and are left out: %s", table.name, len(absent), ", ".join(absent))
    unlisted = len(posed.keys() - splits.keys())
    if unlisted:
        log.info("%s: %d posed photos are not listed and are left out", table.name, unlisted)
    return {name: split for name, split in splits.items() if name in posed}


def hold_out(posed: dict[str, Any]) -> dict[str, str]:
    """Photo name -> split where there is no table: every eighth photo in name order is for testing."""
    splits = {name: "train" if i % 8 else "test" for i, name in enumerate(sorted(posed))}
    tests = sum(s == "test" for s in splits.values())
    log.info("no split table (*.tsv): every eighth photo is for testing, %d of %d", tests, len(splits))
    return splits


# Folders


def find_model(root: Path) -> tuple[Path, Any]:
    """The folder of the scene's COLMAP model and the model, a `pycolmap.Reconstruction`.

    `dense` is looked into first: its model is the undistorted one. Of several beside each other, the one with
    most photos.
    """
    pycolmap = import_pycolmap()
    models = []
    for folder in model_folders(root):
        try:
            models.append((folder, pycolmap.Reconstruction(str(folder))))
        except Exception as error:  # pycolmap raises whatever its C++ parser met: bad_alloc, map::at, ...
            raise SceneError(f"{folder}: the COLMAP model cannot be read ({error}); is a file cut short?") from error
    if not models:
        raise SceneError(
            f"{root}: no COLMAP model (cameras, images and points3D as .bin or .txt) in dense/sparse, sparse, "
            "their numbered folders, or the folder itself"
        )
    folder, model = max(models, key=lambda pair: pair[1].num_reg_images())
    if len(models) > 1:
        counts = ", ".join(f"{f.relative_to(root)}: {m.num_reg_images()}" for f, m in models)
        log.info("several COLMAP models (photos in each: %s); reading %s", counts, folder.relative_to(root))
    return folder, model


def model_folders(root: Path) -> list[Path]:
    """The folders beside each other that hold the scene's models."""
    for base in (root / "dense" / "sparse", root / "sparse", root):
        folders = [f for f in (base, *sorted(base.glob("[0-9]*"))) if holds_model(f)]
        if folders:
            return folders
    return []


def fingerprint(root: Path) -> str:
    """SHA-256 of the files that say where the photos were taken from and which are for training: models and split
    table. The same one, the same scene, without reading the model, which takes long where photos are many.
    """
    root = resolved(root)
    table = find_table(root)
    files = [f for folder in model_folders(root) for stem in (*MODEL_FILES, *POSES) for f in folder.glob(f"{stem}.*")]
    hashes = [(f.relative_to(root).as_posix(), sha256_of(f)) for f in sorted([*files, *([table] if table else [])])]
    return hashlib.sha256(repr(hashes).encode()).hexdigest()


def holds_model(folder: Path) -> bool:
    return any(all((folder / f"{stem}{suffix}").is_file() for stem in MODEL_FILES) for suffix in (".bin", ".txt"))


def find_photo_folder(root: Path, model_folder: Path) -> Path:
    """The photos that belong to the model: `dense/images` to one under `dense`, else `images`, else what
    there is.
    """
    candidates = [root / "images", root / "dense" / "images"]
    if (root / "dense") in model_folder.parents:
        candidates.reverse()
    for folder in candidates:
        if folder.is_dir():
            return folder
    raise SceneError(f"{root}: no photos; expected a folder dense/images or images")


def is_file(path: Path) -> bool:
    """Whether it is one; a name that the file system cannot have, such as one of 300 characters, is none."""
    try:
        return path.is_file()
    except OSError:
        return False


def is_photo(folder: Path, name: str) -> bool:
    """Whether `name` is a file of the photo folder."""
    return is_inside(folder, name) and is_file(folder / name)


def is_inside(folder: Path, name: str) -> bool:
    return (
        "\0" not in name and not Path(name).is_absolute() and resolved(folder / name).is_relative_to(resolved(folder))
    )


# Health


def check_model(model: Any, images: list[Any] | None = None) -> None:
    """Refuse what structure from motion returns when it went wrong without saying so.

    `model` is a `pycolmap.Reconstruction`, `images` those of its images that are to be used (all registered
    ones by default). Such models have every photo registered and a reprojection error below a pixel, so
    neither tells.

    Raises:
        SceneError: no 3-D points; a focal length outside 0.1 to 10 times the longer side; a principal point far
            outside the photo; a photo that sees no point; or most cameras in one spot of a scene that is hundreds of
            times as large.
    """
    if images is None:
        images = [model.images[i] for i in model.reg_image_ids()]
    advice = "reconstruct again (another seed, or more photos), or leave the photo out"
    if not model.points3D:
        raise SceneError(f"the COLMAP model has no 3-D points: {advice}")
    for image in images:
        camera = model.cameras[image.camera_id]
        centre = (camera.principal_point_x / max(camera.width, 1), camera.principal_point_y / max(camera.height, 1))
        if min(camera.width, camera.height) < 1 or not all(-1 <= c <= 2 for c in centre):
            raise SceneError(
                f"camera {image.camera_id} of photo {image.name} has {camera.width} x {camera.height} pixels and its "
                f"principal point at {centre[0]:.4g}, {centre[1]:.4g} of them (sane: within a side of the photo): "
                f"{advice}"
            )
        for f in (camera.focal_length_x, camera.focal_length_y):
            ratio = f / max(camera.width, camera.height)
            if not 0.1 < ratio < 10:
                raise SceneError(
                    f"camera {image.camera_id} of photo {image.name} has a focal length of {ratio:.4g} times "
                    f"its longer side (sane: 0.1 to 10): {advice}"
                )
        if image.num_points3D == 0:
            raise SceneError(f"photo {image.name} is registered and sees no 3-D point: {advice}")
    if is_collapsed(
        np.stack([image.projection_center() for image in images]),
        np.stack([point.xyz for point in model.points3D.values()]),
    ):
        raise SceneError(f"most of the {len(images)} cameras stand in one spot: {advice}")


def check_undistorted(root: Path, model: Any, images: list[Any], folder: Path, photo_folder: Path) -> None:
    """Refuse cameras that are no pinholes, with the command that makes a scene of pinholes of this one.

    Raises:
        SceneError: a photo's camera is of another kind, or distorted.
    """
    for image in images:
        camera = model.cameras[image.camera_id]
        distortion = [float(camera.params[i]) for i in camera.extra_params_idxs()]
        if camera.model.name not in PINHOLE_AT_ZERO:
            wrong = f"is {camera.model.name}, not a pinhole"
        elif any(distortion):
            wrong = f"is distorted (k={', '.join(f'{k:g}' for k in distortion)})"
        else:
            continue
        target = root if not (root / "dense").exists() else root.with_name(f"{root.name}-undistorted")
        paths = ", ".join(json.dumps(str(path)) for path in (target / "dense", folder, photo_folder))
        command = shlex.quote(f"import pycolmap; pycolmap.undistort_images({paths})")
        raise SceneError(
            f"camera {image.camera_id} of photo {image.name} {wrong}: undistort the photos, then read the scene "
            f"{target}:\n  python -c {command}"
        )


def is_collapsed(centres: np.ndarray, points: np.ndarray) -> bool:
    """Whether at least half of the `centres` (N, 3) lie within 1/500 of the extent of the scene, in one spot.

    The extent is the larger of the farthest centre and the median point (P, 3), from the median centre: a
    collapsed model has one far outlier that stretches it, or no baseline at all. Real ones measured: 1/11 and
    1/3; collapsed: below 1/1600.
    """
    if len(centres) < 2:
        return False
    middle = np.median(centres, axis=0)
    from_middle = np.linalg.norm(centres - middle, axis=1)
    extent = max(from_middle.max(), np.median(np.linalg.norm(points - middle, axis=1)))
    return bool(np.median(from_middle) < extent / 500)
