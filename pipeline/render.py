"""Pictures of a trained scene: a view's features are rendered once, then coloured for any appearance.

Where a model gives its field an appearance code (NeRF-W, Ha-NeRF), a view is rendered anew for each appearance.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from model.cameras import patch_grid, pixel_rays
from model.fields.base import Rays
from model.scene_model import SceneModel, StatisticsPolicy
from pipeline.batches import as_tensor
from pipeline.photos import Photos
from pipeline.shards import CameraRecord

STATISTICS_SIDE = 32  # rays a side of the grid whose points give the statistics of appearance that is fused at points


class View(NamedTuple):
    """One rendered view, before colour."""

    size: tuple[int, int]  # height, width
    features: Tensor  # (h w, C), row order
    depth: Tensor  # (h, w) scene units along the ray
    accumulation: Tensor  # (h, w)
    points: Tensor | None = None  # (M, C): where appearance is fused at points, features at some of the view's points


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
    code: Tensor | None = None,
    *,
    stride: int = 1,
    chunk: int | None = None,
    samples: tuple[int, int] | None = None,
) -> View:
    """Features, depth and accumulation of a whole view. Memory: the features, and the samples of one chunk; fused at
    points, also the features at the points of STATISTICS_SIDE^2 rays that span the view.

    Args:
        code: (1, CODE), for a model whose field reads one.
    """
    device = next(model.parameters()).device
    rays = view_rays(camera, model.spec.pixel_center, device, stride)
    rendering = model.render(rays, chunk, samples, code)
    size = (len(range(stride // 2, camera.height, stride)), len(range(stride // 2, camera.width, stride)))
    points = None
    if model.transform is not None and model.spec.fused == "point":
        rows, cols, _ = patch_grid(STATISTICS_SIDE, 1.0, 0.0, 0.0, *size)
        chosen = (rows * size[1] + cols).to(device)
        points = model.point_features(Rays(*(r[chosen] for r in rays)), samples)
    return View(size, rendering.features, rendering.depth.view(size), rendering.accumulation.view(size), points)


@torch.no_grad()
def read_appearance(model: SceneModel, reference: np.ndarray) -> Tensor | None:
    """F^a of a uint8 photo (h, w, 3), (1, C, g, g) or (1, CODE); None where the model reads nothing from photos."""
    if model.encoder is None:
        return None
    return model.encode([as_tensor(reference, next(model.parameters()).device)])


@torch.no_grad()
def training_appearance(model: SceneModel, photos: Photos, index: int) -> Tensor | None:
    """F^a of a training photo: what was learned of it, or what is read from it; None where there is no appearance."""
    if model.embedding is None:
        return read_appearance(model, photos.reference(index))
    number = torch.tensor([photos.indices("train").index(index)], device=model.embedding.weight.device)
    return model.embedding(number)


@torch.no_grad()
def colour_view(
    model: SceneModel, view: View, appearance: Tensor | None, policy: StatisticsPolicy = "view"
) -> np.ndarray:
    """The view in one appearance, float32 (h, w, 3) in [0, 1]; with codes, in the one that it was rendered with."""
    content = model.content_statistics(view.features, view.size, policy, points=view.points)
    colours = model.colours(view.features[None], appearance, content)[0]
    return colours.clamp(0, 1).view(*view.size, 3).cpu().numpy()


def render_picture(
    model: SceneModel, camera: CameraRecord, appearance: Tensor | None, samples: tuple[int, int] | None = None
) -> tuple[View, np.ndarray]:
    """A view in one appearance, whatever way the model uses it."""
    view = render_view(model, camera, appearance if model.coded else None, samples=samples)
    return view, colour_view(model, view, appearance)


def predicted_mask(model: SceneModel, photos: Photos, index: int, stride: int = 1) -> np.ndarray | None:
    """Transient probability, float32, of every `stride`-th pixel of every `stride`-th row of a photo as the model has
    it, (h, w) for all of them; None where it has none.

    A model with a transient field is asked how much of each ray's light comes from it.
    """
    camera, train = photos.records[index], photos.indices("train")
    number = train.index(index) if index in train else None
    rows = cols = slice(stride // 2, None, stride)
    if model.spec.transient == "fixed":
        mask = photos.mask(index)
        return None if mask is None else mask[rows, cols].astype(np.float32) / 255
    device = next(model.parameters()).device
    if model.transient_embedding is not None:
        if number is None:
            return None
        size = (len(range(camera.height)[rows]), len(range(camera.width)[cols]))
        rays = view_rays(camera, model.spec.pixel_center, device, stride)
        return model.transient_opacity(rays, number).view(size).cpu().numpy()
    found = model.transient_mask((camera.height, camera.width), as_tensor(photos.reference(index), device), number)
    return None if found is None else found[rows, cols].cpu().numpy()
