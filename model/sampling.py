"""Where to sample along rays: evenly with jitter, then where the coarse pass found matter (NeRF, 5.2).

Notation: t are distances along unit rays, ascending, in scene units; R rays, S samples a ray.
"""

from __future__ import annotations

import torch
from torch import Tensor

# The released code's constants: weight given to every bin, and the mass below which a bin counts as empty.
WEIGHT_FLOOR = 1e-5
EMPTY_BIN = 1e-5


def stratified(near: Tensor, far: Tensor, n: int, jitter: Tensor | None = None) -> Tensor:
    """n distances from near to far, linear in distance: t (R, n).

    near, far: (R,). `jitter` (R, n) in [0, 1) moves each sample within the bin between the mid points to its
    neighbours (the outer bins end at near and far); without it the samples are the even ones, both ends
    included.
    """
    s = torch.linspace(0.0, 1.0, n, dtype=near.dtype, device=near.device)
    t = near[:, None] * (1 - s) + far[:, None] * s
    if jitter is None:
        return t
    mids = midpoints(t)
    lower = torch.cat([t[:, :1], mids], dim=-1)
    upper = torch.cat([mids, t[:, -1:]], dim=-1)
    return lower + (upper - lower) * jitter


def midpoints(t: Tensor) -> Tensor:
    """(R, S) -> (R, S - 1)."""
    return 0.5 * (t[:, :-1] + t[:, 1:])


@torch.no_grad()
def sample_pdf(bins: Tensor, weights: Tensor, n: int, u: Tensor | None = None) -> Tensor:
    """n distances a ray drawn from the histogram `weights` over `bins`: (R, n). Carries no gradient.

    bins: (R, B) edges. weights: (R, B - 1), not negative, need not sum to 1. `u` (R, n) in [0, 1] picks the
    quantiles; without it they are n even ones, 0 and 1 included, so the result is deterministic and
    ascending.
    """
    weights = weights + WEIGHT_FLOOR
    cdf = torch.cumsum(weights / weights.sum(-1, keepdim=True), dim=-1)
    cdf = torch.cat([torch.zeros_like(cdf[:, :1]), cdf], dim=-1)
    if u is None:
        u = torch.linspace(0.0, 1.0, n, dtype=bins.dtype, device=bins.device).expand(len(bins), n)
    above = torch.searchsorted(cdf, u.contiguous(), right=True)
    below = (above - 1).clamp(min=0)
    above = above.clamp(max=bins.shape[-1] - 1)

    cdf_below, cdf_above = cdf.gather(-1, below), cdf.gather(-1, above)
    bin_below, bin_above = bins.gather(-1, below), bins.gather(-1, above)
    mass = cdf_above - cdf_below
    mass = torch.where(mass < EMPTY_BIN, torch.ones_like(mass), mass)
    return bin_below + (u - cdf_below) / mass * (bin_above - bin_below)


def refine(t: Tensor, weights: Tensor, n: int, u: Tensor | None = None) -> Tensor:
    """The distances of the fine pass: the coarse ones and n more where they found matter, sorted: (R, S + n).

    t, weights: (R, S), those of the coarse pass. A bin reaches from mid point to mid point, so the outermost
    two samples have none and their weights are left out (released code).
    """
    new = sample_pdf(midpoints(t), weights[:, 1:-1], n, u)
    return torch.cat([t, new], dim=-1).sort(dim=-1).values
