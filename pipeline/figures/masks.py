"""The figure of masks: what a model takes for transient in training photos, and its views without it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.errors import CrossrayError
from pipeline.figures.choose import (
    CANDIDATES,
    SIDE,
    camera_shown,
    index_of,
    photo_shown,
    reduced_to,
    sources_of,
    title,
    views_painted,
)
from pipeline.figures.sheet import Bar, Composed, Panel, Row, Sheet, coloured
from pipeline.painter import Painter
from pipeline.photos import Photos
from pipeline.render import predicted_mask
from pipeline.report.gallery import spread, tinted

PHOTOS = 5
LOOK = 48  # pixels of the longer side at which candidates are compared
BAR = Bar("transient probability", 0, 1, "magma")


def masks(painter: Painter, photos: Sequence[str] = (), columns: int | None = None) -> Composed:
    """Training photos (columns): the photo, its transient probability M, the photo with M marked, and the photo's view
    in its own appearance, without what is transient.

    Args:
        photos: training photos; by default `columns` of those with most that is transient.

    Raises:
        CrossrayError: the model has no masks, or none of a photo.
    """
    spec, scene = painter.model.spec, painter.photos
    if spec.transient == "none":
        raise CrossrayError(
            f"{painter.run}: method {painter.job.method} has no masks (model.transient: none): it takes every pixel of "
            "every photo for the place itself"
        )
    chosen = [index_of(scene, name) for name in photos] or most_transient(painter, columns or PHOTOS)
    for index in chosen:
        if scene.records[index].split != "train":
            raise CrossrayError(
                f"{scene.records[index].name}: is no training photo; this figure shows what training left out"
            )
    found = [mask_shown(painter, index) for index in chosen]
    pictures = [photo_shown(scene, index) for index in chosen]
    titles = [title(scene, index) for index in chosen]
    appearances = [[painter.read(scene.records[index].name).F] for index in chosen]
    cleaned = views_painted(painter, list(zip(chosen, appearances, strict=True)))
    rows = (
        Row("photo", tuple(map(Panel, pictures, titles))),
        Row("M", tuple(Panel(coloured(mask, BAR)) for mask in found), BAR),
        Row("marked", tuple(Panel(tinted(p, m)) for p, m in zip(pictures, found, strict=True))),
        Row("rendered", tuple(Panel(picture) for (picture,) in cleaned)),
    )
    caption = (
        "What is transient. From the top: training photos; the transient probability M of their pixels; both together; "
        "the same views, rendered in the appearance of the photo."
    )
    return Composed(Sheet(rows, even=False), caption, {"photos": sources_of(scene, chosen), "masks": spec.transient})


def most_transient(painter: Painter, count: int) -> list[int]:
    """The training photos with the greatest mean M among CANDIDATES, the most first, those without a mask left out."""
    shares: dict[int, float] = {}
    for index in spread(painter.photos.indices("train"), CANDIDATES):
        mask = predicted_mask(painter.model, painter.photos, index, stride_to(painter.photos, index, LOOK))
        if mask is not None:
            shares[index] = float(mask.mean())
    if not shares:
        raise CrossrayError(f"{painter.run}: model.transient is fixed, and the shards of this run hold no masks")
    return sorted(shares, key=lambda index: -shares[index])[:count]


def mask_shown(painter: Painter, index: int) -> np.ndarray:
    """M of a training photo, float32 (h, w), at the size at which the photo is shown."""
    mask = predicted_mask(painter.model, painter.photos, index, stride_to(painter.photos, index, SIDE))
    if mask is None:
        raise CrossrayError(f"{painter.photos.records[index].name}: the shards of this run hold no mask of it")
    camera = camera_shown(painter.photos, index)
    return reduced_to(mask, (camera.width, camera.height))


def stride_to(photos: Photos, index: int, side: int) -> int:
    """The greatest stride that leaves `side` pixels of a photo's longer side, or 1."""
    record = photos.records[index]
    return max(1, max(record.width, record.height) // side)
