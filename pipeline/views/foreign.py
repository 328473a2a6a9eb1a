"""What the two formats of camera paths have in common: strict reading, and the world that they are in.

Files are in the units and the world of the scene's COLMAP model; inside, lengths are in scene units, of which one is
`scale` COLMAP units. Appearances travel as one list of names a file and weights a frame.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from pipeline.errors import CrossrayError
from pipeline.views.camera import MAX_SIDE, Camera, posed
from pipeline.views.path import FASTEST, SLOWEST, CameraPath, Frame
from pipeline.views.smooth import bounds_at

MAX_BYTES = 2**28  # of a file: MAX_FRAMES take about 100 MB
FAR_AWAY = 1e9  # coordinates beyond are an error of whoever wrote them
ROTATION_TOLERANCE = 5e-3  # of R^T R from 1: poses written with three digits are read
ORIGIN = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))
KEYFRAMES = 24  # that are written for editors, at most

Side = Annotated[int, Field(ge=1, le=MAX_SIDE, strict=False)]  # 640.0 is one, too
Coordinate = Annotated[FiniteFloat, Field(ge=-FAR_AWAY, le=FAR_AWAY)]
Weights = Annotated[list[Annotated[float, Field(ge=-100, le=100)]], Field(max_length=1000)]
Matrix12 = Annotated[list[Coordinate], Field(min_length=12, max_length=16)]
FramesPerSecond = Annotated[float, Field(ge=SLOWEST, le=FASTEST)]


class Foreign(BaseModel):
    """A part of a file that other programs write: keys that we do not know are ignored."""

    model_config = ConfigDict(frozen=True, extra="ignore", strict=True)


Model = TypeVar("Model", bound=Foreign)


def content_of(path: Path) -> dict[str, Any]:
    """A JSON file's top object.

    Raises:
        CrossrayError: no such file, it cannot be read, it is larger than MAX_BYTES, or it is no JSON object.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise CrossrayError(f"{path}: larger than {MAX_BYTES >> 20} MiB: that is no camera path")
        content = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        why = getattr(error, "strerror", None) or error
        raise CrossrayError(f"{path}: cannot be read as a camera path ({why})") from error
    if not isinstance(content, dict):
        raise CrossrayError(f"{path}: no camera path: its top level is no JSON object")
    return content


def checked(kind: type[Model], content: Mapping[str, Any], path: Path) -> Model:
    """The file's content as `kind`. CrossrayError: it is not; the message names the first key that is wrong."""
    try:
        return kind.model_validate(content)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False)[0]
        where = ".".join(map(str, first["loc"])) or "the file"
        found = repr(first["input"])
        shown = "" if first["type"] == "missing" else f" ({found if len(found) < 60 else found[:57] + '...'})"
        raise CrossrayError(f"{path}: {where}{shown}: {first['msg']}") from None


def pose_of(values: Sequence[float], scale: float, where: str) -> np.ndarray:
    """The camera-to-world (3, 4) in scene units of 12 or 16 numbers, row-major, in COLMAP units; the rotation exactly
    orthonormal.

    Raises:
        CrossrayError: it is not rigid; `where` says whose it is.
    """
    if len(values) not in (12, 16):
        raise CrossrayError(f"{where}: a matrix of {len(values)} numbers; it needs 12 or 16, row after row")
    pose = np.reshape(np.array(values, np.float64), (-1, 4))
    if len(pose) == 4 and np.abs(pose[3] - (0, 0, 0, 1)).max() > 1e-6:
        raise CrossrayError(
            f"{where}: the last row of the matrix is {pose[3].tolist()}, not 0 0 0 1; it is written row after row"
        )
    rotation = pose[:3, :3]
    off = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if off > ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        raise CrossrayError(
            f"{where}: the matrix does not turn and move only: its columns must be of length 1, at right angles, and "
            f"right-handed (off by {off:.2g}, determinant {np.linalg.det(rotation):.3g})"
        )
    left, _, right = np.linalg.svd(rotation)
    return np.column_stack([left @ right, pose[:3, 3] / scale])


def in_colmap_units(camera: Camera, scale: float) -> np.ndarray:
    """The camera-to-world (4, 4) with its centre in COLMAP units."""
    return np.vstack([np.column_stack([camera.pose[:, :3], camera.pose[:, 3] * scale]), (0, 0, 0, 1)])


def weights_of(values: Sequence[float] | None, appearances: Sequence[str], where: str) -> tuple[float, ...] | None:
    """A frame's weights with sum 1; None where it has none. What a spline put below 0 is 0.

    Raises:
        CrossrayError: not one an appearance, or none is positive.
    """
    if not values:
        return None
    if len(values) != len(appearances):
        raise CrossrayError(f"{where}: {len(values)} appearance_weights for {len(appearances)} appearances")
    positive = [max(0.0, v) for v in values]
    total = sum(positive)
    if total < 1e-6:
        raise CrossrayError(f"{where}: no appearance weight is above 0")
    return tuple(v / total for v in positive)


def assembled(
    size: tuple[int, int],
    lenses: Sequence[tuple[float, float, float, float]],
    poses: Sequence[np.ndarray],
    weights: Sequence[tuple[float, ...] | None],
    appearances: Sequence[str],
    fps: float,
    train: Iterable[Camera],
) -> CameraPath:
    """The path of what was read, one entry a frame: lenses are fx, fy, cx, cy in pixels, poses (3, 4) in scene units;
    depth bounds are those of training cameras nearby.
    """
    bounds = bounds_at(list(train), np.array(poses)[:, :, 3]).tolist()
    frames = [
        Frame(posed(Camera(*size, *lens, ORIGIN, near, far), pose), w)
        for lens, (near, far), pose, w in zip(lenses, bounds, poses, weights, strict=True)
    ]
    return CameraPath(tuple(frames), fps, tuple(appearances))


def key_frames(count: int) -> list[int]:
    """Which of `count` frames are written as key frames for editors: KEYFRAMES at most, both ends among them."""
    return sorted({round(i) for i in np.linspace(0, count - 1, min(count, KEYFRAMES))})
