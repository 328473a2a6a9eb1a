"""What a rank holds at least, so that sizes which no machine has are refused before the system ends the process."""

from __future__ import annotations

import psutil
import torch

from pipeline.config import Job
from pipeline.errors import CrossrayError

LAYERS = 9  # of the paper's MLP: eight, and the one that reads directions
HELD = 4  # floats a parameter: itself, its gradient, and Adam's two averages


def check_memory(job: Job, device: torch.device) -> None:
    """CrossrayError where one rank's step cannot fit into the memory of its device."""
    least, room = step_bytes(job) + table_bytes(job), memory_of(device)
    if least <= room:
        return
    owner = "the GPU" if device.type == "cuda" else "this machine"
    raise CrossrayError(
        f"a step of {job.patch.photos} patches of {job.patch.size} x {job.patch.size} rays holds at least "
        f"{least / 2**30:,.0f} GiB, and {owner} has {room / 2**30:,.0f}; make patch.size, patch.photos or the sizes in "
        f"model.{job.model.field} smaller"
    )


def step_bytes(job: Job) -> int:
    """Of what the field's networks have to keep for the backward pass; more is held beside it."""
    model, rays = job.model, job.patch.photos * job.patch.size**2
    if model.field == "hash":
        sizes = model.hash
        return 4 * rays * (sizes.proposal_samples + sizes.samples * (2 * sizes.levels + sizes.width + model.channels))
    points = 2 * model.mlp.coarse_samples + model.mlp.fine_samples
    return 2 * rays * points * LAYERS * model.mlp.width  # bfloat16 where that is used


def table_bytes(job: Job) -> int:
    """Of the hash grid's tables, full ones."""
    sizes = job.model.hash
    return 4 * HELD * sizes.levels * 2**sizes.log2_entries * 2 if job.model.field == "hash" else 0


def memory_of(device: torch.device) -> int:
    """Bytes of all of it, used or not."""
    if device.type == "cuda":
        return torch.cuda.get_device_properties(device).total_memory
    return psutil.virtual_memory().total
