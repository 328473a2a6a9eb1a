"""What TensorBoard shows of a run: loss terms, speed, learning rates, memory, and a fixed view as it gets better."""

from __future__ import annotations

import math

import numpy as np
import psutil
import torch
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter

from model.scene_model import SceneModel
from pipeline.photos import Photos
from pipeline.render import colour_view, predicted_mask, render_view, training_appearance

PICTURE_SIDE = 160  # pictures are rendered at about this many pixels a side


def psnr_of(mse: Tensor | float) -> float:
    """-10 log10 of a mean squared error."""
    return -10 * math.log10(max(float(mse), 1e-10))


def write_scalars(
    writer: SummaryWriter,
    step: int,
    terms: dict[str, Tensor],
    watched: dict[str, Tensor],
    optimiser: torch.optim.Optimizer,
    rays_per_second: float,
) -> None:
    """Every loss term, what is watched, speed, learning rates, memory."""
    for name, value in terms.items():
        writer.add_scalar(f"loss/{name}", float(value), step)
    writer.add_scalar("loss/total", float(sum(terms.values())), step)
    writer.add_scalar("train/psnr", psnr_of(watched["mse"]), step)
    if "mask" in watched:
        writer.add_scalar("train/mask_share", float(watched["mask"]), step)
    for group in optimiser.param_groups:
        writer.add_scalar(f"learning_rate/{group['part']}", group["lr"], step)
    writer.add_scalar("speed/rays_per_second", rays_per_second, step)
    writer.add_scalar("memory/resident_MiB", psutil.Process().memory_info().rss / 2**20, step)
    if torch.cuda.is_available():
        writer.add_scalar("memory/gpu_peak_MiB", torch.cuda.max_memory_allocated() / 2**20, step)


def write_pictures(writer: SummaryWriter, step: int, model: SceneModel, photos: Photos) -> None:
    """A fixed validation view with its PSNR, depth, and mask; a training view where there is no other, or where the
    model knows the appearance of training photos alone."""
    seen = () if model.embedding is not None else photos.indices("val")
    index = (seen or photos.indices("train"))[0]
    camera = photos.records[index]
    stride = max(1, round(max(camera.width, camera.height) / PICTURE_SIDE))
    model.eval()
    appearance = training_appearance(model, photos, index)
    view = render_view(model, camera, appearance if model.coded else None, stride=stride)
    picture = colour_view(model, view, appearance)
    photo = photos.image(index)[stride // 2 :: stride, stride // 2 :: stride] / 255
    writer.add_image("view/rendered", picture, step, dataformats="HWC")
    writer.add_image("view/photo", photo, step, dataformats="HWC")
    depth = (view.depth / view.depth.max().clamp(min=1e-6)).cpu().numpy()
    writer.add_image("view/depth", depth, step, dataformats="HW")
    writer.add_scalar("view/psnr", psnr_of(float(np.square(picture - photo).mean())), step)
    masked = index if model.segmenter is not None else photos.indices("train")[0]
    mask = predicted_mask(model, photos, masked, stride)
    if mask is not None:
        writer.add_image("view/mask", mask, step, dataformats="HW")
    model.train()
