"""What TensorBoard shows of a run: loss terms, speed, learning rates, memory, and a fixed view as it gets better."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import torch
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter

from model.scene_model import SceneModel
from pipeline.metrics import psnr_of
from pipeline.photos import Photos
from pipeline.render import colour_view, predicted_mask, render_view, training_appearance

log = logging.getLogger("crossray")

PICTURE_SIDE = 160  # pictures are rendered at about this many pixels a side


class Board:
    """A run's TensorBoard; what an earlier start wrote after `step` is hidden.

    A disk that is full takes no step from the training: it costs curves until there is room again.
    """

    def __init__(self, folder: Path, step: int) -> None:
        self.folder = folder
        self.purge_from: int | None = step + 1
        self.writer: SummaryWriter | None = None
        threading.excepthook = told_once

    def write(self, what: Callable[..., None], step: int, *args: Any) -> None:
        """`what(writer, step, *args)`."""
        try:
            if self.writer is None:
                self.writer = SummaryWriter(str(self.folder), purge_step=self.purge_from)
                self.purge_from = None
            what(self.writer, step, *args)
        except OSError as error:
            log.warning("%s: step %d cannot be written (%s)", self.folder, step, error)
            self.writer = None  # its thread has ended with the error

    def close(self) -> None:
        """Everything is in the file when this returns."""
        try:
            if self.writer is not None:
                self.writer.close()
        except OSError as error:
            log.warning("%s: the last steps cannot be written (%s)", self.folder, error)


def told_once(error: threading.ExceptHookArgs) -> None:
    """An error that ended a thread; not that of a writer whose disk takes nothing: the next write raises it again."""
    if not (issubclass(error.exc_type, OSError) and type(error.thread).__module__.startswith("tensorboard")):
        threading.__excepthook__(error)


def write_scalars(
    writer: SummaryWriter,
    step: int,
    terms: dict[str, Tensor],
    watched: dict[str, Tensor],
    optimiser: torch.optim.Optimizer,
    numbers: dict[str, float],
) -> None:
    """Every loss term, what is watched, speed, learning rates, memory."""
    for name, value in terms.items():
        writer.add_scalar(f"loss/{name}", float(value), step)
    writer.add_scalar("loss/total", numbers["loss"], step)
    writer.add_scalar("train/psnr", numbers["psnr"], step)
    writer.add_scalar("train/gradient_norm", float(watched["gradient_norm"]), step)
    if "mask" in watched:
        writer.add_scalar("train/mask_share", float(watched["mask"]), step)
    for group in optimiser.param_groups:
        writer.add_scalar(f"learning_rate/{group['part']}", group["lr"], step)
    for name in ("rays_per_second", "step_seconds", "checkpoint_seconds"):
        writer.add_scalar(f"speed/{name}", numbers[name], step)
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
    try:
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
    finally:
        model.train()


def write_evaluation(folder: Path, step: int, protocol: str, mean: dict[str, float], picture: np.ndarray) -> None:
    """An evaluation's means, and one of its pictures, uint8 (h, w, 3), made small; at the checkpoint's own step.

    Each evaluation has a file of its own in `folder`: they come from any process, in any order.
    """
    stride = max(1, round(max(picture.shape[:2]) / PICTURE_SIDE))
    with SummaryWriter(str(folder)) as writer:
        for metric, value in mean.items():
            writer.add_scalar(f"eval/{protocol}/{metric}", value, step)
        writer.add_image(f"eval/{protocol}/view", picture[::stride, ::stride], step, dataformats="HWC")
