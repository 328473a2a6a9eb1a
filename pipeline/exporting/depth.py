"""Depth maps of views, and pictures of them for people."""

from __future__ import annotations

import numpy as np

from model.fields.base import Rays


def z_depth(distance: np.ndarray, rays: Rays, forward: np.ndarray) -> np.ndarray:
    """float32 (R,): depth z, in the unit of `distance` (R,), which is along the rays; 0 stays 0.

    Args:
        forward: (3,) the camera's viewing direction in the world, the third column of its c2w.
    """
    return (distance * (rays.directions.cpu().numpy().astype(np.float64) @ forward)).astype(np.float32)


def preview(depth: np.ndarray) -> np.ndarray:
    """uint8 (h, w, 3): depth (h, w) from blue, near, to red, far, between its 2nd and 98th percentile; black where
    there is no surface.
    """
    from matplotlib import colormaps

    there = depth > 0
    if not there.any():
        return np.zeros((*depth.shape, 3), np.uint8)
    low, high = np.percentile(depth[there], [2, 98])
    share = np.clip((depth - low) / max(high - low, 1e-9), 0, 1)
    return np.where(there[..., None], colormaps["turbo"](share, bytes=True)[..., :3], 0).astype(np.uint8)
