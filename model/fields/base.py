"""What every field gives back: samples along rays with weights, ready to be composited."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from model.volume import composite


class Rays(NamedTuple):
    """R rays. Directions are unit vectors, so t is a distance in scene units."""

    origins: Tensor  # (R, 3)
    directions: Tensor  # (R, 3)
    near: Tensor  # (R,)
    far: Tensor  # (R,)


class Rendering(NamedTuple):
    """R rays, composited."""

    features: Tensor  # (R, C)
    depth: Tensor  # (R,) sum of w t, scene units
    accumulation: Tensor  # (R,) sum of w, in [0, 1]


class Level(NamedTuple):
    """One sampling of R rays at S points each."""

    t: Tensor  # (R, S)
    weights: Tensor  # (R, S)
    features: Tensor  # (R, S, C)
    background: Tensor | None = None  # (R, C): what a ray sees behind its last sample

    def composite(self) -> Rendering:
        """Volume rendering of any number of channels (eq. 'nerf2'); a background takes the weight that is left."""
        features = composite(self.weights, self.features)
        accumulation = self.weights.sum(dim=-1)
        if self.background is not None:
            features = features + (1 - accumulation)[:, None] * self.background
        return Rendering(features, (self.weights * self.t).sum(dim=-1), accumulation)


class March(NamedTuple):
    """A field along rays: its levels, the last of which is the picture, and losses of its own."""

    levels: list[Level]
    losses: dict[str, Tensor]


class Field(Protocol):
    """(x, d) -> density, feature, along rays, with its own way of choosing samples."""

    def points_a_ray(self, samples: tuple[int, int] | None = None) -> int:
        """Points at which the field is evaluated for each ray, at most, in one pass of its networks."""
        ...

    def march(
        self, rays: Rays, generator: torch.Generator | None = None, samples: tuple[int, int] | None = None
    ) -> March:
        """Sample rays and evaluate.

        Args:
            rays: R rays.
            generator: source of jitter and density noise in training; None renders without either.
            samples: (first, second) numbers of samples instead of the training ones.
        """
        ...
