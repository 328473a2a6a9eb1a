"""A trained field in one appearance: what rays see, and how far away it is."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from model.bake import bake, check_bakeable
from model.fields.base import Level, Rays, at_least_float32
from model.methods import ModelSpec
from pipeline.metrics import to_8bit
from pipeline.painter import Painter
from pipeline.render import View

OPAQUE = 0.9  # share of a ray's light that must come from matter for a surface to be there
END = 0.95  # share of the way to `far` beyond which nothing is a surface: NeRF's last sample is opaque, sky or not


class Seen(NamedTuple):
    """What R rays see; distances are in scene units along the ray."""

    colours: np.ndarray  # (R, 3) uint8
    distance: np.ndarray  # (R,) float32, to the surface; 0 where there is none
    spread: np.ndarray  # (R,) float32: the middle half of the ray's light comes from an interval of this length


class Shown:
    """A run in one appearance F^a, baked where its method can be: then 3 channels are composited instead of C."""

    def __init__(self, painter: Painter, F: Tensor | None) -> None:
        self.painter, self.F = painter, F
        model = painter.model
        self.device, self.pixel_center = next(model.parameters()).device, model.spec.pixel_center
        self.baked = bake(model, model.colour_map(painter.content, F)) if bakeable(model.spec) else None

    @torch.no_grad()
    def look(self, rays: Rays) -> Seen:
        """What rays see, none of them or more. Memory: the answer, and the samples of one chunk of rays.

        The surface is where half of the ray's light is reached, not at the mean, which mist in front of it and what
        shines through draw away from it.
        """
        none = (np.empty((0, 3), np.uint8), rays.near[:0], rays.near[:0])
        parts = [none, *((self.coloured(level), *surface(level)) for level in self.levels(rays))]
        colours, distances, spreads = zip(*parts, strict=True)
        distance = torch.cat(distances)
        distance = torch.where(distance < END * rays.far, distance, 0)
        return Seen(np.concatenate(colours), distance.cpu().numpy(), torch.cat(spreads).cpu().numpy())

    def levels(self, rays: Rays) -> Iterator[Level]:
        """Samples of the rays, chunk by chunk; a baked field's features have 3 channels."""
        if self.baked is None:
            code = self.F if self.painter.coded else None
            yield from (march.levels[-1] for march in self.painter.model.marches(rays, None, None, code))
        else:
            field = self.baked.field
            yield from (field.march(part).levels[-1] for part in field.chunks(rays, None, None))

    def coloured(self, level: Level) -> np.ndarray:
        """(R, 3) uint8."""
        features, depth, accumulation = (at_least_float32(x) for x in level.composite())
        if self.baked is not None:
            return to_8bit(torch.sigmoid(features + self.baked.b).cpu().numpy(), "round")
        row = View((1, len(depth)), features, depth[None], accumulation[None])
        return self.painter.paint(row, [self.F])[0][0]


def bakeable(spec: ModelSpec) -> bool:
    """Whether `model.bake.bake` takes a model of this spec."""
    try:
        check_bakeable(spec)
    except ValueError:
        return False
    return True


def surface(level: Level) -> tuple[Tensor, Tensor]:
    """(R,) distance to where half of each ray's light is reached, 0 where less than OPAQUE of it comes from matter, and
    (R,) length of the interval between a quarter and three quarters.
    """
    reached = at_least_float32(level.weights).cumsum(dim=-1)
    whole = reached[:, -1:]
    index = torch.searchsorted(reached, whole * reached.new_tensor([0.25, 0.5, 0.75]))
    quarter, half, rest = level.t.gather(1, index.clamp(max=level.t.shape[1] - 1)).unbind(dim=1)
    return torch.where(whole[:, 0] >= OPAQUE, half, 0), rest - quarter
