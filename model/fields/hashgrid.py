"""Multiresolution hash encoding: in torch on any device, and on a CPU compiled (`model.fields.hashgrid_cpu`).

Notation: L levels, T table entries a level, F = 2 features an entry, N points in [0, 1]^3. A level whose grid fits into
its table is stored densely; a finer one is hashed (Instant-NGP, Mueller et al. 2022, eq. 4).
"""

from __future__ import annotations

import math
from importlib.util import find_spec
from typing import Any

import torch
from torch import Tensor, nn

# 2_654_435_761 as the int32 with the same bits: only the low bits of a product enter the hash.
PRIMES = (1, 2_654_435_761 - 2**32, 805_459_861)
FEATURES = 2
HAS_NUMBA = find_spec("numba") is not None  # a machine with a GPU may lack it


class HashEncoding(nn.Module):
    """Trilinear interpolation in L grids of growing resolution.

    Args:
        levels: number of grids L.
        log2_entries: base-2 logarithm of T.
        min_resolution, max_resolution: cells a side of the first and last grid, geometric in between.
    """

    resolutions: Tensor
    strides: Tensor
    offsets: Tensor

    def __init__(self, levels: int, log2_entries: int, min_resolution: int, max_resolution: int) -> None:
        super().__init__()
        self.entries = 2**log2_entries
        self.out_channels = levels * FEATURES
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
        self.table = nn.Parameter(torch.empty(levels * self.entries, FEATURES).uniform_(-1e-4, 1e-4))

    def forward(self, x: Tensor) -> Tensor:
        """Features (N, L F) of points x (N, 3) in [0, 1]; no gradient flows to x."""
        if HAS_NUMBA and x.device.type == "cpu" and x.dtype == self.table.dtype == torch.float32:
            compiled: Tensor = _LookUp.apply(self.table, x.detach(), self.resolutions, self.strides, self.num_dense)
            return compiled
        index, weight = self.corners(x.detach())
        out: Tensor = _GatherCorners.apply(self.table, index, weight, len(self.resolutions))
        return out

    @torch.no_grad()
    def corners(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Rows of the table (8, L N) and their trilinear weights (8, L N) of each point's cell in each grid.

        int32 throughout: on a CPU this arithmetic is much faster than with int64.
        """
        scaled = x.t().contiguous()[:, None, :] * self.resolutions[None, :, None]  # (3, L, N)
        # A point at 1 belongs to the last cell: the next one would lie outside the grid. What is not a number has a
        # cell, too, and a weight that is not a number: the loss will say so.
        low = torch.minimum(torch.where(scaled > 0, scaled, 0), self.resolutions[None, :, None] - 1).int()
        fraction = scaled - low
        low_index = low * self.strides[:, :, None]
        index_at = (low_index, low_index + self.strides[:, :, None])
        weight_at = (1 - fraction, fraction)
        dense = self.num_dense
        for term in index_at:  # each alone: & and | reach through ^, and there are fewer terms than corners
            term[:, dense:] &= self.entries - 1
            term[0] += self.offsets[:, None]  # a multiple of the entries: + is | here
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
        return index.view(8, -1), weight.view(8, -1)


class _LookUp(torch.autograd.Function):
    """The compiled look-up; the backward pass finds the corners anew, which is cheaper than to keep them."""

    @staticmethod
    def forward(ctx: Any, table: Tensor, x: Tensor, resolutions: Tensor, strides: Tensor, num_dense: int) -> Tensor:
        from model.fields import hashgrid_cpu  # not where GPUs do the work

        ctx.save_for_backward(x, resolutions, strides)
        ctx.rows, ctx.num_dense = len(table), num_dense
        return hashgrid_cpu.look_up(x, table, resolutions, strides, num_dense)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, None, None, None, None]:
        from model.fields import hashgrid_cpu

        (grad,) = grad_outputs
        x, resolutions, strides = ctx.saved_tensors
        return hashgrid_cpu.gradient(x, grad, ctx.rows, resolutions, strides, ctx.num_dense), None, None, None, None


class _GatherCorners(torch.autograd.Function):
    """Per level l and point n the sum over corners of weight * table[index], as (N, L F); the backward pass is a
    scatter-add into the table alone.

    Corner by corner and feature by feature: embedding_bag wants the corners of a point beside each other, and to turn
    them round costs a CPU more than it saves. autograd's own route (indexing) materialises (8, L N, F) twice.
    """

    @staticmethod
    def forward(ctx: Any, table: Tensor, index: Tensor, weight: Tensor, levels: int) -> Tensor:
        ctx.save_for_backward(index, weight)
        ctx.levels, ctx.rows = levels, len(table)
        columns = [column.contiguous() for column in table.unbind(1)]
        out = table.new_zeros(len(columns), index.shape[1])
        for rows, share in zip(index, weight, strict=True):
            for f, column in enumerate(columns):
                out[f].addcmul_(column.index_select(0, rows), share)
        return out.view(len(columns), levels, -1).permute(2, 1, 0).flatten(1)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, None, None, None]:
        (grad,) = grad_outputs
        index, weight = ctx.saved_tensors
        planes = grad.view(len(grad), ctx.levels, -1).permute(2, 1, 0).flatten(1)
        columns = grad.new_zeros(len(planes), ctx.rows)
        for rows, share in zip(index.long(), weight, strict=True):  # scatter_add_ knows no other rows
            for column, plane in zip(columns, planes, strict=True):
                column.scatter_add_(0, rows, share * plane)
        return torch.stack(columns.unbind(), dim=1), None, None, None
