"""What the model of a run shows: views in many appearances, from one to another, and what it takes for tourists.

Features of a view are rendered once and coloured for each appearance; where the field itself reads an appearance code
(NeRF-W, Ha-NeRF), each appearance is a rendering of its own. Views are rendered at a stride that keeps the whole under
a budget of arithmetic, so that a page of the paper's MLP on a CPU takes a minute too; memory is that of one view.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from torch import Tensor

from model.scene_model import SceneModel
from pipeline.judge import depth_picture
from pipeline.metrics import to_8bit
from pipeline.photos import Photos
from pipeline.render import (
    View,
    colour_view,
    interpolated,
    predicted_mask,
    read_appearance,
    render_view,
    training_appearance,
)
from pipeline.report.album import Album
from pipeline.report.blocks import Block, Grid, Note, Picture, Shot, Slider, Sliders, Strip
from pipeline.report.words import short

Item = TypeVar("Item")

VIEWS = 4
APPEARANCES = 5
FRAMES = 9  # of the strip between two appearances, both ends with it
MASKED = 6
CANDIDATES = 48  # photos among which appearances are looked for, and masks where they are cheap
SIDE = 320  # pixels of a picture here, at most
TINT = (225, 30, 120)  # of what is transient

# Multiplications and additions of a page's renderings; one core does some 3e10 a second.
BUDGET = {"cpu": 4e11, "cuda": 2e14}
LOOKUP = 80_000  # as many of them take as long as a point's way through the hash grids (measured on a CPU)


class Painter:
    """Renders views of a model at one stride, and colours them.

    Args:
        renderings: how many views will be rendered, for the budget.
    """

    def __init__(self, model: SceneModel, photos: Photos, views: Sequence[int], renderings: int) -> None:
        self.model, self.photos = model, photos
        self.device = next(model.parameters()).device
        self.stride = stride_of(model, photos, views, renderings, BUDGET.get(self.device.type, BUDGET["cpu"]))

    def view(self, index: int, code: Tensor | None = None) -> View:
        """A photo's view."""
        return render_view(self.model, self.photos.records[index], code, stride=self.stride)

    def pictures(self, index: int, appearances: Sequence[Tensor | None]) -> tuple[View, list[np.ndarray]]:
        """A photo's view, and its uint8 pictures (h, w, 3) in some appearances."""
        if not self.model.coded:
            view = self.view(index)
            return view, [to_8bit(colour_view(self.model, view, a), "round") for a in appearances]
        found = []
        for appearance in appearances:
            view = self.view(index, appearance)
            found.append(to_8bit(colour_view(self.model, view, appearance), "round"))
        return view, found


