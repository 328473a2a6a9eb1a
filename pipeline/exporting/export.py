"""`crossray export`: a trained scene in one appearance, as files that other programs open.

    OUT/views/<key>.png        the chosen views in the appearance
        depth/<key>.npy        their depth z, float32 (h, w), COLMAP units, 0 where there is no surface
        depth/<key>.png        a picture of it
        points.ply             a point cloud of the training views
        colmap/*.txt           the cameras of the views as a COLMAP model
        transforms.json        the same for nerfstudio, with the paths of views, depth maps and points
        README.txt             units and conventions, for who gets the folder
        export.json            what it is, and hashes; written last

The same command again does what is missing; with another `--what`, it adds to the folder. Until all is there,
`.started.json` says what the folder is going to hold, so that nothing of two exports is mixed.
"""

from __future__ import annotations

import difflib
import json
import logging
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from pipeline.appearances import Read
from pipeline.checkpoint import MODEL, digest
from pipeline.config import nearest
from pipeline.errors import CrossrayError
from pipeline.exporting.cameras import colmap_text, exported_camera, transforms
from pipeline.exporting.depth import preview, z_depth
from pipeline.exporting.points import check_budget, write_points
from pipeline.exporting.readme import readme
from pipeline.exporting.shown import Shown
from pipeline.files import atomic_file, atomic_write, sha256_of
from pipeline.manifest import CameraRecord
from pipeline.painter import Painter
from pipeline.photos import Photos
from pipeline.progress import Progress
from pipeline.provenance import provenance
from pipeline.render import view_rays

log = logging.getLogger("crossray")

FORMAT = 1
WHAT = ("points", "depth", "cameras", "views")
SPLITS = ("train", "val", "test")
POINTS = 1_000_000
RECORD, STARTED, WORK = "export.json", ".started.json", ".points"
PLY, TRANSFORMS, COLMAP, README = "points.ply", "transforms.json", "colmap", "README.txt"
"""What is written beside views/ and depth/."""


def export_run(
    run: Path,
    out: Path,
    what: Sequence[str] = WHAT,
    appearance: str | None = None,
    view: str = "test",
    points: int = POINTS,
    step: int | None = None,
) -> dict[str, Any]:
    """Export a run's checkpoint (the newest, or `step`) to the folder `out`; returns the content of its export.json.

    Memory: one view's rays and what they see, and the samples of one chunk of rays. What is there already of the same
    export is left as it is.

    Args:
        what: of WHAT.
        appearance: the name of a photo of the scene, or the path of any image file; by default the first training
            photo.
        view: of which photos the views, depth maps and cameras are: train, val, test, all, or a photo's name.
        points: rays from which the point cloud is made, at most, evenly chosen pixels of all training views.

    Raises:
        CrossrayError: the run, its photos, a view or the appearance cannot be used, the method has no appearance and
            one is named, or `out` holds something else.
    """
    check_request(what, points)
    painter = Painter(run, step)
    photos = painter.photos
    records = views_of(photos, view)
    train = [photos.records[i] for i in photos.indices("train")]
    if "points" in what:
        check_budget(train, points)
    F, source = chosen_appearance(painter, appearance)
    about = {
        "checkpoint_sha256": painter.checkpoint.meta["sha256"][MODEL],
        "appearance": source or None,
        "view": view,
        "points": points,
    }
    before = claim(out, about)
    wanted = [w for w in WHAT if w in what or w in before.get("what", [])]
    if whole(out, before) and before["what"] == wanted:
        log.info("%s: all of this export is there already", out)
        return before
    start(out, about, wanted)
    shown, scale = Shown(painter, F), photos.manifest.scene.scale
    if "views" in wanted or "depth" in wanted:
        write_views(out, shown, records, scale, [w for w in ("views", "depth") if w in wanted])
    if "points" in wanted and not (out / PLY).exists():
        write_points(out / PLY, shown, train, scale, points, out / WORK)
    if "cameras" in wanted:
        write_cameras(out, records, scale, shown.pixel_center, wanted)
        if "views" not in wanted:
            log.info("the cameras' pictures, views/*.png, are not exported; --what cameras,views adds them")
    told = f"{painter.job.name} ({painter.job.method}, step {painter.checkpoint.step})"
    atomic_write(out / README, readme(told, source, wanted))
    record = {
        "format": FORMAT,
        "run": painter.job.name,
        "method": painter.job.method,
        "step": painter.checkpoint.step,
        **about,
        "what": wanted,
        "units": {"length": "COLMAP units", "COLMAP units a scene unit": scale},
        "counts": {"views": len(records), **({"points": vertices(out / PLY)} if "points" in wanted else {})},
        "provenance": provenance(),
    }
    return commit(out, record)


