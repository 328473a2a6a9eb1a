"""The camera path that a browser records: key views, saved for `crossray render`.

RUN/paths/<name>.json       nerfstudio's camera_path.json, with the appearances beside it
RUN/paths/photos/<hash>.*   photos that are not of the scene, whose appearances a path has
"""

from __future__ import annotations

import hashlib
import io
import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from pipeline.errors import CrossrayError
from pipeline.files import atomic_write, resolved
from pipeline.pictures import FORMATS
from pipeline.views.camera import Camera
from pipeline.views.nerfstudio import write_camera_path
from pipeline.views.path import FPS, CameraPath, Frame
from pipeline.views.smooth import between, same_size, travel_times

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
MOST_KEYS = 200


@dataclass(frozen=True)
class Light:
    """One photo that an appearance is of."""

    name: str  # of a photo of the scene, or what a browser called its own
    content: bytes | None = None  # the file, of one that is not of the scene


@dataclass(frozen=True)
class Key:
    """A key view: a camera, and the appearance as shares of photos (with sum 1; none where there is no appearance)."""

    camera: Camera
    shares: tuple[tuple[Light, float], ...] = ()

    @property
    def said(self) -> str:
        """The appearance in words."""
        return " + ".join(f"{share:.0%} {light.name}" if share < 1 else light.name for light, share in self.shares)


def path_file(run: Path, name: str) -> Path:
    """Where a path of this name is saved. CrossrayError: it is no plain name."""
    if not NAME.fullmatch(name):
        raise CrossrayError(f"{name[:80]!r} is no name for a path: letters, digits, - and _, at most 64 of them")
    return run / "paths" / f"{name}.json"


def render_line(run: Path, file: Path) -> str:
    """The command that makes a film of a saved path."""
    return f"crossray render {shlex.quote(str(run))} --view {shlex.quote(str(file))} --out film.mp4"


def film_of(keys: Sequence[Key], seconds: float, names: dict[Light, str]) -> CameraPath:
    """A flight through key views, `seconds` from one to the next on average, whose appearance goes along.

    Args:
        names: what a path calls each light.

    Raises:
        CrossrayError: there is no key view, or the film is too long.
    """
    if not keys:
        raise CrossrayError("there is no key view yet: fly somewhere, and add it")
    if len(keys) == 1:
        moments, times, cameras = np.zeros(1), np.zeros(1), [keys[0].camera]
    else:
        frames = round(seconds * (len(keys) - 1) * FPS) + 1
        stops = same_size([key.camera for key in keys])
        cameras, times = between(stops, frames), travel_times(stops)
        share = np.arange(frames) / max(frames - 1, 1)
        moments = times[-1] * share * share * (3 - 2 * share)  # as the cameras ease in and out
    if not names:
        return CameraPath(tuple(Frame(camera) for camera in cameras))
    lights = list(names)
    weights = np.zeros((len(keys), len(lights)))
    for row, key in zip(weights, keys, strict=True):
        for light, share_of in key.shares:
            row[lights.index(light)] += share_of
    found = np.column_stack([np.interp(moments, times, column) for column in weights.T])
    found /= found.sum(axis=1, keepdims=True)
    frames_of = tuple(Frame(camera, tuple(row)) for camera, row in zip(cameras, found.tolist(), strict=True))
    return CameraPath(frames_of, appearances=tuple(names.values()))


def save_path(run: Path, name: str, keys: Sequence[Key], seconds: float, scale: float) -> Path:
    """Write a path, in the units and world of the scene's COLMAP model, and return its file.

    Args:
        scale: COLMAP units per scene unit.

    Raises:
        CrossrayError: as `path_file` and `film_of`; nothing is written then.
    """
    file = path_file(run, name)
    names: dict[Light, str] = {}
    for key in keys:
        for light, _ in key.shares:
            names.setdefault(light, light.name if light.content is None else str(own_file(run, light.content)))
    film = film_of(keys, seconds, names)
    for light, kept in names.items():
        if light.content is not None:
            atomic_write(Path(kept), light.content)
    write_camera_path(file, film, scale)
    return file


def own_file(run: Path, content: bytes) -> Path:
    """Where a photo that is not of the scene is kept: a name that nobody chose, as its content says."""
    with Image.open(io.BytesIO(content), formats=FORMATS) as image:
        kind = (image.format or "image").lower()
    return resolved(run) / "paths" / "photos" / f"{hashlib.sha256(content).hexdigest()[:16]}.{kind}"
