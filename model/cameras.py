"""Which pixels a patch looks at, and the rays of those pixels.

Notation: a camera is OpenCV (x right, y down, z forward); `c2w` (3, 4) takes its points to the world;
intrinsics are (fx, fy, cx, cy) in pixels. A patch is a k x k grid of pixels spread over a part of the photo:
a sparse sketch of it.
"""

from __future__ import annotations

import torch
from torch import Tensor


def patch_grid(
    k: int, scale: float, offset_h: float, offset_w: float, height: int, width: int
) -> tuple[Tensor, Tensor, Tensor]:
    """The pixels of one k x k patch, row-major (released code; the paper's formula differs).

    In normalised coordinates the k samples of an axis are linspace(0, 1 - 1/size, k) * scale + offset, and a
    pixel is floor(coordinate * size). So `scale` is the share of *each* axis that the patch spans, whatever
    the photo's aspect.

    Returns rows (k*k,) int64, cols (k*k,) int64, and uv (k*k, 2) float32: the normalised (h, w) before the
    floor.
    """
    v = _axis(k, scale, offset_h, height)
    u = _axis(k, scale, offset_w, width)
    uv = torch.stack(torch.meshgrid(v, u, indexing="ij"), dim=-1).reshape(k * k, 2)
    rows = (uv[:, 0] * height).floor().long().clamp(0, height - 1)
    cols = (uv[:, 1] * width).floor().long().clamp(0, width - 1)
    return rows, cols, uv


def _axis(k: int, scale: float, offset: float, size: int) -> Tensor:
    # Every step in float32: in float64 a coordinate next to a pixel's edge falls on its other side.
    one, scale_, offset_ = (torch.tensor(value, dtype=torch.float32) for value in (1.0, scale, offset))
    return torch.linspace(0.0, (one - one / size).item(), k, dtype=torch.float32) * scale_ + offset_


def pixel_rays(
    cols: Tensor, rows: Tensor, intrinsics: Tensor, c2w: Tensor, pixel_center: float = 0.5
) -> tuple[Tensor, Tensor]:
    """Origins and unit directions of the rays through pixels, in the world.

    cols, rows: (..., N) integers or floats. intrinsics: (..., 4). c2w: (..., 3, 4). `pixel_center` is what is
    added to an index to get to the middle of its pixel; the released code adds 0. Returns two tensors (...,
    N, 3).
    """
    fx, fy, cx, cy = intrinsics[..., None, :].unbind(-1)
    x = (cols + pixel_center - cx) / fx
    y = (rows + pixel_center - cy) / fy
    in_camera = torch.stack([x, y, torch.ones_like(x)], dim=-1)
    # Not a matrix product: that would be rounded to 16 bits under autocast, and TF32 where it is on.
    in_world = (c2w[..., None, :, :3] * in_camera[..., None, :]).sum(dim=-1)
    directions = in_world / in_world.norm(dim=-1, keepdim=True)
    return c2w[..., None, :, 3].expand_as(directions), directions
