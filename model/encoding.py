"""Positional encoding: coordinates as sines and cosines of rising frequency (NeRF, section 5.1)."""

from __future__ import annotations

import torch
from torch import Tensor


def positional_encoding(v: Tensor, frequencies: int) -> Tensor:
    """[v, sin(2^0 v), cos(2^0 v), ..., sin(2^(L-1) v), cos(2^(L-1) v)] with L = `frequencies`.

    v: (..., D) -> (..., D * (1 + 2 L)). The identity is included and there is no factor pi (released code).
    Powers of two keep the arguments exact in float32; 2^14 times a coordinate of 5 is why this must not run
    in 16 bits.
    """
    powers = 2.0 ** torch.arange(frequencies, dtype=v.dtype, device=v.device)
    angles = v[..., None, :] * powers[:, None]
    waves = torch.stack([angles.sin(), angles.cos()], dim=-2)
    return torch.cat([v, waves.flatten(start_dim=-3)], dim=-1)
