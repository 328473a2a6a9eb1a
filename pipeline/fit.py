"""Fitting an appearance code to a photo that the model has not seen: how NeRF-W is judged, and any model whose photos
have learned codes.

Nothing but the codes moves, so samples are placed once, for a pool of rays that the steps draw from. Codes start from
the mean over the training photos; the photo's transient code is fitted beside its appearance, so that people in the
photo do not tint it, and is dropped afterwards.
"""

from __future__ import annotations

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor

from model.cameras import pixel_rays
from model.fields.base import Rays
from model.scene_model import SceneModel
from pipeline.patches import step_generator
from pipeline.shards import CameraRecord

POOL = 4096  # rays whose samples are placed; with the paper's MLP and 128 samples, 0.5 GiB
DECAYS = 3  # the learning rate falls to a tenth after each third of the steps


class FitRecipe(BaseModel):
    """How a code is fitted; the defaults are the numbers of NeRF-W's public re-evaluation (nerfbaselines)."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    steps: int = Field(1000, ge=1)
    rays: int = Field(1024, ge=1)
    learning_rate: float = Field(0.01, gt=0)


def fit_code(
    model: SceneModel, image: np.ndarray, camera: CameraRecord, columns: int, recipe: FitRecipe, seed: int = 0
) -> Tensor:
    """The appearance code (1, CODE) in which the view of `camera` comes closest to the first `columns` columns of
    `image`, uint8 (h, w, 3): least mean squared error over random pixels, by Adam.

    Raises:
        ValueError: the model has no learned codes.
    """
    if model.embedding is None:
        raise ValueError(f"model.appearance: {model.spec.appearance} has no code to fit")
    device = model.embedding.weight.device
    code = model.embedding.weight.detach().mean(0, keepdim=True).requires_grad_()
    codes, transient = [code], None
    if model.transient_embedding is not None:
        transient = model.transient_embedding.weight.detach().mean(0, keepdim=True).requires_grad_()
        codes.append(transient)
    optimiser = torch.optim.Adam(codes, lr=recipe.learning_rate)
    schedule = torch.optim.lr_scheduler.StepLR(optimiser, max(1, recipe.steps // DECAYS), gamma=0.1)
    generator = step_generator(seed, 0, 0, "cpu")
    pixels = torch.randperm(image.shape[0] * columns, generator=generator)[:POOL].to(device)
    rows, cols = pixels // columns, pixels % columns
    photo = torch.from_numpy(np.array(image[:, :columns])).to(device)[rows, cols].float() / 255
    with torch.no_grad(), model.autocast(device):
        pool = model.field.place(rays_through(camera, rows, cols, model.spec.pixel_center))
    for _ in range(recipe.steps):
        drawn = torch.randint(len(pixels), (recipe.rays,), generator=generator).to(device)
        loss = (model.picture(pool.of(drawn), code, transient) - photo[drawn]).square().mean()
        for moved, gradient in zip(codes, torch.autograd.grad(loss, codes), strict=True):
            moved.grad = gradient
        optimiser.step()
        schedule.step()
    return code.detach()


def rays_through(camera: CameraRecord, rows: Tensor, cols: Tensor, pixel_center: float) -> Rays:
    """Rays (R) through pixels (R,) of a view."""
    intrinsics = torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy], device=rows.device)
    c2w = torch.tensor(camera.c2w, device=rows.device)
    origins, directions = pixel_rays(cols, rows, intrinsics, c2w, pixel_center)
    near, far = (origins.new_full((len(rows),), bound) for bound in (camera.near, camera.far))
    return Rays(origins, directions, near, far)
