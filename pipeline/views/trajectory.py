"""Trajectories of nerfbaselines, "nerfbaselines-v1" (1.2.12: nerfbaselines/io.py reads and writes them, _types.py has
the types, viewer/static/viewer.js exports and edits them).

Poses are camera-to-world, OpenCV, 12 numbers row after row. An appearance is `embedding_train_index`, the number of a
training photo in name order. We add `image`, its name or an image file, which nerfbaselines ignores and which counts
where both are given. The file is in the world of the scene's COLMAP model.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

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
from pipeline.views.path import MAX_FRAMES, CameraPath

FORMAT = "nerfbaselines-v1"

Focal = Annotated[float, Field(ge=1e-3, le=1e7)]
Pixel = Annotated[float, Field(ge=-1e6, le=1e6)]


class TrajectoryFrame(Foreign):
    """One of `frames`."""

    pose: Annotated[list[Coordinate], Field(max_length=16)]
    intrinsics: Annotated[list[Pixel], Field(min_length=4, max_length=4)]
    appearance_weights: Weights | None = None


class Appearance(Foreign):
    """One of `appearances`."""

    image: str | None = None
    embedding_train_index: int | None = None
    embedding: Any = None


class TrajectoryFile(Foreign):
    """A trajectory, as far as it is read."""

    camera_model: str
    image_size: Annotated[list[Side], Field(min_length=2, max_length=2)]
    fps: FramesPerSecond
    frames: Annotated[list[TrajectoryFrame], Field(min_length=1, max_length=MAX_FRAMES)]
    appearances: list[Appearance] | None = None


def read_trajectory(path: Path, scale: float, train: Mapping[str, Camera]) -> CameraPath:
    """A trajectory, in scene units.

    Args:
        scale: COLMAP units per scene unit.
        train: name -> camera of the training photos, from which depth bounds come, and appearances by number.

    Raises:
        CrossrayError: it cannot be read, its cameras are no pinholes, a frame is not a camera, or an appearance is
            given by its values alone; the message names the frame or appearance.
    """
    content = content_of(path)
    if content.get("format") != FORMAT:
        raise CrossrayError(f"{path}: format {content.get('format')!r}, and {FORMAT!r} is read")
    file = checked(TrajectoryFile, content, path)
    if file.camera_model != "pinhole":
        raise CrossrayError(f"{path}: camera_model {file.camera_model!r}: only pinhole can be rendered")
    width, height = file.image_size
    photos = sorted(train)
    names = [name_of(a, photos, f"{path}: appearances.{i}") for i, a in enumerate(file.appearances or [])]
    poses, lenses, weights = [], [], []
    for i, frame in enumerate(file.frames):
        where = f"{path}: frames.{i}"
        fx, fy, cx, cy = frame.intrinsics
        if min(fx, fy) < 1e-3:
            raise CrossrayError(f"{where}: focal lengths {fx:g} and {fy:g} pixels: they are positive")
        poses.append(pose_of(frame.pose, scale, where))
        lenses.append((fx, fy, cx, cy))
        weights.append(weights_of(frame.appearance_weights, names, where))
    return assembled((width, height), lenses, poses, weights, names, file.fps, train.values())


def name_of(appearance: Appearance, photos: Sequence[str], where: str) -> str:
    """The name of an appearance; training photos are numbered in name order. CrossrayError: it has none."""
    index = appearance.embedding_train_index
    if appearance.image is not None:
        return appearance.image
    if index is None:
        raise CrossrayError(
            f"{where}: an embedding belongs to the one trained model that it was taken from; name a photo instead, as "
            f'{{"image": "{photos[0]}"}} or {{"embedding_train_index": 0}}'
        )
    if not 0 <= index < len(photos):
        raise CrossrayError(f"{where}: embedding_train_index {index}, and there are {len(photos)} training photos")
    return photos[index]


def write_trajectory(path: Path, film: CameraPath, scale: float, train: Sequence[str]) -> None:
    """Write a path, in scene units, as a trajectory; the file is whole or as it was before. Arguments as
    `trajectory_text`.
    """
    atomic_write(path, trajectory_text(film, scale, train))


def trajectory_text(film: CameraPath, scale: float, train: Sequence[str]) -> str:
    """The content of a trajectory of a path in scene units.

    Args:
        train: names of the training photos. Only where all appearances are among them, they are numbered:
            nerfbaselines wants all or none.
    """
    width, height = film.size
    poses = [in_colmap_units(frame.camera, scale)[:3].flatten().tolist() for frame in film.frames]
    numbers = {name: i for i, name in enumerate(sorted(train))}
    numbered = all(name in numbers for name in film.appearances)
    frames = [
        {
            "pose": pose,
            "intrinsics": [frame.camera.fx, frame.camera.fy, frame.camera.cx, frame.camera.cy],
            "appearance_weights": frame.weights or [],
        }
        for pose, frame in zip(poses, film.frames, strict=True)
    ]
    fovs = [math.degrees(2 * math.atan(height / 2 / frame.camera.fy)) for frame in film.frames]
    keys = key_frames(len(frames))
    seconds = len(frames) / film.fps
    content: dict[str, Any] = {
        "format": FORMAT,
        "camera_model": "pinhole",
        "image_size": [width, height],
        "fps": film.fps,
        "source": {
            "type": "interpolation",
            "interpolation": "kochanek-bartels",
            "keyframes": [{"pose": poses[i], "fov": fovs[i]} for i in keys],
            "default_fov": fovs[0],
            "duration": seconds,
            "default_transition_duration": seconds / max(len(keys) - 1, 1),
            "time_interpolation": "time",
            "is_cycle": False,
            "tension": 0,
            "continuity": 0,
            "bias": 0,
            "distance_alpha": 1,
        },
        "frames": frames,
    }
    if film.appearances:
        content["appearances"] = [
            {"embedding_train_index": numbers[name], "image": name} if numbered else {"image": name}
            for name in film.appearances
        ]
    return json.dumps(content, indent=1) + "\n"
