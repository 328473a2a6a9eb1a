"""A run that is small enough for a test: a few seconds for some dozens of steps, every part of the model present."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from tiny_scene import write_tiny_scene

from model.methods import METHODS
from pipeline.checkpoint import latest_checkpoint
from pipeline.config import Job, make_job, merge
from pipeline.cutting import cut_shards
from pipeline.launch.tasks import in_process
from pipeline.photos import Photos, open_photos
from pipeline.resume import checkpoints
from pipeline.train import train
from pipeline.work import Context

SPLITS = ("train", "train", "train", "test", "val", "train")

HASH = {
    "levels": 4,
    "log2_entries": 8,
    "min_resolution": 4,
    "max_resolution": 32,
    "width": 16,
    "proposal_samples": 8,
    "samples": 4,
}
MLP = {"width": 16, "coarse_samples": 6, "fine_samples": 6, "xyz_frequencies": 4, "dir_frequencies": 2}


def tiny_mapping(folder: Path, method: str = "crossray", over: dict[str, Any] | None = None) -> dict[str, Any]:
    """The job file of a tiny run of `method`, its scene under `folder/scene`, its shards under `folder/shards`."""
    mapping: dict[str, Any] = {
        "name": "tiny",
        "method": method,
        "scene": {
            "path": str(folder / "scene"),
            "downscale": 2,
            "reference_downscale": 1,
            "shards": str(folder / "shards" / "tiny"),
        },
        "runs": str(folder / "runs"),
        "device": "cpu",
        "model": {"hash": HASH, "mlp": MLP},
        "patch": {"size": 8, "photos": 2},
        "train": {
            "epochs": 2,
            "steps_per_epoch": 6,
            "warmup_steps": 0,
            "precision": "float32",
            "log_every": 5,
            "picture_every": 1000,
            "checkpoint_every": 1000,
        },
    }
    if method == "crossray":
        mapping["model"]["channels"] = 8
    if METHODS[method].appearance == "code":  # its network reads no smaller picture
        mapping["patch"]["size"] = 16
    return merge(mapping, over or {})


def tiny_job(folder: Path, method: str = "crossray", over: dict[str, Any] | None = None) -> Job:
    return make_job(tiny_mapping(folder, method, over))


def cut_tiny(folder: Path, **scene: Any) -> Path:
    """Write the tiny scene, tint it so that there is something to learn soon, mask a corner of each photo, and cut its
    shards, without Ray."""
    write_tiny_scene(folder / "scene", splits=SPLITS, **scene)
    (folder / "scene" / "masks").mkdir()
    for path in sorted((folder / "scene" / "dense" / "images").iterdir()):
        texture = np.asarray(Image.open(path))
        Image.fromarray((0.2 * texture + (190, 110, 10)).astype(np.uint8)).save(path)
        mask = np.zeros(texture.shape[:2], np.uint8)
        mask[: mask.shape[0] // 2, : mask.shape[1] // 2] = 255
        Image.fromarray(mask).save(folder / "scene" / "masks" / f"{path.stem}.png")
    job = tiny_job(folder)
    cut_shards(
        job.scene.path,
        job.shards,
        downscale=job.scene.downscale,
        reference_downscale=job.scene.reference_downscale,
        plan=job.patch,
        mapper=in_process,
    )
    return folder


def tiny_photos(folder: Path) -> Photos:
    return open_photos(tiny_job(folder).shards)


def train_until(job: Job, step: int) -> dict[str, Any]:
    """Train as one rank; the launcher asks to stop in the step number `step` of this start."""
    asked = 0

    def should_stop() -> bool:  # called once a step
        nonlocal asked
        asked += 1
        return asked >= step

    return train(job, Context(should_stop=should_stop))


def final_state(job: Job) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Model tensors and optimiser state of the newest checkpoint."""
    checkpoint = latest_checkpoint(checkpoints(job))
    assert checkpoint is not None
    return checkpoint.model, checkpoint.optimiser()


def assert_same_bits(a: Any, b: Any, where: str = "state") -> None:
    """Equal in structure, and every tensor equal to the bit."""
    assert type(a) is type(b), where
    if isinstance(a, torch.Tensor):
        assert a.dtype == b.dtype, where
        assert a.shape == b.shape, where
        assert a.contiguous().numpy().tobytes() == b.contiguous().numpy().tobytes(), f"{where} differs"
    elif isinstance(a, dict):
        assert a.keys() == b.keys(), where
        for key in a:
            assert_same_bits(a[key], b[key], f"{where}.{key}")
    elif isinstance(a, list | tuple):
        assert len(a) == len(b), where
        for i, (x, y) in enumerate(zip(a, b, strict=True)):
            assert_same_bits(x, y, f"{where}[{i}]")
    else:
        assert a == b, where
