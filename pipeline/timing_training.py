"""What a training step costs: the one of `pipeline.train`, with its batch, losses, backward pass and optimiser.

The paper's table is minutes for 20 epochs of 17,200 iterations on 8 GPUs. Nobody waits for these here: the median of
measured steps is multiplied, and the row says so. Checkpoints, pictures and evaluations are not in it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
import torch.distributed as dist

from pipeline.averaging import distribute, room
from pipeline.batches import TrainingPhotos
from pipeline.clock import Clock
from pipeline.config import Job
from pipeline.photos import Photos
from pipeline.provenance import device_name
from pipeline.record import LossRecord, record_path
from pipeline.timing import TimingRow
from pipeline.timing_job import TimingJob, training_job, with_precision
from pipeline.timing_measure import Meter, Seconds, counted_flops, memory_of
from pipeline.timing_scene import synthetic_photos
from pipeline.together import Together
from pipeline.train import (
    LOOK_EVERY,
    build_model,
    build_optimiser,
    forward,
    set_learning_rates,
    set_up_torch,
    training_step,
    uses_bfloat16,
)
from pipeline.work import Context, Work

log = logging.getLogger("crossray")


def training_rows(timing: TimingJob, context: Context, meter: Meter, peak: Callable[[str], float]) -> list[TimingRow]:
    """Rows of the tables `training` and, over rays and photos, `cost`; all ranks call it, and rank 0's are the result.

    Args:
        peak: operations a second that the device reaches in a precision.
    """
    training = timing.training
    meter = replace(meter, agree=lambda repeats: agreed(repeats, context))
    photos = synthetic_photos(timing, training.photos)
    rows = []
    for method in training.methods:
        job = training_job(timing, method)
        for precision in precisions(timing, job, context.device):
            rows.append(step_row("training", with_precision(job, precision), photos, context, meter, peak))
    for method in timing.cost:
        for rays in training.cost_rays:
            job = with_precision(training_job(timing, method, rays), "float32")
            row = step_row("cost", job, photos, context, meter, peak)
            rows.append(row.model_copy(update={"varied": "rays"}))
        for count in training.cost_photos:
            job = with_precision(training_job(timing, method), "float32")
            row = step_row("cost", job, synthetic_photos(timing, count), context, meter, peak)
            rows.append(row.model_copy(update={"varied": "photos"}))
    return rows


def precisions(timing: TimingJob, job: Job, device: torch.device) -> tuple[str, ...]:
    """In which a method is timed: as the job says; `auto` adds bfloat16 where a training would choose it."""
    if timing.precision != "auto":
        return timing.precision
    return ("float32", "bfloat16") if uses_bfloat16(with_precision(job, "auto"), device) else ("float32",)


def step_row(
    table: str, job: Job, photos: Photos, context: Context, meter: Meter, peak: Callable[[str], float]
) -> TimingRow:
    """The row of a job's training step."""
    steps, precision = Steps(job, photos, context), job.train.precision
    rays = job.patch.photos * job.patch.size**2
    log.info("timing a step of %s: %d rays, %d photos, %s", job.method, rays, len(photos), precision)
    flops = steps.flops()
    block = LOOK_EVERY if context.device.type == "cuda" else 1
    seconds = meter.measure(lambda: steps.run(block)).times(1 / block)
    mlp, hashed = job.model.mlp, job.model.hash
    fields: dict[str, Any] = {
        "table": table,
        "method": job.method,
        "field": job.model.field,
        "how": "trained",
        "samples": (mlp.coarse_samples, mlp.fine_samples)
        if job.model.field == "mlp"
        else (hashed.proposal_samples, hashed.samples),
        "samples_as": "trained",
        "unit": "step",
        "seconds": seconds.median,
        "low": seconds.low,
        "high": seconds.high,
        "repeats": seconds.repeats,
        "peak_memory_MiB": seconds.memory,
        "memory_of": memory_of(context.device),
        "rays": rays,
        "ranks": context.world_size,
        "threads": job.threads,
        "precision": precision,
        "device": device_name(context.device),
        "photos": len(photos),
        "flops": flops,
        "peak_flops": peak(precision),
        "note": note_of(job),
    }
    if table == "training":
        fields |= schedule(job, seconds, block)
    return TimingRow(**fields)


def schedule(job: Job, seconds: Seconds, block: int = 1) -> dict[str, Any]:
    """Minutes of the job's epochs, and from how many steps they are extrapolated."""
    assert isinstance(job.train.steps_per_epoch, int)
    steps = job.train.epochs * job.train.steps_per_epoch
    return {
        "minutes": steps * seconds.median / 60,
        "steps": steps,
        "extrapolated": f"{job.train.epochs} x {job.train.steps_per_epoch:,} steps, from the median of "
        f"{seconds.repeats * block:,} measured ones",
    }


def note_of(job: Job) -> str | None:
    """What of the step is not the paper's."""
    if job.model.field == "mlp":
        return None
    k, photos = job.patch.size, job.patch.photos
    return (
        f"{photos} patches of {k} x {k} rays a step, and as many steps as the paper's schedule has; the fast recipe "
        "needs far fewer"
    )


def agreed(repeats: int, context: Context) -> int:
    """Rank 0's number, on all ranks."""
    if context.world_size == 1:
        return repeats
    shared = torch.tensor([repeats], device=context.device)
    dist.broadcast(shared, 0)
    return int(shared)


class Steps:
    """A training that can be gone on with, step by step, without a run's folder."""

    def __init__(self, job: Job, photos: Photos, context: Context) -> None:
        set_up_torch(job, context.device)
        assert isinstance(job.train.steps_per_epoch, int)
        data = TrainingPhotos(photos, context.device, job.model.pixel_center, masks=job.model.transient == "fixed")
        self.work = Work(job, context, data, job.train.steps_per_epoch)
        self.model = build_model(job, photos, context.device)
        self.optimiser = build_optimiser(self.model, job.train)
        self.together = Together(context, room(self.model, context))
        self.ddp = distribute(self.model, context, self.together)
        self.record = LossRecord(record_path(job.run, context.rank), 0)
        self.clock = Clock(job.train.epochs * job.train.steps_per_epoch, None)

    def run(self, count: int) -> None:
        """`count` steps, after each of which the ranks agree, then a look at their losses, as the training loop has one
        now and then."""
        for _ in range(count):
            set_learning_rates(self.optimiser, self.work.job.train, self.clock)
            training_step(self.work, self.ddp, self.optimiser, self.clock.step, self.record)
            self.clock.step += 1
            self.together.agree(False, 0.0)
        self.record.look()

    def flops(self) -> float:
        """Operations of a step, forward and backward; the weights stay as they are."""

        def step() -> None:
            terms, _ = forward(self.work, self.model, 0)
            torch.stack(list(terms.values())).sum().backward()

        counted = counted_flops(step)
        self.model.zero_grad(set_to_none=True)
        return counted
