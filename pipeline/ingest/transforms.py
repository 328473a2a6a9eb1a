"""nerfstudio's transforms.json, in and out.

Its cameras are OpenGL camera-to-world (x right, y up, z backwards), (4, 4); ours OpenCV, so y and z change sign. The
world is that of the file's `transform_matrix`: `applied_transform`, which says how nerfstudio got there from another
one, is left as it is.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from pipeline.colmap import import_pycolmap
from pipeline.errors import CrossrayError
from pipeline.files import atomic_file, atomic_write
from pipeline.ingest.mapping import judge
from pipeline.scene import pinhole

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
Row = tuple[float, float, float, float]


class Intrinsics(BaseModel):
    """Of one frame, or of all; unknown keys are ignored."""

    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)
    camera_model: str | None = None
    w: int | None = Field(None, ge=1, le=100_000)
    h: int | None = Field(None, ge=1, le=100_000)
    fl_x: float | None = Field(None, gt=0)
    fl_y: float | None = Field(None, gt=0)
    camera_angle_x: float | None = Field(None, gt=0, lt=np.pi)
    cx: float | None = None
    cy: float | None = None
    k1: float | None = None
    k2: float | None = None
    k3: float | None = None
    k4: float | None = None
    p1: float | None = None
    p2: float | None = None


class Frame(Intrinsics):
    """One photo: where its file is, and its pose."""

    file_path: str = Field(min_length=1, max_length=4096)
    transform_matrix: tuple[Row, Row, Row, Row] | tuple[Row, Row, Row]


class Transforms(Intrinsics):
    """The whole file."""

    frames: list[Frame] = Field(min_length=1, max_length=1_000_000)


def read_transforms(path: Path) -> dict[Path, tuple[Intrinsics, np.ndarray]]:
    """Photo file -> its intrinsics and its world-to-camera (3, 4) in OpenCV's axes.

    Raises:
        CrossrayError: it cannot be read, a file is missing or named twice, or a pose is no pose.
    """
    try:
        content = Transforms.model_validate_json(path.read_bytes())
    except OSError as error:
        raise CrossrayError(f"{path}: {error.strerror or error}") from error
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise CrossrayError(f"{path}: {where or 'the file'}: {first['msg']}; is it nerfstudio's?") from None
    shared = content.model_dump(exclude={"frames"}, exclude_none=True)
    found: dict[Path, tuple[Intrinsics, np.ndarray]] = {}
    for frame in content.frames:
        file = frame_file(path, frame.file_path)
        if file in found:
            raise CrossrayError(f"{path}: {frame.file_path} has two frames; keep one")
        own = frame.model_dump(exclude={"file_path", "transform_matrix"}, exclude_none=True)
        found[file] = Intrinsics(**(shared | own)), world_to_camera(frame, path)
    return found


def frame_file(path: Path, name: str) -> Path:
    """The file of a frame; a name without a suffix means a PNG."""
    for file in (path.parent / name, path.parent / f"{name}.png"):
        if file.is_file():
            return file.resolve()
    raise CrossrayError(f"{path}: photo {name} is not in {path.parent}")


def world_to_camera(frame: Frame, path: Path) -> np.ndarray:
    """(3, 4) of a frame's camera-to-world."""
    c2w = np.eye(4)
    c2w[:3] = np.array(frame.transform_matrix)[:3]
    rotation = c2w[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0:
        raise CrossrayError(f"{path}: transform_matrix of {frame.file_path} is no rotation; is it scaled?")
    return np.linalg.inv(c2w @ OPENGL)[:3]


def camera_of(intrinsics: Intrinsics, size: tuple[int, int], name: str, camera_id: int) -> Any:
    """A `pycolmap.Camera` for a photo of `size` (width, height).

    Raises:
        CrossrayError: no focal length, another size, or a camera model that is none of nerfstudio's perspective ones.
    """
    pycolmap = import_pycolmap()
    i, (width, height) = intrinsics, size
    if (i.w or width, i.h or height) != size:
        raise CrossrayError(f"photo {name} has {width} x {height} pixels and its frame {i.w} x {i.h}")
    fx = i.fl_x or (width / 2 / np.tan(i.camera_angle_x / 2) if i.camera_angle_x else None)
    if fx is None:
        raise CrossrayError(f"photo {name}: its frame tells no focal length (fl_x, or camera_angle_x)")
    base = [fx, i.fl_y or fx, width / 2 if i.cx is None else i.cx, height / 2 if i.cy is None else i.cy]
    k1, k2, k3, k4, p1, p2 = (getattr(i, key) or 0.0 for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    kind = i.camera_model or "OPENCV"
    if kind == "OPENCV_FISHEYE":
        params = [*base, k1, k2, k3, k4]
    elif kind in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV"):
        kind = "PINHOLE" if not any((k1, k2, k3, p1, p2)) else "FULL_OPENCV" if k3 else "OPENCV"
        params = {"PINHOLE": base, "OPENCV": [*base, k1, k2, p1, p2]}.get(kind, [*base, k1, k2, p1, p2, k3, 0, 0, 0])
    else:
        raise CrossrayError(f"photo {name}: camera model {kind} is not read; OPENCV, PINHOLE and OPENCV_FISHEYE are")
    return pycolmap.Camera(camera_id=camera_id, model=kind, width=width, height=height, params=params)


def triangulate(database: str, photos: str, out: str, poses: dict[str, np.ndarray]) -> None:
    """Write to `out` the model of photos whose cameras (in the database) and poses are known: its points are
    triangulated.
    """
    pycolmap = import_pycolmap()
    pycolmap.set_random_seed(0)
    opened = pycolmap.Database.open(database)
    images, cameras = opened.read_all_images(), opened.read_all_cameras()
    opened.close()
    model = pycolmap.Reconstruction()
    for camera in cameras:
        model.add_camera_with_trivial_rig(camera)
    for image in images:
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(poses[image.name][:, :3]), poses[image.name][:, 3])
        known = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id)
        model.add_image_with_trivial_frame(known, pose)
    scratch = Path(out).with_name(f".{Path(out).name}.tmp")
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir(parents=True)
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = 0
    done = pycolmap.triangulate_points(model, database, photos, scratch / "model-0", options=options)
    verdict = judge(done, "model-0", adjusted=None)
    (scratch / "model-0").mkdir(exist_ok=True)
    done.write_binary(scratch / "model-0")
    record = {"name": "triangulation", "models": [asdict(verdict)]}
    atomic_write(scratch / "verdict.json", json.dumps(record, indent=1))
    shutil.rmtree(out, ignore_errors=True)
    scratch.rename(out)


