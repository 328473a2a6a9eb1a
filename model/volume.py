"""Volume rendering of any number of channels (NeRF, equation 3; CR-NeRF renders F^cr with it).

Notation: along a ray with samples at t_i, delta_i = t_{i+1} - t_i, alpha_i = 1 - exp(-delta_i sigma_i), and
the weight of sample i is w_i = alpha_i * prod_{j<i} (1 - alpha_j). Weights sum to at most 1; the rest of the
light is lost.
"""

from __future__ import annotations

import torch
from torch import Tensor


def intervals(t: Tensor, last: float = 1e2) -> Tensor:
    """Lengths delta (R, S) of the samples at t (R, S).

    The last sample has no successor; it gets `last`, so that any density there is opaque (released code:
    100).
    """
    return torch.cat([t.diff(dim=-1), torch.full_like(t[..., :1], last)], dim=-1)


def render_weights(density: Tensor, deltas: Tensor) -> Tensor:
    """Weights w (R, S) of density (R, S), in 1 / scene unit, over deltas (R, S).

    Negative densities (a density with noise added can be negative) count as 0.
    """
    # In logarithms: the product of (1 - alpha) is exp of a sum, which neither divides by a vanished factor in
    # the gradient nor rounds thin matter (delta * sigma < 1e-7) to nothing, as 1 - exp(.) would.
    depth = deltas * torch.relu(density)
    before = torch.cumsum(depth[..., :-1], dim=-1)
    before = torch.cat([torch.zeros_like(depth[..., :1]), before], dim=-1)
    return torch.exp(-before) * -torch.expm1(-depth)


def composite(weights: Tensor, values: Tensor) -> Tensor:
    """sum_i w_i values_i: weights (R, S), values (R, S, C) -> (R, C). No background, no division by sum w."""
    return torch.einsum("...s,...sc->...c", weights, values)
