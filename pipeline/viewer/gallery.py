"""What all browsers are shown alike: made once, before the first one comes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.painter import Painter
from pipeline.viewer.lights import names_of
from pipeline.viewer.place import Place, evenly
from pipeline.viewer.standing import Pace
from pipeline.viewer.strip import strip_style

THUMBNAILS = 24  # of the strip, at most


class Gallery(NamedTuple):
    """A trained run, ready to be looked at."""

    painter: Painter
    place: Place
    pace: Pace
    side: int  # pixels of a sharp picture's long side, at most
    names: tuple[str, ...]  # photos whose appearance can be chosen; none where the run knows no appearance
    strip: tuple[str, ...]  # those of the thumbnails
    style: str  # the faces of the strip's buttons


def open_gallery(painter: Painter, side: int) -> Gallery:
    """Read what a viewer of this run shows. The statistics of its appearances are taken, for seconds."""
    photos = painter.photos
    train = photos.indices("train")
    place = Place([photos.records[i] for i in train], np.array(photos.manifest.scene.box))
    if not painter.has_appearance:
        return Gallery(painter, place, Pace(), side, (), (), "")
    painter.content  # noqa: B018 (or the first browser would wait for it)
    chosen = evenly(train, THUMBNAILS)
    strip = tuple(photos.records[i].name for i in chosen)
    style = strip_style([photos.image(i) for i in chosen])
    return Gallery(painter, place, Pace(), side, names_of(painter), strip, style)
