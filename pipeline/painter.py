"""A trained run that paints any view in any appearance.

An appearance is chosen once for many views: content statistics are those of `pipeline.appearances.fixed_statistics`,
so that no view decides its own colours and nothing flickers along a path (design of the method: a picture is one affine
map of a view's features). Features of a view are rendered once and painted in as many appearances as one likes, but
where the field itself reads the appearance (NeRF-W, Ha-NeRF).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from model.appearance.crossray import ContentStatistics
from pipeline.appearances import Read, find_appearance, fixed_statistics
from pipeline.metrics import to_8bit
from pipeline.render import Pinhole, View, colour_view, interpolated, recoloured, render_view
from pipeline.runs import load_run, photos_of
from pipeline.views.camera import Camera

STRIPE = 2**18  # pixels of a picture whose features are held at once: 64 MiB of 64 channels


class Picture(NamedTuple):
    """A painted view."""

    rgb: np.ndarray  # uint8 (h, w, 3)
    depth: np.ndarray  # float32 (h, w): mean distance of what is seen, sum w t / sum w, scene units along the ray
    accumulation: np.ndarray  # float32 (h, w) in [0, 1]


class Painter:
    """A run's checkpoint (the newest, or of `step`) with the photos that it was trained on.

    Raises:
        CrossrayError: the run or its photos cannot be used.
    """

    def __init__(self, run: Path, step: int | None = None, device: torch.device | None = None) -> None:
        self.run = run
        self.job, self.model, self.checkpoint = load_run(run, step, device)
        self.photos = photos_of(self.job, self.checkpoint)

    @property
    def coded(self) -> bool:
        """Whether a view is another one for each appearance: then it has to be rendered anew."""
        return self.model.coded

    @property
    def has_appearance(self) -> bool:
        """Whether pictures depend on an appearance at all."""
        return self.model.spec.appearance != "none"

    @cached_property
    def content(self) -> ContentStatistics | None:
        """Statistics for all views; None for a model without a transform."""
        return fixed_statistics(self.model, self.photos)[0]

    def read(self, name: str) -> Read:
        """The appearance of a photo of the scene by its name, or of any image file. CrossrayError: there is none."""
        return find_appearance(self.model, self.photos, name)

    def between(self, a: Read, b: Read, share: float) -> Tensor | None:
        """F^a `share` of the way from one appearance to the other."""
        return None if a.F is None or b.F is None else interpolated(a.F, b.F, share)

    def view(self, camera: Pinhole, F: Tensor | None = None, stride: int = 1) -> View:
        """A view, before colour: every `stride`-th pixel of every `stride`-th row.

        Args:
            F: the appearance, for a coded model; others do not need it.
        """
        return render_view(self.model, camera, F if self.coded else None, stride=stride)

    def paint(self, view: View, appearances: Sequence[Tensor | None]) -> list[np.ndarray]:
        """The view in each appearance F^a, uint8 (h, w, 3); of a coded model, in the one that it was rendered with."""
        if self.model.decoder is None:
            return [to_8bit(colour_view(self.model, view, None), "round")] * len(appearances)
        if self.model.transform is None:
            return recoloured(view, self.model.colour_map(None, None)) * len(appearances)
        F = torch.cat([f for f in appearances if f is not None])
        return recoloured(view, self.model.colour_map(self.content, F))

    def picture(self, camera: Camera, F: Tensor | None) -> Picture:
        """A view in one appearance. Memory: the picture, and the features of STRIPE pixels; since the view decides no
        statistics, in stripes it is the same picture.
        """
        stripes = []
        for camera_part in stripes_of(camera):
            view = self.view(camera_part, F)
            (rgb,) = self.paint(view, [F])
            depth = view.depth / view.accumulation.clamp(min=1e-3)
            stripes.append(Picture(rgb, depth.cpu().numpy(), view.accumulation.cpu().numpy()))
        return Picture(*(np.concatenate(parts) for parts in zip(*stripes, strict=True)))


def stripes_of(camera: Camera) -> list[Camera]:
    """The camera's picture as stripes of whole rows, from the top, of at most STRIPE pixels (but one row at least)."""
    rows = max(1, STRIPE // camera.width)
    return [
        replace(camera, height=min(rows, camera.height - top), cy=camera.cy - top)
        for top in range(0, camera.height, rows)
    ]
