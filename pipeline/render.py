"""Pictures of a trained scene: a view's features are rendered once, then coloured for any appearance."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from model.cameras import pixel_rays
from model.fields.base import Rays
from model.scene_model import SceneModel, StatisticsPolicy
from pipeline.batches import as_tensor
from pipeline.shards import CameraRecord


class View(NamedTuple):
    """One rendered view, before colour."""

    size: tuple[int, int]  # height, width
    features: Tensor  # (h w, C), row order
    depth: Tensor  # (h, w) scene units along the ray
    accumulation: Tensor  # (h, w)


def view_rays(camera: CameraRecord, pixel_center: float, device: torch.device, stride: int = 1) -> Rays:
    """A ray through every `stride`-th pixel of every `stride`-th row, in row order."""
    rows, cols = torch.meshgrid(
        torch.arange(stride // 2, camera.height, stride, device=device),
        torch.arange(stride // 2, camera.width, stride, device=device),
        indexing="ij",
    )
    intrinsics = torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy], device=device)
    c2w = torch.tensor(camera.c2w, device=device)
    origins, directions = pixel_rays(cols.flatten(), rows.flatten(), intrinsics, c2w, pixel_center)
    count = len(origins)
    return Rays(origins, directions, origins.new_full((count,), camera.near), origins.new_full((count,), camera.far))


def render_view(
    model: SceneModel,
    camera: CameraRecord,
    *,
    stride: int = 1,
    chunk: int | None = None,
    samples: tuple[int, int] | None = None,
) -> View:
    """Features, depth and accumulation of a whole view. Memory: the features, and the samples of one chunk."""
    device = next(model.parameters()).device
    rendering = model.render(view_rays(camera, model.spec.pixel_center, device, stride), chunk, samples)
    size = (len(range(stride // 2, camera.height, stride)), len(range(stride // 2, camera.width, stride)))
    return View(size, rendering.features, rendering.depth.view(size), rendering.accumulation.view(size))


@torch.no_grad()
def read_appearance(model: SceneModel, reference: np.ndarray) -> Tensor | None:
    """F^a (1, C, g, g) of a uint8 photo (h, w, 3); None where the model has no appearance."""
    if model.encoder is None:
        return None
    return model.encode([as_tensor(reference, next(model.parameters()).device)])


@torch.no_grad()
def colour_view(
    model: SceneModel, view: View, appearance: Tensor | None, policy: StatisticsPolicy = "view"
) -> np.ndarray:
    """The view in one appearance, float32 (h, w, 3) in [0, 1]."""
    content = model.content_statistics(view.features, view.size, policy)
    colours = model.colours(view.features[None], appearance, content)[0]
    return colours.clamp(0, 1).view(*view.size, 3).cpu().numpy()
