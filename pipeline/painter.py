"""A trained run that paints any view in any appearance.

An appearance is chosen once for many views: content statistics are those of `pipeline.appearances.fixed_statistics`,
so that no view decides its own colours and nothing flickers along a path (design of the method: a picture is one affine
map of a view's features). Features of a view are rendered once and painted in as many appearances as one likes, but
where the field itself reads the appearance (NeRF-W, Ha-NeRF).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from model.appearance.crossray import ContentStatistics
from pipeline.appearances import Read, find_appearance, fixed_statistics
from pipeline.metrics import to_8bit
from pipeline.render import Pinhole, View, colour_view, interpolated, recoloured, render_view
from pipeline.runs import load_run, photos_of


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
