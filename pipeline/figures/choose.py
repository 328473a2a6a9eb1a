"""Which photos and views a figure shows, where the user names none: always the same ones of the same scene."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image
from torch import Tensor

from pipeline.appearances import Read, read_picture
from pipeline.errors import CrossrayError
from pipeline.painter import Painter
from pipeline.photos import Photos
from pipeline.progress import shown
from pipeline.report.gallery import apart, spread
from pipeline.views.camera import Camera, camera_of, resized

SIDE = 512  # pixels of the longer side of a picture, at most: some 300 an inch at the widest that is printed
CANDIDATES = 48  # photos among which is chosen, evenly spread over all
DEFAULT_VIEWS = 3


class Lender(NamedTuple):
    """A photo whose appearance is used."""

    title: str
    picture: np.ndarray  # uint8 (h, w, 3)
    F: Tensor | None
    source: dict[str, str]  # photo, sha256 of its file


def lender_of(painter: Painter, name: str) -> Lender:
    """A photo of the scene by its name, or an image file. CrossrayError as `Painter.read`."""
    read: Read = painter.read(name)
    names = [record.name for record in painter.photos.records]
    picture = painter.photos.image(names.index(name)) if name in names else read_picture(Path(name))
    return Lender(title_of(name), reduced_to(picture, size_of(picture.shape)), read.F, read.source)


def views_of(photos: Photos, names: Sequence[str], count: int = DEFAULT_VIEWS) -> list[int]:
    """The photos of these names, or else `count` test views, evenly spread (without any, those of another split)."""
    if names:
        return [index_of(photos, name) for name in names]
    return spread(photos.indices("test") or photos.indices("val") or photos.indices("train"), count)


def different(photos: Photos, candidates: Sequence[int], count: int) -> list[str]:
    """Names of `count` photos whose mean colours differ most: the two that differ most, then always the farthest."""
    return [photos.records[i].name for i in apart(photos, spread(candidates, CANDIDATES), count)[:count]]


def index_of(photos: Photos, name: str) -> int:
    """Which photo of the scene has this name.

    Raises:
        CrossrayError: none.
    """
    names = [record.name for record in photos.records]
    if name in names:
        return names.index(name)
    close = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    guess = f"; did you mean {close[0]!r}?" if close else f" (the first is {names[0]!r})"
    raise CrossrayError(f"{name}: not the name of a photo of the scene{guess}")


def title_of(name: str) -> str:
    """What stands on a figure for a photo: its name without folder and ending, which take room and tell nothing."""
    return Path(name).stem


def title(photos: Photos, index: int) -> str:
    """The same for a photo of the scene."""
    return title_of(photos.records[index].name)


def sources_of(photos: Photos, indices: Sequence[int]) -> list[dict[str, str]]:
    """Name and SHA-256 of photos, for the record."""
    return [{"photo": photos.records[i].name, "sha256": photos.records[i].source_sha256} for i in indices]


# -------------------------------------------------------------------------------------------------------- pictures


def size_of(shape: Sequence[int]) -> tuple[int, int]:
    """Width and height at which a picture of (h, w, ...) is shown: its own, or smaller so that no side is over SIDE."""
    scale = min(1.0, SIDE / max(shape[:2]))
    return max(1, round(shape[1] * scale)), max(1, round(shape[0] * scale))


def reduced_to(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A picture, uint8 (h, w, 3) or float32 (h, w), at a width and height."""
    if (picture.shape[1], picture.shape[0]) == size:
        return picture
    return np.asarray(Image.fromarray(picture).resize(size, Image.Resampling.BOX))


def photo_shown(photos: Photos, index: int) -> np.ndarray:
    """A photo of the scene as figures show it: uint8 (h, w, 3)."""
    picture = photos.image(index)
    return reduced_to(picture, size_of(picture.shape))


def camera_shown(photos: Photos, index: int) -> Camera:
    """The camera of a photo as figures show it."""
    record = photos.records[index]
    return resized(camera_of(record), *size_of((record.height, record.width)))


def views_painted(
    painter: Painter, orders: Sequence[tuple[int, Sequence[Tensor | None]]]
) -> Iterator[list[np.ndarray]]:
    """The views of photos, each in some appearances, with a progress line."""
    return shown(map, "rendering views")(
        lambda order: painted(painter, camera_shown(painter.photos, order[0]), order[1]), orders
    )


def painted(painter: Painter, camera: Camera, appearances: Sequence[Tensor | None]) -> list[np.ndarray]:
    """A view in some appearances, uint8 (h, w, 3) each. Memory: the view's features, SIDE^2 pixels at most."""
    if painter.coded:
        return [painter.picture(camera, F).rgb for F in appearances]
    return painter.paint(painter.view(camera), appearances)