# --------------------------------------------------------------------------------------------------------- choices


def check_request(what: Sequence[str], points: int) -> None:
    """CrossrayError where there is nothing of the name in `what`, or no point to make."""
    for word in what:
        if word not in WHAT:
            raise CrossrayError(f"--what {word}: there is nothing of this name to export{nearest(word, list(WHAT))}")
    if not what:
        raise CrossrayError(f"--what: nothing to export; there are {', '.join(WHAT)}")
    if points < 1:
        raise CrossrayError(f"--points {points}: at least 1")


def views_of(photos: Photos, view: str) -> list[CameraRecord]:
    """The cameras of a split, of all photos, or of one. CrossrayError: there is none."""
    records = [record for record in photos.records if view in ("all", record.split, record.name)]
    if not records:
        there = [*(split for split in SPLITS if photos.indices(split)), "all"]
        close = difflib.get_close_matches(view, [*there, *(record.name for record in photos.records)], n=1, cutoff=0.5)
        guess = f"; did you mean {close[0]!r}?" if close else f" (the first photo is {photos.records[0].name!r})"
        raise CrossrayError(
            f"--view {view}: no photo of the scene is of this split or name; there are {', '.join(there)}{guess}"
        )
    return records


def chosen_appearance(painter: Painter, name: str | None) -> Read:
    """The appearance of this name; of none where the method has none. CrossrayError: it cannot be had."""
    if not painter.has_appearance:
        if name is not None:
            raise CrossrayError(
                f"--appearance {name}: {painter.run} has none to choose (model.appearance: none); leave it out"
            )
        return Read(None, {})
    if name is None:
        name = painter.photos.records[painter.photos.indices("train")[0]].name
        log.info("appearance: %s, the first training photo; --appearance names another one", name)
    return painter.read(name)


# --------------------------------------------------------------------------------------------------------- the folder


def claim(out: Path, about: dict[str, Any]) -> dict[str, Any]:
    """What is recorded of this export in the folder, complete or not; nothing where the folder is new or empty.

    Raises:
        CrossrayError: the folder holds something else.
    """
    if not out.exists() or not any(path.suffix != ".tmp" for path in out.iterdir()):
        return {}
    there = [path for path in (out / RECORD, out / STARTED) if path.is_file()]
    if not there:
        first = min(path.name for path in out.iterdir() if path.suffix != ".tmp")
        raise CrossrayError(f"{out} holds {first} and no {RECORD}, so it is no export; --out names another folder")
    try:
        found = json.loads(there[0].read_text())
        same = all(found[key] == value for key, value in about.items())
        if there[0].name == RECORD and found["digest"] != digest(found):
            raise ValueError("its content is not what was written")
    except (ValueError, KeyError, TypeError) as error:
        raise CrossrayError(f"{there[0]} is damaged ({error}); --out names another folder") from None
    if not same:
        raise CrossrayError(
            f"{out} holds an export of another checkpoint, appearance, choice of views or number of points; --out "
            "names another folder"
        )
    return found


def whole(out: Path, record: dict[str, Any]) -> bool:
    """Whether an export was completed and is as recorded; files that are not are removed, to be made anew."""
    if "files" not in record:
        return False
    wrong = [out / name for name, sha256 in record["files"].items() if not intact(out / name, sha256)]
    for path in wrong:
        path.unlink(missing_ok=True)
    return not wrong


