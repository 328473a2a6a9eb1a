"""What every field gives back: samples along rays with weights, ready to be composited."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from model.transient.uncertainty import Transient
from model.volume import composite, joint_weights


class Rays(NamedTuple):
    """R rays. Directions are unit vectors, so t is a distance in scene units."""

    origins: Tensor  # (R, 3)
    directions: Tensor  # (R, 3)
    near: Tensor  # (R,)
    far: Tensor  # (R,)


class Codes(NamedTuple):
    """What the photo of each ray is known by, at the points of a field; None where the field does not ask for it."""

    appearance: Tensor | None = None  # (R, CODE)
    other: Tensor | None = None  # (R, CODE): a second appearance, for losses only
    transient: Tensor | None = None  # (R, TRANSIENT_CODE)


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

    def with_constant(self) -> Level:
        """One more channel that is 1 everywhere: composited, it is the sum of the weights."""
        background = None if self.background is None else append_one(self.background)
        return self._replace(features=append_one(self.features), background=background)


class TransientSamples(NamedTuple):
    """The transient field at the points of a level, seen together with the static one (NeRF-W)."""

    static_weights: Tensor  # (R, S) of the static field behind both
    weights: Tensor  # (R, S) of the transient field behind both
    passed: Tensor  # (R,) light that passes both
    features: Tensor  # (R, S, C)
    density: Tensor  # (R, S)
    beta: Tensor  # (R, S)

    def composite(self, static: Level) -> Tensor:
        """Features (R, C) of both fields together; the background is seen through both."""
        features = composite(self.static_weights, static.features) + composite(self.weights, self.features)
        if static.background is not None:
            features = features + self.passed[:, None] * static.background
        return features

    def with_constant(self) -> TransientSamples:
        """As Level.with_constant."""
        return self._replace(features=append_one(self.features))

    def opacity(self) -> Tensor:
        """(R,) share of a ray's light that comes from the transient field."""
        return self.weights.sum(dim=-1)

    def uncertainty(self) -> Tensor:
        """(R,) sum of w beta: the standard deviation of a ray's colour, without its floor."""
        return (self.weights * self.beta).sum(dim=-1)


class March(NamedTuple):
    """A field along rays: its levels, the last of which is the picture, and losses of its own."""

    levels: list[Level]
    losses: dict[str, Tensor]
    other: Level | None = None  # the last level in the other appearance
    transient: TransientSamples | None = None  # at the points of the last level


class Field(Protocol):
    """(x, d) -> density, feature, along rays, with its own way of choosing samples."""

    def points_a_ray(self, samples: tuple[int, int] | None = None) -> int:
        """Points at which the field is evaluated for each ray, at most, in one pass of its networks."""
        ...

    def march(
        self,
        rays: Rays,
        generator: torch.Generator | None = None,
        samples: tuple[int, int] | None = None,
        codes: Codes = Codes(),
    ) -> March:
        """Sample rays and evaluate.

        Args:
            rays: R rays.
            generator: source of jitter and density noise in training; None renders without either.
            samples: (first, second) numbers of samples instead of the training ones.
            codes: the appearance code where the field was made for one; the transient field and the other appearance
                are evaluated where their codes are given.
        """
        ...


def append_one(x: Tensor) -> Tensor:
    """(..., C) -> (..., C + 1)."""
    return torch.cat([x, torch.ones_like(x[..., :1])], dim=-1)


def at_least_float32(x: Tensor) -> Tensor:
    """bfloat16 -> float32; float32 and float64 stay what they are."""
    return x.to(torch.promote_types(x.dtype, torch.float32))


def points(rays: Rays, t: Tensor) -> Tensor:
    """Points (R, S, 3) at distances t (R, S)."""
    return rays.origins[:, None] + t[..., None] * rays.directions[:, None]


def at_points(code: Tensor | None) -> Tensor | None:
    """Codes (R, n) of rays as (R, 1, n), for all points of each."""
    return None if code is None else code[:, None]


def transient_samples(head: Transient, static_density: Tensor, deltas: Tensor) -> TransientSamples:
    """What a transient head gives at the points of a level, with both fields' weights behind one another."""
    density = at_least_float32(head.density)
    static_weights, weights = joint_weights(static_density, density, deltas)
    passed = torch.exp(-(deltas * (torch.relu(static_density) + density)).sum(dim=-1))
    return TransientSamples(
        static_weights, weights, passed, at_least_float32(head.features), density, at_least_float32(head.beta)
    )
