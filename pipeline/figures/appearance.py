"""Figures of appearances: views in those of other photos, of photos never trained on, and from one to another."""

from __future__ import annotations

from collections.abc import Sequence

from pipeline.errors import CrossrayError
from pipeline.figures.choose import (
    Lender,
    different,
    lender_of,
    photo_shown,
    sources_of,
    title,
    views_of,
    views_painted,
)
from pipeline.figures.sheet import Composed, Panel, Row, Sheet
from pipeline.painter import Painter

LENDERS = 5  # appearances of a figure, where the user says nothing
LOW = 0.75  # the row of photos above views is no higher than so many widths of a column


def transfer(
    painter: Painter,
    photos: Sequence[str] = (),
    views: Sequence[str] = (),
    columns: int | None = None,
    others: Sequence[str] = (),
) -> Composed:
    """Views of the scene (rows) in the appearances of photos (columns; the top row shows them).

    Args:
        photos: of the scene, or image files; by default `columns` training photos that differ most.
        others: image files of other places, beside these.
    """
    check_appearance(painter)
    names = [*(photos or different(painter.photos, painter.photos.indices("train"), columns or LENDERS)), *others]
    chosen = views_of(painter.photos, views)
    lenders = [lender_of(painter, name) for name in names]
    caption = (
        "Appearance transfer. Top: the photos whose appearance is taken. Left: photos of the views; beside each, the "
        "view rendered in the appearance of the photo above."
    )
    about = {"appearances": [l.source for l in lenders], "views": sources_of(painter.photos, chosen)}
    return Composed(lent(painter, chosen, lenders), caption, about)


def lent(painter: Painter, views: Sequence[int], lenders: Sequence[Lender]) -> Sheet:
    """A row of photos, and a row a view: its photo, and the view in the appearance of each."""
    head = Row("as in", (None, *(Panel(lender.picture, lender.title) for lender in lenders)), tall=LOW)
    rows = [head]
    appearances = [lender.F for lender in lenders]
    for index, pictures in zip(views, views_painted(painter, [(i, appearances) for i in views]), strict=True):
        photo = Panel(photo_shown(painter.photos, index), "photo" if index == views[0] else "")
        rows.append(Row(title(painter.photos, index), (photo, *map(Panel, pictures))))
    return Sheet(tuple(rows), even=True)


def unseen(
    painter: Painter, photos: Sequence[str] = (), views: Sequence[str] = (), columns: int | None = None
) -> Composed:
    """Photos that the model was not trained on, and its own view of each in the appearance that it reads of it; or,
    where `views` are named or one of the photos is an image file, these views in their appearances.

    Args:
        photos: test or validation photos, or image files; by default `columns` of the former that differ most.

    Raises:
        CrossrayError: the model reads no photo, or a photo was trained on.
    """
    check_appearance(painter)
    if painter.model.embedding is not None:
        raise CrossrayError(
            f"{painter.run}: method {painter.job.method} learned the appearance of each training photo "
            "(model.appearance: embedding) and reads none of other photos: there is no such figure"
        )
    scene = painter.photos
    candidates = sorted((*scene.indices("test"), *scene.indices("val")))
    if not photos and not candidates:
        raise CrossrayError(f"{painter.run}: all photos of the scene were trained on; --photos names image files")
    names = photos or different(scene, candidates, columns or LENDERS)
    known = {record.name: index for index, record in enumerate(scene.records)}
    for name in names:
        if name in known and scene.records[known[name]].split == "train":
            raise CrossrayError(f"{name}: was trained on; name test or validation photos, or image files")
    lenders = [lender_of(painter, name) for name in names]
    about = {"appearances": [l.source for l in lenders]}
    if views or not all(name in known for name in names):
        chosen = views_of(scene, views)
        caption = (
            "Unseen appearances. Top: photos that the model was not trained on; below, views in their appearances."
        )
        return Composed(lent(painter, chosen, lenders), caption, about | {"views": sources_of(scene, chosen)})
    orders = [(known[name], [lender.F]) for name, lender in zip(names, lenders, strict=True)]
    rows = (
        Row("photo", tuple(Panel(l.picture, l.title) for l in lenders)),
        Row("rendered", tuple(Panel(picture) for (picture,) in views_painted(painter, orders))),
    )
    caption = (
        "Unseen appearances. Top: photos that the model was not trained on. Below: the same views, rendered in the "
        "appearance that is read of each photo."
    )
    return Composed(Sheet(rows, even=False), caption, about)


def interpolation(
    painter: Painter, photos: Sequence[str] = (), views: Sequence[str] = (), columns: int | None = None
) -> Composed:
    """Views (rows) from the appearance of one photo to that of another, in `columns` equal steps of F^a, both ends
    among them.

    Args:
        photos: two; by default the two training photos that differ most.

    Raises:
        CrossrayError: not two photos, or fewer than two columns.
    """
    check_appearance(painter)
    names = list(photos) or different(painter.photos, painter.photos.indices("train"), 2)
    if len(names) != 2:
        raise CrossrayError(
            f"{len(names)} photos, and an interpolation goes from one to another: --photos A,B names two"
        )
    count = columns or LENDERS
    if count < 2:
        raise CrossrayError("--columns 1: an interpolation has two ends, so two columns at least")
    a, b = (painter.read(name) for name in names)
    first, last = (lender_of(painter, name) for name in names)
    shares = [i / (count - 1) for i in range(count)]
    chosen = views_of(painter.photos, views)
    ends = (Panel(first.picture, first.title), *[None] * (count - 2), Panel(last.picture, last.title))
    rows = [Row("as in", ends, tall=LOW)]
    between = [painter.between(a, b, share) for share in shares]
    for index, pictures in zip(chosen, views_painted(painter, [(i, between) for i in chosen]), strict=True):
        heads = [f"{100 * share:.0f} %" if index == chosen[0] else "" for share in shares]
        panels = tuple(Panel(picture, head) for picture, head in zip(pictures, heads, strict=True))
        rows.append(Row(title(painter.photos, index), panels))
    caption = (
        "From one appearance to another. Top: the two photos. Below: views in appearances between them, linear in F^a; "
        "percent of the way."
    )
    about = {"appearances": [first.source, last.source], "shares": shares, "views": sources_of(painter.photos, chosen)}
    return Composed(Sheet(tuple(rows), even=True), caption, about)


def check_appearance(painter: Painter) -> None:
    """CrossrayError for a model whose pictures do not depend on an appearance."""
    if not painter.has_appearance:
        raise CrossrayError(
            f"{painter.run}: method {painter.job.method} has no appearance (model.appearance: none): all its pictures "
            "of a view are the same one"
        )