def intact(path: Path, sha256: str) -> bool:
    """Whether a file is there as it was written."""
    return path.is_file() and sha256_of(path) == sha256


def start(out: Path, about: dict[str, Any], wanted: list[str]) -> None:
    """Say in the folder what it is going to hold; an older record must not vouch for new files."""
    atomic_write(out / STARTED, json.dumps(about | {"what": wanted}) + "\n")
    (out / RECORD).unlink(missing_ok=True)


def commit(out: Path, record: dict[str, Any]) -> dict[str, Any]:
    """Write export.json with the hashes of all files; the export is there once this is."""
    shutil.rmtree(out / WORK, ignore_errors=True)
    files = sorted(p for p in out.rglob("*") if p.is_file() and not p.name.startswith(".") and p != out / RECORD)
    record = record | {"files": {str(path.relative_to(out)): sha256_of(path) for path in files}}
    record = record | {"digest": digest(record)}
    atomic_write(out / RECORD, json.dumps(record, indent=2) + "\n")
    (out / STARTED).unlink(missing_ok=True)
    return record


# --------------------------------------------------------------------------------------------------------- its files


def write_views(out: Path, shown: Shown, records: Sequence[CameraRecord], scale: float, kinds: Sequence[str]) -> None:
    """Write the views, their depth maps, or both; a view of which all is there is not rendered."""
    progress = Progress("views")
    try:
        for done, camera in enumerate(records, start=1):
            files = {"views": [f"views/{camera.key}.png"], "depth": [depth_file(camera), f"depth/{camera.key}.png"]}
            if not all((out / name).exists() for kind in kinds for name in files[kind]):
                write_view(out, shown, camera, scale, kinds)
            progress.update(done / len(records), f"{done} of {len(records)}")
    finally:
        progress.close()


def write_view(out: Path, shown: Shown, camera: CameraRecord, scale: float, kinds: Sequence[str]) -> None:
    """Render a view and write what is asked of it."""
    rays = view_rays(camera, shown.pixel_center, shown.device)
    seen = shown.look(rays)
    if "views" in kinds:
        write_png(out / "views" / f"{camera.key}.png", seen.colours.reshape(camera.height, camera.width, 3))
    if "depth" in kinds:
        depth = z_depth(scale * seen.distance, rays, np.array(camera.c2w)[:, 2])
        depth = depth.reshape(camera.height, camera.width)
        with atomic_file(out / depth_file(camera)) as file:
            np.save(file, depth)
        write_png(out / "depth" / f"{camera.key}.png", preview(depth))


def write_png(path: Path, picture: np.ndarray) -> None:
    with atomic_file(path) as file:
        Image.fromarray(picture).save(file, format="PNG")


def depth_file(camera: CameraRecord) -> str:
    """Path of a view's depth map in the folder."""
    return f"depth/{camera.key}.npy"


def write_cameras(
    out: Path, records: Sequence[CameraRecord], scale: float, pixel_center: float, wanted: Sequence[str]
) -> None:
    """Write the COLMAP model and transforms.json, which names depth maps and points where they are exported."""
    cameras = {record.key: exported_camera(record, scale, pixel_center) for record in records}
    for name, text in colmap_text({f"{key}.png": camera for key, camera in cameras.items()}).items():
        atomic_write(out / COLMAP / name, text)
    depths = {f"views/{record.key}.png": depth_file(record) for record in records} if "depth" in wanted else None
    content = transforms(
        {f"views/{key}.png": camera for key, camera in cameras.items()}, depths, PLY if "points" in wanted else None
    )
    atomic_write(out / TRANSFORMS, json.dumps(content, indent=2) + "\n")


def vertices(path: Path) -> int:
    """How many points a PLY file of ours holds."""
    with path.open("rb") as file:
        return next(int(line.split()[-1]) for line in file if line.startswith(b"element vertex"))
