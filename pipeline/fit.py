"""Fitting an appearance to a photo that the model has not seen, with nothing else moving: how NeRF-W is judged, and
what `+fit` adds to methods that read the appearance from the photo.

Whatever no appearance changes is done once, for a pool of pixels that the steps draw from: samples are placed where a
code enters at points, and where colours are transformed behind the rendering (cross-ray) the view is rendered already.
The photo's transient code, where a model has them, is fitted beside its appearance, so that people in the photo do not
tint it, and is dropped afterwards.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor

from model.appearance.crossray import recolour
from model.cameras import pixel_rays
from model.fields.base import Rays
from model.scene_model import SceneModel
from pipeline.manifest import CameraRecord
from pipeline.patches import step_generator
from pipeline.render import View, statistics_of


class FitRecipe(BaseModel):
    """How an appearance is fitted; the defaults are the numbers of NeRF-W's public re-evaluation (nerfbaselines), which
    draws from all pixels."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    steps: int = Field(1000, ge=1)
    """Steps of Adam."""
    rays: int = Field(1024, ge=1)
    """Pixels that a step draws."""
    learning_rate: float = Field(0.01, gt=0)
    """Of the first stage."""
    stages: int = Field(3, ge=1)
    """Equal parts of the steps; the learning rate is a tenth in each further one."""
    pool: int = Field(4096, ge=1)
    """Pixels that the steps draw from, at most: with the paper's MLP and 128 samples, their points take 0.5 GiB."""


class Pool:
    """The pixels that a fit may look at, drawn once from the first `columns` columns of a photo, uint8 (h, w, 3)."""

    def __init__(self, image: np.ndarray, columns: int, most: int, seed: int, device: torch.device) -> None:
        self.generator = step_generator(seed, 0, 0, "cpu")
        pixels = torch.randperm(image.shape[0] * columns, generator=self.generator)[:most].to(device)
        self.rows, self.cols = pixels // columns, pixels % columns
        self.colours = torch.from_numpy(np.array(image[:, :columns])).to(device)[self.rows, self.cols].float() / 255

    def draws(self, steps: int, count: int) -> Tensor:
        """Numbers (steps, count) of some pixels, each as likely as any other: of all steps at once, for one copy."""
        return torch.randint(len(self.rows), (steps, count), generator=self.generator).to(self.rows.device)


def fit_code(
    model: SceneModel,
    image: np.ndarray,
    camera: CameraRecord,
    columns: int,
    recipe: FitRecipe,
    seed: int = 0,
    start: Tensor | None = None,
) -> Tensor:
    """The appearance code (1, CODE) in which the view of `camera` comes closest to the first `columns` columns of
    `image`, uint8 (h, w, 3): least mean squared error over random pixels, by Adam.

    Args:
        start: (1, CODE) where the search begins; by default the mean of the learned codes.

    Raises:
        ValueError: the model's field reads no code, or there is nothing to start from.
    """
    if not model.coded:
        raise ValueError(f"model.appearance: {model.spec.appearance} has no code to fit")
    if start is None:
        if model.embedding is None:
            raise ValueError(f"model.appearance: {model.spec.appearance} has no learned codes to start a fit from")
        start = model.embedding.weight.mean(0, keepdim=True)
    code, transient = free(start), None
    if model.transient_embedding is not None:
        transient = free(model.transient_embedding.weight.mean(0, keepdim=True))
    pool = Pool(image, columns, recipe.pool, seed, code.device)
    with torch.no_grad(), model.autocast(code.device):
        placed = model.field.place(rays_through(camera, pool.rows, pool.cols, model.spec.pixel_center))
    moved = [code] if transient is None else [code, transient]
    descend(moved, lambda drawn: model.picture(placed.of(drawn), code, transient), pool, recipe)
    return code.detach()


def fit_map(
    model: SceneModel, view: View, image: np.ndarray, columns: int, recipe: FitRecipe, start: Tensor, seed: int = 0
) -> Tensor:
    """F^a (1, C, g, g) in which a rendered view comes closest to the first `columns` columns of `image`, uint8
    (h, w, 3), like `fit_code`.

    The features stay as they were rendered, and with them the statistics of their rays (by the model's own policy), so
    a step costs one affine map and the colours of the pixels that it draws.

    Args:
        start: F^a as it is read from a photo.

    Raises:
        ValueError: the model has no transform.
    """
    if model.transform is None:
        raise ValueError(f"model.appearance: {model.spec.appearance} has no F^a to fit")
    content = statistics_of(model, view)
    assert content is not None
    moved, pool = free(start), Pool(image, columns, recipe.pool, seed, view.features.device)
    features = view.features[pool.rows * view.size[1] + pool.cols]
    descend([moved], lambda drawn: recolour(features[drawn][None], *model.colour_map(content, moved))[0], pool, recipe)
    return moved.detach()


def free(start: Tensor) -> Tensor:
    """A copy that may be moved."""
    return start.detach().clone().requires_grad_()


def descend(moved: Sequence[Tensor], picture: Callable[[Tensor], Tensor], pool: Pool, recipe: FitRecipe) -> None:
    """Move what is `moved` so that `picture`, rgb (R, 3) of pixels (R,) of the pool, comes close to their colours."""
    optimiser = torch.optim.Adam(moved, lr=recipe.learning_rate)
    schedule = torch.optim.lr_scheduler.StepLR(optimiser, max(1, recipe.steps // recipe.stages), gamma=0.1)
    for drawn in pool.draws(recipe.steps, recipe.rays):
        loss = (picture(drawn) - pool.colours[drawn]).square().mean()
        for tensor, gradient in zip(moved, torch.autograd.grad(loss, moved), strict=True):
            tensor.grad = gradient
        optimiser.step()
        schedule.step()


def rays_through(camera: CameraRecord, rows: Tensor, cols: Tensor, pixel_center: float) -> Rays:
    """Rays (R) through pixels (R,) of a view."""
    intrinsics = torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy], device=rows.device)
    c2w = torch.tensor(camera.c2w, device=rows.device)
    origins, directions = pixel_rays(cols, rows, intrinsics, c2w, pixel_center)
    near, far = (origins.new_full((len(rows),), bound) for bound in (camera.near, camera.far))
    return Rays(origins, directions, near, far)