def write_transforms(scene: Path, model: Any, images: str) -> None:
    """Write `scene`/transforms.json and points.ply of a model of pinhole cameras, in the model's units."""
    frames = []
    for image in sorted((model.images[i] for i in model.reg_image_ids()), key=lambda image: image.name):
        camera = model.cameras[image.camera_id]
        c2w = np.linalg.inv(np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])) @ OPENGL
        fx, fy, cx, cy = pinhole(camera)
        frames.append(
            {
                "file_path": f"{images}/{image.name}",
                "w": camera.width,
                "h": camera.height,
                "fl_x": fx,
                "fl_y": fy,
                "cx": cx,
                "cy": cy,
                "transform_matrix": c2w.tolist(),
            }
        )
    points = [model.points3D[i] for i in sorted(model.points3D)]
    write_ply(scene / "points.ply", np.array([p.xyz for p in points]), np.array([p.color for p in points], np.uint8))
    content = {"camera_model": "OPENCV", "ply_file_path": "points.ply", "frames": frames}
    atomic_write(scene / "transforms.json", json.dumps(content, indent=1) + "\n")


def write_ply(path: Path, points: np.ndarray, colours: np.ndarray) -> None:
    """A binary PLY of points (n, 3) with colours (n, 3) uint8."""
    kinds = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
    rows = np.zeros(len(points), kinds)
    for (name, _), column in zip(kinds, [*points.T, *colours.T], strict=True):
        rows[name] = column
    properties = "".join(f"property {'float' if kind == '<f4' else 'uchar'} {name}\n" for name, kind in kinds)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{properties}end_header\n"
    with atomic_file(path) as file:
        file.write(header.encode() + rows.tobytes())
