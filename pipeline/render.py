"""Pictures of a trained scene: a view's features are rendered once, then coloured for any number of appearances.

Whose statistics an appearance is formed with is the model's own policy (`model.statistics`), unless a caller asks for
another one. Where a model gives its field an appearance code (NeRF-W, Ha-NeRF), a view is rendered anew for each
appearance.
"""

from __future__ import annotations

from typing import Literal, NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from model.appearance.crossray import ContentStatistics
from model.bake import Baked
from model.cameras import patch_grid, pixel_rays
from model.fields.base import Rays
from model.methods import ModelSpec, StatisticsPolicy, smallest_side
from model.scene_model import ColourMap, SceneModel
from pipeline.batches import as_tensor
from pipeline.errors import CrossrayError
from pipeline.manifest import Row
from pipeline.photos import Photos

STATISTICS_SIDE = 32  # rays a side of the grid whose points give the statistics of appearance that is fused at points
# Colour values that are computed at once when a view is re-coloured: 1 MiB, as a core caches; on a GPU, few launches.
RECOLOURED = {"cpu": 2**18, "cuda": 2**25}


class Pinhole(Protocol):
    """A camera as rendering reads it: a photo's `CameraRecord`, or a `pipeline.views.camera.Camera`."""

    @property
    def width(self) -> int: ...
    @property
    def height(self) -> int: ...
    @property
    def fx(self) -> float: ...
    @property
    def fy(self) -> float: ...
    @property
    def cx(self) -> float: ...
    @property
    def cy(self) -> float: ...
    @property
    def c2w(self) -> tuple[Row, Row, Row]: ...
    @property
    def near(self) -> float: ...
    @property
    def far(self) -> float: ...


class View(NamedTuple):
    """One rendered view, before colour."""

    size: tuple[int, int]  # height, width
    features: Tensor  # (h w, C), row order
    depth: Tensor  # (h, w) scene units along the ray
    accumulation: Tensor  # (h, w)
    points: Tensor | None = None  # (M, C): where appearance is fused at points, features at some of the view's points


