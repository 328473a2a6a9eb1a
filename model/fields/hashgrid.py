"""Multiresolution hash encoding in pure torch: any device, no extension.

Notation: L levels, T table entries a level, F features an entry, N points in [0, 1]^3. A level whose grid fits into its
table is stored densely; a finer one is hashed (Instant-NGP, Mueller et al. 2022, eq. 4).
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

# 2_654_435_761 as the int32 with the same bits: only the low bits of a product enter the hash.
PRIMES = (1, 2_654_435_761 - 2**32, 805_459_861)


class HashEncoding(nn.Module):
    """Trilinear interpolation in L grids of growing resolution.

    Args:
        levels: number of grids L.
        log2_entries: base-2 logarithm of T.
        features: F.
        min_resolution, max_resolution: cells a side of the first and last grid, geometric in between.
    """

    resolutions: Tensor
    strides: Tensor
    offsets: Tensor

    def __init__(
        self, levels: int, log2_entries: int, min_resolution: int, max_resolution: int, features: int = 2
    ) -> None:
        super().__init__()
        self.entries = 2**log2_entries
        self.out_channels = levels * features
        growth = (max_resolution / min_resolution) ** (1 / max(levels - 1, 1))
        resolutions = [math.floor(min_resolution * growth**level + 1e-6) for level in range(levels)]
        side = torch.tensor([r + 1 for r in resolutions])
        hashed = side**3 > self.entries
        self.num_dense = levels - int(hashed.sum())  # grids grow with the level: the dense ones come first
        dense_strides = torch.stack([torch.ones_like(side), side, side**2])
        strides = torch.where(hashed, torch.tensor(PRIMES)[:, None], dense_strides)
        self.register_buffer("resolutions", torch.tensor(resolutions, dtype=torch.float32), persistent=False)
        self.register_buffer("strides", strides.int(), persistent=False)  # (3, L)
        self.register_buffer("offsets", (torch.arange(levels) * self.entries).int(), persistent=False)
        self.table = nn.Parameter(torch.empty(levels * self.entries, features).uniform_(-1e-4, 1e-4))

    def forward(self, x: Tensor) -> Tensor:
        """Features (N, L F) of points x (N, 3) in [0, 1]; no gradient flows to x."""
        index, weight = self.corners(x.detach())
        out: Tensor = _GatherCorners.apply(self.table, index, weight)
        return out.view(len(self.resolutions), x.shape[0], -1).permute(1, 0, 2).reshape(x.shape[0], -1)

    @torch.no_grad()
    def corners(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Rows of the table (8, L N) and their trilinear weights (8, L N) of each point's cell in each grid.

        int32 throughout: on a CPU this arithmetic is much faster than with int64.
        """
        scaled = x.t().contiguous()[:, None, :] * self.resolutions[None, :, None]  # (3, L, N)
        # A point at 1 belongs to the last cell: the next one would lie outside the grid.
        low = torch.minimum(scaled, self.resolutions[None, :, None] - 1).int()
        fraction = scaled - low
        low_index = low * self.strides[:, :, None]
        index_at = (low_index, low_index + self.strides[:, :, None])
        weight_at = (1 - fraction, fraction)
        dense = self.num_dense
        index = x.new_empty((8, *scaled.shape[1:]), dtype=torch.int32)
        weight = x.new_empty((8, *scaled.shape[1:]))
        for j, k in ((0, 0), (0, 1), (1, 0), (1, 1)):
            y, z = index_at[j][1], index_at[k][2]
            sum_yz, hash_yz = y[:dense] + z[:dense], y[dense:] ^ z[dense:]
            weight_yz = weight_at[j][1] * weight_at[k][2]
            for i in (0, 1):
                corner = i + 2 * j + 4 * k
                torch.add(index_at[i][0, :dense], sum_yz, out=index[corner, :dense])
                torch.bitwise_xor(index_at[i][0, dense:], hash_yz, out=index[corner, dense:])
                torch.mul(weight_at[i][0], weight_yz, out=weight[corner])
        index[:, dense:] &= self.entries - 1
        index += self.offsets[:, None]
        return index.view(8, -1), weight.view(8, -1)


class _GatherCorners(torch.autograd.Function):
    """out[n] = sum over corners of weight * table[index], with a scatter-add backward for the table alone.

    autograd's own route (indexing) materialises (8, L N, F) twice.
    """

    @staticmethod
    def forward(ctx: Any, table: Tensor, index: Tensor, weight: Tensor) -> Tensor:
        ctx.save_for_backward(index, weight)
        ctx.table_shape = table.shape
        return F.embedding_bag(
            index.t().contiguous(),
            table,
            per_sample_weights=weight.t().contiguous().to(table.dtype),
            mode="sum",
        )

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, None, None]:
        (grad,) = grad_outputs
        index, weight = ctx.saved_tensors
        rows, features = ctx.table_shape
        flat = index.reshape(-1).long()
        # One flat scatter a feature: a 1-D scatter_add_ with int64 rows is the fast path on CPUs.
        planes = grad.t().contiguous()
        columns = [grad.new_zeros(rows).scatter_add_(0, flat, (weight * planes[f]).view(-1)) for f in range(features)]
        return torch.stack(columns, dim=1), None, None
