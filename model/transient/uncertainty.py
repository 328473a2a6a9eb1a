"""Transients as matter of their own, with an uncertainty (NeRF-W, in the form of the public nerf_pl code).

A second head on the field gives, for one photo, a density sigma_t, a feature and a beta at each point. Both kinds of
matter are rendered together in training (`model.volume.joint_weights`); a picture without transients leaves the second
one out. beta is composited with the transient weights, and a floor is added *after* that (the paper adds it before).
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from model.methods import TRANSIENT_CODE


class Transient(NamedTuple):
    """What one photo has in front of the scene, at points (...)."""

    density: Tensor  # (...,) > 0, in 1 / scene unit
    features: Tensor  # (..., channels)
    beta: Tensor  # (...,) > 0, a standard deviation in units of colour, no floor added


class TransientHead(nn.Module):
    """An MLP on what the field knows of a point, from no direction, and on the photo's transient code.

    Args:
        inputs: channels of what the field knows.
        channels: C of a feature.
        bounded: features are kept in (0, 1) by a sigmoid, as colours are; without it they are free.
        width, depth: of the hidden layers.
        density_bias: added before the softplus. At 0 (nerf_pl) untrained matter has a density of about 0.69 everywhere,
            which is fog in a scene of a few units, and a fast field learns to live with it before it has cleared.
    """

    def __init__(
        self, inputs: int, channels: int, bounded: bool, width: int = 128, depth: int = 4, density_bias: float = 0.0
    ) -> None:
        super().__init__()
        self.bounded, self.density_bias = bounded, density_bias
        sizes = [inputs + TRANSIENT_CODE] + [width] * depth
        self.layers = nn.Sequential(*(part for pair in pairwise(sizes) for part in (nn.Linear(*pair), nn.ReLU())))
        self.density = nn.Linear(width, 1)
        self.features = nn.Linear(width, channels)
        self.beta = nn.Linear(width, 1)

    def forward(self, bottleneck: Tensor, code: Tensor) -> Transient:
        """bottleneck: (..., inputs). code: (..., TRANSIENT_CODE), or anything that broadcasts: (R, 1, TRANSIENT_CODE)
        serves all samples of a ray."""
        code = code.expand(*bottleneck.shape[:-1], -1)
        h = self.layers(torch.cat([bottleneck, code], dim=-1))
        features = self.features(h)
        return Transient(
            functional.softplus(self.density(h) + self.density_bias).squeeze(-1),
            torch.sigmoid(features) if self.bounded else features,
            functional.softplus(self.beta(h)).squeeze(-1),
        )