def view_rays(camera: Pinhole, pixel_center: float, device: torch.device, stride: int = 1) -> Rays:
    """A ray through every `stride`-th pixel of every `stride`-th row, in row order."""
    rows, cols = torch.meshgrid(
        torch.arange(min(stride // 2, camera.height), camera.height, stride, device=device),
        torch.arange(min(stride // 2, camera.width), camera.width, stride, device=device),
        indexing="ij",
    )
    intrinsics = torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy], dtype=torch.float32, device=device)
    c2w = torch.tensor(camera.c2w, dtype=torch.float32, device=device)
    origins, directions = pixel_rays(cols.flatten(), rows.flatten(), intrinsics, c2w, pixel_center)
    count = len(origins)
    return Rays(origins, directions, origins.new_full((count,), camera.near), origins.new_full((count,), camera.far))


def grid_rays(rays: Rays, size: tuple[int, int]) -> Rays:
    """STATISTICS_SIDE^2 of a view's rays, on a grid that spans it."""
    rows, cols, _ = patch_grid(STATISTICS_SIDE, 1.0, 0.0, 0.0, *size)
    chosen = (rows * size[1] + cols).to(rays.near.device)
    return Rays(*(r[chosen] for r in rays))


def render_view(
    model: SceneModel,
    camera: Pinhole,
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
        points = model.point_features(grid_rays(rays, size), samples)
    return View(size, rendering.features, rendering.depth.view(size), rendering.accumulation.view(size), points)


def check_reference(spec: ModelSpec, reference: np.ndarray, whose: str) -> None:
    """CrossrayError where a photo (h, w, 3) is too small for the network that reads its appearance; `whose` it is."""
    least, (height, width) = smallest_side(spec), reference.shape[:2]
    if min(height, width) < least:
        raise CrossrayError(
            f"{whose}: {width} x {height} pixels of it are read for its appearance, at the shards' "
            f"scene.reference_downscale, and model.encoder: {spec.encoder} reads no side under {least}; take a larger "
            "photo, or cut the shards with a smaller scene.reference_downscale"
        )


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


def interpolated(a: Tensor, b: Tensor, share: float) -> Tensor:
    """F^a between two appearances, linear (paper, section on interpolation): `a` at share 0, `b` at 1, exactly.

    Raises:
        CrossrayError: `share` is outside [0, 1].
    """
    if not 0 <= share <= 1:
        raise CrossrayError(f"share {share}: it must lie within 0 (the first appearance) and 1 (the second)")
    return torch.lerp(a, b, share)


@torch.no_grad()
def statistics_of(
    model: SceneModel, view: View | None, policy: StatisticsPolicy | None = None
) -> ContentStatistics | None:
    """A view's content statistics by a policy, by default the model's own; None where the model has no transform.

    Args:
        view: None will do for `running`.

    Raises:
        CrossrayError: `running`, and the model has no averages: it was imported, or not trained.
    """
    policy = policy or model.spec.statistics
    if model.transform is not None and policy == "running" and model.running_count == 0:
        raise CrossrayError(
            "model.statistics: running, but this checkpoint holds no averages: it was not trained here for a single "
            "step; --set model.statistics=view"
        )
    if model.transform is None:
        return None
    if view is None:
        return model.content_statistics(model.running_mean, (1, 1), policy)
    return model.content_statistics(view.features, view.size, policy, points=view.points)


@torch.no_grad()
def grid_statistics(model: SceneModel, camera: Pinhole) -> ContentStatistics:
    """Content statistics over a grid of STATISTICS_SIDE^2 rays that spans a view, or over the points on them where
    appearance is fused there; nothing else of the view is rendered. ValueError for a model without a transform.
    """
    if model.transform is None:
        raise ValueError("a model without a transform takes no statistics")
    device = next(model.parameters()).device
    rays = grid_rays(view_rays(camera, model.spec.pixel_center, device), (camera.height, camera.width))
    seen = model.point_features(rays) if model.fuses_points else model.render(rays).features
    return model.transform.content_statistics(seen[None])


@torch.no_grad()
def view_colours(
    model: SceneModel, view: View | None, appearances: Tensor | None, policy: StatisticsPolicy | None = None
) -> ColourMap:
    """The maps from a view's features to its colours in P appearances F^a, for `recoloured` and, of one appearance with
    statistics that no view decides, for `bake`. Arguments as `statistics_of`.

    Raises:
        ValueError: the field gives colours, and there is no map.
    """
    return model.colour_map(statistics_of(model, view, policy), appearances)


@torch.no_grad()
def recoloured(view: View, colours: ColourMap, rounding: Literal["truncate", "round"] = "round") -> list[np.ndarray]:
    """The view in P appearances, a uint8 picture (h, w, 3) each: sigmoid(A F + b) in 8 bits.

    Nothing is rendered. Memory: the pictures, and RECOLOURED values (but one pixel in all appearances at least). Beside
    `colour_view` and `to_8bit` the products are summed in another order: where a value falls on the border between two
    levels, within float32's rounding, they can differ by this one level.

    Raises:
        ValueError: A is not (P, 3, C) for the view's features (h w, C), or a colour is not a number.
    """
    (height, width), (A, b) = view.size, colours
    if A.ndim != 3 or A.shape[1:] != (3, view.features.shape[1]):
        raise ValueError(f"features {tuple(view.features.shape)} and A {tuple(A.shape)} do not fit each other")
    # truncate: the level below. Adding a half first makes rounding of it; ties lie within float32's rounding anyway.
    half = 0.5 if rounding == "round" else 0.0
    weight, bias = A.flatten(0, 1).T, b.flatten()  # as it lies in memory: products are 3 times as fast as copied
    pictures = torch.empty(len(A), height * width, 3, dtype=torch.uint8, device=A.device)
    block = max(1, RECOLOURED[A.device.type] // weight.shape[1])
    check = A.new_zeros(())  # NaN as soon as one value is
    for start in range(0, height * width, block):
        values = (view.features[start : start + block] @ weight).add_(bias)
        check += values.sum()
        levels = values.sigmoid_().mul_(255).add_(half).to(torch.uint8)
        pictures[:, start : start + block] = levels.unflatten(1, (len(A), 3)).transpose(0, 1)
    if check.isnan():
        raise ValueError("the picture holds NaN")
    return list(pictures.view(len(A), height, width, 3).cpu().numpy())


@torch.no_grad()
def colour_view(
    model: SceneModel, view: View, appearance: Tensor | None, policy: StatisticsPolicy | None = None
) -> np.ndarray:
    """The view in one appearance, float32 (h, w, 3) in [0, 1]; with codes, in the one that it was rendered with.

    Args:
        policy: whose statistics; by default the model's own policy. CrossrayError as `statistics_of`.
    """
    content = statistics_of(model, view, policy)
    colours = model.colours(view.features[None], appearance, content)[0]
    return colours.clamp(0, 1).view(*view.size, 3).cpu().numpy()


def render_picture(
    model: SceneModel, camera: Pinhole, appearance: Tensor | None, samples: tuple[int, int] | None = None
) -> tuple[View, np.ndarray]:
    """A view in one appearance, whatever way the model uses it."""
    view = render_view(model, camera, appearance if model.coded else None, samples=samples)
    return view, colour_view(model, view, appearance)


def render_baked(
    baked: Baked, camera: Pinhole, *, stride: int = 1, samples: tuple[int, int] | None = None
) -> tuple[View, np.ndarray]:
    """A view of a baked model, whose features are its colours, and the same as float32 (h, w, 3) in (0, 1)."""
    rays = view_rays(camera, baked.spec.pixel_center, baked.b.device, stride)
    rendering = baked.render(rays, samples=samples)
    size = (len(range(stride // 2, camera.height, stride)), len(range(stride // 2, camera.width, stride)))
    view = View(size, rendering.features, rendering.depth.view(size), rendering.accumulation.view(size))
    return view, rendering.features.view(*size, 3).cpu().numpy()


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
