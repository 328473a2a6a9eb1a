"""Small geometry of cameras that face a scene: rotations, medians, and where a set of cameras looks.

Every function gives finite numbers for any finite cameras, however they stand: one, all in one spot, on a line, or
with axes that never meet.
"""

from __future__ import annotations

import numpy as np

STEPS = 30  # of an iteration that finds a median
TINY = 1e-9
LEVEL = 0.05  # how much the cameras' own up counts beside the horizon that their x axes span
PRIOR = 1e-3  # how much the assumed distance of what is looked at counts beside each optical axis


def unit(vectors: np.ndarray, instead: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) at length 1; those that are too short for a direction are `instead`."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(length > TINY, vectors / np.maximum(length, TINY), instead)


def weighted_median(points: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Geometric medians (M, D) of points (N, D) under M sets of weights (M, N) with sum 1: Weiszfeld's iteration, so
    each is a convex combination of the points. Memory: a few M x N float64.
    """
    centre = weights @ points
    scale = max(float(np.ptp(points, axis=0).max()), TINY)
    squares = (points**2).sum(1)
    for _ in range(STEPS):
        distance = np.sqrt(np.maximum(squares - 2 * centre @ points.T + (centre**2).sum(1)[:, None], 0))
        pull = weights / np.maximum(distance, 1e-3 * scale)
        centre = (pull / pull.sum(1, keepdims=True)) @ points
    return centre


def median_of(points: np.ndarray) -> np.ndarray:
    """The geometric median (D,) of points (N, D)."""
    return weighted_median(points, np.full((1, len(points)), 1 / len(points)))[0]


def up_of(poses: np.ndarray) -> np.ndarray:
    """Up for cameras (N, 3, 4): the median of their own up, put upright onto the horizon that their x axes span.

    Photos are tilted up or down far more often than they are rolled, so x axes lie in the horizon. Those of photos
    that were rolled are left out.
    """
    ups = -poses[:, :, 1]
    own = unit(median_of(ups), ups[0])
    x = poses[:, :, 0][np.abs(poses[:, :, 0] @ own) < 0.5]
    return unit(np.linalg.solve(x.T @ x / max(len(x), 1) + LEVEL * np.eye(3), own), own)


def focus_of(poses: np.ndarray, distance: float) -> np.ndarray:
    """The point (3,) nearest to the optical axes of cameras (N, 3, 4), robust: least absolute distances.

    Args:
        distance: how far away what they look at is, roughly; it decides where the axes do not, as parallel ones.
    """
    centres, forwards = poses[:, :, 3], poses[:, :, 2]
    start = median_of(centres)
    prior = start + distance * unit(median_of(forwards), forwards[0])
    across = np.eye(3) - forwards[:, :, None] * forwards[:, None, :]  # projects onto the plane across each axis
    focus = prior
    for _ in range(STEPS):
        offsets = np.linalg.norm(np.einsum("nij,nj->ni", across, focus - centres), axis=1)
        weights = 1 / np.maximum(offsets, 1e-2 * distance)
        weights /= weights.sum()
        A = np.einsum("n,nij->ij", weights, across) + PRIOR * np.eye(3)
        b = np.einsum("n,nij,nj->i", weights, across, centres) + PRIOR * prior
        focus = np.linalg.solve(A, b)
    return focus


def looking(forward: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Rotations (..., 3, 3), OpenCV camera-to-world, that look along unit vectors `forward` (..., 3) with `up` (3,)
    upwards; where one looks along up itself, another direction is up.
    """
    x = np.cross(forward, up)
    other = np.eye(3)[np.abs(forward).argmin(-1)]
    x = np.where(np.linalg.norm(x, axis=-1, keepdims=True) > 1e-4, x, np.cross(forward, other))
    x = unit(x, x)
    return np.stack([x, np.cross(forward, x), forward], axis=-1)
