"""camera_path.json of nerfstudio (1.1.5: viewer/render_panel.py writes it, cameras/camera_paths.py reads it).

Poses are camera-to-world with OpenGL axes (y up, z backwards); `fov` is vertical, in degrees. The format knows a
centred lens with square pixels: what a photo's camera has beside that is not written. What it has no key for,
appearances, travels in `appearances` and each frame's `appearance_weights`, which nerfstudio ignores.

The file is in the world of the scene's COLMAP model. nerfstudio turns, moves and scales a scene unless it is trained
with `colmap --orientation-method none --center-method none --auto-scale-poses False
--assume-colmap-world-coordinate-convention False`; only then is its world this one.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from pipeline.errors import CrossrayError
from pipeline.files import atomic_write
from pipeline.views.camera import Camera
from pipeline.views.foreign import (
    Coordinate,
    Foreign,
    FramesPerSecond,
    Side,
    Weights,
    assembled,
    checked,
    content_of,
    in_colmap_units,
    key_frames,
    pose_of,
    weights_of,
)
from pipeline.views.path import FPS, MAX_FRAMES, CameraPath

OPENGL = np.array([1.0, -1.0, -1.0, 1.0])  # of OpenCV's axes


class PathFrame(Foreign):
    """One frame of `camera_path`."""

    camera_to_world: Annotated[list[Coordinate], Field(min_length=16, max_length=16)]
    fov: Annotated[float, Field(gt=0.01, lt=179)]
    appearance_weights: Weights | None = None


class Appearance(Foreign):
    """Of `appearances`, our extra key."""

    image: str


class PathFile(Foreign):
    """camera_path.json, as far as it is read."""

    camera_type: str = "perspective"
    render_height: Side
    render_width: Side
    fps: FramesPerSecond = FPS
    camera_path: Annotated[list[PathFrame], Field(min_length=1, max_length=MAX_FRAMES)]
    appearances: list[Appearance] | None = None


def read_camera_path(path: Path, scale: float, train: Mapping[str, Camera]) -> CameraPath:
    """A camera_path.json, in scene units.

    Args:
        scale: COLMAP units per scene unit.
        train: name -> camera of the training photos, from which depth bounds come.

    Raises:
        CrossrayError: it cannot be read, is of another type than perspective, or a frame is not a camera; the message
            names the frame.
    """
    content = content_of(path)
    kind = content.get("camera_type", "perspective")
    if isinstance(kind, str) and kind.lower() != "perspective":
        raise CrossrayError(f"{path}: camera_type {kind!r}: only perspective can be rendered")
    file = checked(PathFile, content, path)
    size = file.render_width, file.render_height
    names = [appearance.image for appearance in file.appearances or []]
    poses, lenses, weights = [], [], []
    for i, frame in enumerate(file.camera_path):
        where = f"{path}: camera_path.{i}"
        matrix = np.reshape(frame.camera_to_world, (4, 4)) * OPENGL
        poses.append(pose_of(matrix.flatten().tolist(), scale, where))
        focal = size[1] / 2 / math.tan(math.radians(frame.fov) / 2)
        lenses.append((focal, focal, size[0] / 2, size[1] / 2))
        weights.append(weights_of(frame.appearance_weights, names, where))
    return assembled(size, lenses, poses, weights, names, file.fps, train.values())


def write_camera_path(path: Path, film: CameraPath, scale: float) -> None:
    """Write a path, in scene units, as camera_path.json; the file is whole or as it was before."""
    atomic_write(path, camera_path_text(film, scale))


def camera_path_text(film: CameraPath, scale: float) -> str:
    """The content of a camera_path.json of a path in scene units."""
    width, height = film.size
    frames: list[dict[str, Any]] = []
    for frame in film.frames:
        entry = {
            "camera_to_world": (in_colmap_units(frame.camera, scale) * OPENGL).flatten().tolist(),
            "fov": math.degrees(2 * math.atan(height / 2 / frame.camera.fy)),
            "aspect": width / height,
        }
        frames.append(entry if frame.weights is None else entry | {"appearance_weights": frame.weights})
    keys = [frames[i] for i in key_frames(len(frames))]
    seconds = len(frames) / film.fps
    content = {
        "default_fov": frames[0]["fov"],
        "default_transition_sec": seconds / max(len(keys) - 1, 1),
        "keyframes": [
            {
                "matrix": key["camera_to_world"],
                "fov": key["fov"],
                "aspect": key["aspect"],
                "override_transition_enabled": False,
                "override_transition_sec": None,
            }
            for key in keys
        ],
        "camera_type": "perspective",
        "render_height": height,
        "render_width": width,
        "fps": film.fps,
        "seconds": seconds,
        "is_cycle": False,
        "smoothness_value": 0.0,
        "camera_path": frames,
        **({"appearances": [{"image": name} for name in film.appearances]} if film.appearances else {}),
    }
    return json.dumps(content, indent=1) + "\n"