def stride_of(model: SceneModel, photos: Photos, views: Sequence[int], renderings: int, budget: float) -> int:
    """The smallest stride with which so many renderings cost no more than the budget and show no more than SIDE."""
    weights = sum(p.numel() for name, p in model.field.named_parameters() if not name.endswith("table"))
    a_pixel = model.field.points_a_ray() * (weights + (LOOKUP if model.spec.field == "hash" else 0))
    sizes = [(photos.records[i].height, photos.records[i].width) for i in views]
    pixels, longest = np.mean([h * w for h, w in sizes]), max(max(size) for size in sizes)
    affordable = math.ceil(math.sqrt(renderings * pixels * a_pixel / budget))
    return max(1, affordable, longest // SIDE)


def appearance_blocks(model: SceneModel, photos: Photos, album: Album) -> list[Block]:
    """Views x appearances, with depth, and the strip between two appearances that differ much."""
    views = spread(photos.indices("test") or photos.indices("val") or photos.indices("train"), VIEWS)
    if model.spec.appearance == "none":
        painter = Painter(model, photos, views, len(views))
        return [grid_of(painter, views, [], album), Note("This method has one appearance for all photos.")]
    lenders = apart(photos, spread(photos.indices("train"), CANDIDATES), APPEARANCES)
    lent = [training_appearance(model, photos, i) for i in lenders]
    renderings = len(views) * (len(lenders) + 1) + FRAMES if model.coded else len(views)
    painter = Painter(model, photos, views, renderings)
    blocks: list[Block] = [grid_of(painter, views, lenders, album)]
    if len(lent) >= 2 and lent[0] is not None and lent[1] is not None and lent[0].shape == lent[1].shape:
        names = " to that of ".join(short(name_of(photos, i)) for i in lenders[:2])
        blocks.append(strip_of(painter, views[0], lent[0], lent[1], f"From the appearance of {names}", album))
    return blocks


def grid_of(painter: Painter, views: Sequence[int], lenders: Sequence[int], album: Album) -> Grid:
    """A row a view: its photo, its depth, the view in its own appearance, and in that of each lender."""
    model, photos = painter.model, painter.photos
    lent = [training_appearance(model, photos, i) for i in lenders]
    own = model.encoder is not None or not lenders
    titles = ["photo", *(["its own appearance" if lenders else "rendered"] if own else [])]
    heads = [Shot(title) for title in (*titles, "depth")]
    heads += [Shot(f"as {short(name_of(photos, i))}", photo(photos, i, album)) for i in lenders]
    rows = []
    for index in views:
        mine = [read_appearance(model, photos.reference(index))] if own else []
        view, pictures = painter.pictures(index, [*mine, *lent])
        shots = [drawn(p, f"{name_of(photos, index)} rendered", album) for p in pictures]
        depth = drawn(depth_picture(view), f"depth of {name_of(photos, index)}, near is bright", album)
        first = Shot(f"{short(name_of(photos, index))}, {photos.records[index].split}", photo(photos, index, album))
        rows.append([first, *shots[: len(mine)], depth, *shots[len(mine) :]])
    return Grid("", heads, rows)


def strip_of(painter: Painter, index: int, a: Tensor, b: Tensor, title: str, album: Album) -> Strip:
    """One view from appearance a to b in equal steps of F^a, which is interpolated linearly."""
    shares = [i / (FRAMES - 1) for i in range(FRAMES)]
    _, pictures = painter.pictures(index, [interpolated(a, b, share) for share in shares])
    shots = [
        drawn(picture, f"{100 * share:.0f} % of the way between two appearances", album, f"{100 * share:.0f} %")
        for share, picture in zip(shares, pictures, strict=True)
    ]
    return Strip(title, shots)


def mask_blocks(model: SceneModel, photos: Photos, album: Album) -> list[Block]:
    """The training photos in which the model finds most that is transient, with and without it marked."""
    if model.spec.transient == "none":
        return [Note("This method takes every pixel of every photo for the place itself: it has no masks.")]
    train = photos.indices("train")
    costly = model.spec.transient == "uncertainty"
    chosen = spread(train, MASKED if costly else CANDIDATES)
    stride = Painter(model, photos, chosen, len(chosen)).stride if costly else 1
    found = {}
    for index in chosen:
        mask = predicted_mask(model, photos, index, stride)
        if mask is not None:
            found[index] = mask
    if not found:
        return [Note("The masks of this run are not in its shards.")]
    most = sorted(found, key=lambda i: -float(found[i].mean()))[:MASKED]
    sliders = []
    for index in most:
        small = photos.image(index)[stride // 2 :: stride, stride // 2 :: stride]
        name = name_of(photos, index)
        left = Shot("photo", album.add(small, f"training photo {name}", SIDE))
        marked = album.add(tinted(small, found[index]), f"{name} with what is transient marked", SIDE)
        caption = f"{100 * float((found[index] > 0.5).mean()):.0f} % transient"
        sliders.append(Slider(short(name), caption, left, Shot("mask", marked)))
    return [Sliders(sliders)]


def tinted(picture: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """A uint8 picture (h, w, 3), darker and in grey, and what a mask (h, w) in [0, 1] takes for transient in TINT."""
    grey = picture.mean(axis=-1, keepdims=True) * 0.8
    share = mask[..., None].clip(0, 1)
    coloured = np.array(TINT) * (0.45 + 0.55 * grey / 204)
    return ((1 - share) * grey + share * coloured).round().clip(0, 255).astype(np.uint8)


def spread(items: Sequence[Item], most: int) -> list[Item]:
    """At most `most` of the items, evenly spread."""
    if len(items) <= most:
        return list(items)
    return [items[i] for i in np.linspace(0, len(items) - 1, most).round().astype(int)]


def apart(photos: Photos, candidates: Sequence[int], most: int) -> list[int]:
    """Photos whose mean colours differ much: the two that differ most, then always the farthest from all before."""
    colours = np.array([photos.reference(i).reshape(-1, 3).mean(axis=0) for i in candidates])
    distances = np.linalg.norm(colours[:, None] - colours[None], axis=-1)
    chosen = list(dict.fromkeys(int(i) for i in np.unravel_index(distances.argmax(), distances.shape)))
    while len(chosen) < min(most, len(candidates)):
        nearest = distances[:, chosen].min(axis=1)
        nearest[chosen] = -1
        chosen.append(int(nearest.argmax()))
    return [candidates[i] for i in chosen]


def name_of(photos: Photos, index: int) -> str:
    """The photo's file name."""
    return photos.records[index].name


def photo(photos: Photos, index: int, album: Album) -> Picture:
    """A photo as the shards have it."""
    return album.add(photos.image(index), f"photo {name_of(photos, index)}", SIDE)


def drawn(picture: np.ndarray, alt: str, album: Album, caption: str = "") -> Shot:
    """A picture of ours."""
    return Shot(caption, album.add(picture, alt, SIDE))
