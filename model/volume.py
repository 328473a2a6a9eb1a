"""Volume rendering of any number of channels (NeRF, equation 3; CR-NeRF renders F^cr with it).

Notation: along a ray with samples at t_i, delta_i = t_{i+1} - t_i, alpha_i = 1 - exp(-delta_i sigma_i), and
the weight of sample i is w_i = alpha_i * prod_{j<i} (1 - alpha_j). Weights sum to at most 1; the rest of the
light is lost.

Weights are made in logarithms: the product is exp of a sum, which neither divides by a vanished factor in the gradient
nor rounds thin matter (delta * sigma < 1e-7) to nothing, as 1 - exp(.) would.
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
    depth = deltas * torch.relu(density)
    return transmittance(depth) * opacity(depth)


def joint_weights(static: Tensor, transient: Tensor, deltas: Tensor) -> tuple[Tensor, Tensor]:
    """Weights (R, S) of two kinds of matter in one place: each hides what is behind it, of either kind (NeRF-W).

    static, transient: densities (R, S), in 1 / scene unit; negative ones count as 0. Within a sample neither hides the
    other, so the sum of both weights can exceed that of `render_weights(static + transient, deltas)`, and 1.
    """
    depth_static, depth_transient = deltas * torch.relu(static), deltas * torch.relu(transient)
    before = transmittance(depth_static + depth_transient)
    return before * opacity(depth_static), before * opacity(depth_transient)


def transmittance(depth: Tensor) -> Tensor:
    """Light that reaches each sample through those before it: optical depths delta sigma (R, S) -> (R, S) in [0, 1]."""
    before = torch.cumsum(depth[..., :-1], dim=-1)
    return torch.exp(-torch.cat([torch.zeros_like(depth[..., :1]), before], dim=-1))


def opacity(depth: Tensor) -> Tensor:
    """alpha = 1 - exp(-delta sigma) of optical depths delta sigma."""
    return -torch.expm1(-depth)


def composite(weights: Tensor, values: Tensor) -> Tensor:
    """sum_i w_i values_i: weights (R, S), values (R, S, C) -> (R, C). No background, no division by sum w."""
    return torch.einsum("...s,...sc->...c", weights, values)
