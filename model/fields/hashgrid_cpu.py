"""The look-up of a hash encoding and its gradient on a CPU, compiled by numba: a loop over levels, points and corners.

Torch needs some sixty calls for the same, each of which reads and writes arrays as long as all points; here a level's
table stays in the cache, and nothing is stored between forward and backward. `model.fields.hashgrid` has the same in
torch, for every other device and number; the tests hold the two against each other and against a slow third. One
thread does it: a second one beside torch's own gained nothing (benchmarks/results/speed.md).

Notation as there. Points are float32 in [0, 1]^3. A coordinate that is not a number reads a valid entry, with a weight
that is not a number: it reaches the loss, which says so, and no memory outside the table is touched.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from torch import Tensor

ZERO, ONE = np.float32(0), np.float32(1)


def look_up(x: Tensor, table: Tensor, resolutions: Tensor, strides: Tensor, num_dense: int) -> Tensor:
    """Features (N, L F) of points x (N, 3): see HashEncoding. All float32 on a CPU; strides (3, L) are int32."""
    out = x.new_empty(len(x), len(resolutions) * table.shape[1])
    entries = table.detach().view(len(resolutions), -1, table.shape[1]).numpy()
    _look_up(x.contiguous().numpy(), entries, resolutions.numpy(), strides.numpy(), num_dense, out.numpy())
    return out


def gradient(x: Tensor, grad: Tensor, rows: int, resolutions: Tensor, strides: Tensor, num_dense: int) -> Tensor:
    """The table's gradient (rows, F) from that of the features, (N, L F), summed in the order of the points."""
    levels = len(resolutions)
    table = grad.new_zeros(rows, grad.shape[1] // levels)
    sums = table.view(levels, -1, table.shape[1]).numpy()
    _spread(x.contiguous().numpy(), grad.contiguous().numpy(), resolutions.numpy(), strides.numpy(), num_dense, sums)
    return table


def compiled(signature: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Compile at import, without Python's lock; kept beside this file or in the user's cache where there is room."""

    def compile_it(function: Callable[..., Any]) -> Callable[..., Any]:
        # Contracted: a b + c may be rounded once. Nothing else of fast mathematics: sums keep their order.
        options: dict[str, Any] = {"nogil": True, "fastmath": {"contract"}, "error_model": "numpy"}
        try:
            return numba.njit(signature, cache=True, **options)(function)
        except (RuntimeError, OSError):  # no folder can be written, or its disk is full
            return numba.njit(signature, **options)(function)

    return compile_it


@numba.njit(inline="always")
def interval(coordinate, resolution):
    """Lower end of the interval that a coordinate lies in, and the weight of the upper one."""
    scaled = coordinate * resolution
    low = scaled if scaled > ZERO else ZERO  # what is not a number has a cell, too
    last = resolution - ONE  # a point at 1 belongs to it: the next one would lie outside the grid
    low = np.uint32(np.int32(low if low < last else last))
    return low, scaled - np.float32(low)


@numba.njit(inline="always")
def cell(point, resolution):
    """Lower corner of the cell that a point lies in, and how far in it the point is, an axis each."""
    x, fx = interval(point[0], resolution)
    y, fy = interval(point[1], resolution)
    z, fz = interval(point[2], resolution)
    return (x, y, z), (fx, fy, fz)


@numba.njit(inline="always")
def corner(number, lows, fractions, strides, mask, dense):
    """Entry and trilinear weight of one of a cell's corners, whose bits say in which axes it is the upper one."""
    i, j, k = np.uint32(number & 1), np.uint32(number >> 1 & 1), np.uint32(number >> 2)
    x, y, z = lows[0] + i, (lows[1] + j) * strides[0], (lows[2] + k) * strides[1]
    weight = fractions[0] if i else ONE - fractions[0]
    weight *= fractions[1] if j else ONE - fractions[1]
    weight *= fractions[2] if k else ONE - fractions[2]
    return x + y + z if dense else (x ^ y ^ z) & mask, weight


@compiled("void(float32[:,::1], float32[:,:,::1], float32[::1], int32[:,::1], int64, float32[:,::1])")
def _look_up(points, table, resolutions, strides, num_dense, out):
    mask = np.uint32(table.shape[1] - 1)
    for level in range(len(resolutions)):
        entries, dense, resolution = table[level], level < num_dense, resolutions[level]
        steps = np.uint32(strides[1, level]), np.uint32(strides[2, level])
        for n in range(len(points)):
            lows, fractions = cell(points[n], resolution)
            a, b = ZERO, ZERO
            for number in range(8):
                row, weight = corner(number, lows, fractions, steps, mask, dense)
                a += weight * entries[row, 0]
                b += weight * entries[row, 1]
            out[n, 2 * level], out[n, 2 * level + 1] = a, b


@compiled("void(float32[:,::1], float32[:,::1], float32[::1], int32[:,::1], int64, float32[:,:,::1])")
def _spread(points, grads, resolutions, strides, num_dense, table):
    mask = np.uint32(table.shape[1] - 1)
    for level in range(len(resolutions)):
        entries, dense, resolution = table[level], level < num_dense, resolutions[level]
        steps = np.uint32(strides[1, level]), np.uint32(strides[2, level])
        for n in range(len(points)):
            lows, fractions = cell(points[n], resolution)
            a, b = grads[n, 2 * level], grads[n, 2 * level + 1]
            for number in range(8):
                row, weight = corner(number, lows, fractions, steps, mask, dense)
                entries[row, 0] += weight * a
                entries[row, 1] += weight * b
