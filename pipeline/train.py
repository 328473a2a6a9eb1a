"""The training loop.

Each rank draws its own patches: what rank r sees in step s is a pure function of (seed, s, r), so a run can be stopped
and resumed anywhere. DDP averages gradients over the ranks; rank 0 alone writes: TensorBoard, checkpoints, progress.
"""

from __future__ import annotations

import itertools
import json
import math
import os
from contextlib import nullcontext
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils import get_total_norm

from model.methods import smallest_reference
from model.scene_model import SceneModel
from pipeline.averaging import distribute, room
from pipeline.batches import TrainingPhotos, check_references
from pipeline.board import Board, write_pictures, write_scalars
from pipeline.clock import Clock, Speed
from pipeline.config import Job, TrainJob
from pipeline.files import atomic_write
from pipeline.heartbeat import Heartbeat, rank_path
from pipeline.least_memory import check_memory
from pipeline.patches import steps_per_epoch
from pipeline.photos import Photos, open_photos
from pipeline.progress import Progress
from pipeline.provenance import device_name
from pipeline.record import GRADIENT, LossRecord, record_path
from pipeline.resume import own_run, resume, run_identity
from pipeline.together import Together, broken_step, check_finite, save
from pipeline.work import Context, Work

LOOK_EVERY = 10  # steps between the moments at which losses are read from the device
REPORT_EVERY = 60.0  # seconds between two reports to the launcher, at least


def train(job: Job, context: Context) -> dict[str, Any]:
    """Train until the job's end, or until the launcher asks to stop; returns what `training.json` of the run holds.

    Resumes from the run's newest whole checkpoint.

    Raises:
        TrainingError: a loss that is not a finite number, a checkpoint that is not this run's, or another process that
            trains this run.
    """
    with own_run(job) if context.rank == 0 else nullcontext():
        return train_owned(job, context)


def train_owned(job: Job, context: Context) -> dict[str, Any]:
    """Like `train`, of a run that nobody else trains."""
    check_memory(job, context.device)
    set_up_torch(job, context.device)
    photos = open_photos(job.shards)
    check_references(photos, smallest_reference(job.model))
    data = TrainingPhotos(photos, context.device, job.model.pixel_center, masks=job.model.transient == "fixed")
    work = Work(job, context, data, epoch_length(job, data.sizes, context.world_size))
    model = build_model(job, photos, context.device)
    optimiser = build_optimiser(model, job.train)
    seconds = job.train.seconds
    clock = Clock(None if seconds else job.train.epochs * work.steps_per_epoch, seconds)
    identity = run_identity(job, photos, work.steps_per_epoch)
    together = Together(context, room(model, context))
    ddp = distribute(model, context, together)
    if context.world_size > 2 and context.device.type == "cuda":
        warm_up(work, ddp)
    skipped = set(resume(job, identity, model, optimiser, clock, context.world_size))
    together.same_step(clock.step)

    lead = context.rank == 0
    record = LossRecord(record_path(job.run, context.rank), clock.step)
    heartbeat = Heartbeat(rank_path(job.run, context.rank))
    board = Board(job.run / "tensorboard", clock.step)
    progress = Progress(f"training {job.name}", clock.progress, enabled=lead)
    speed = Speed(clock, work.rays_a_step)
    terms: dict[str, Tensor] = {}
    watched: dict[str, Tensor] = {}
    reported, ends = clock.seconds, clock.done
    while not ends:
        if clock.step in job.train.skip_steps:
            record.leave_out()
            skipped.add(clock.step)
        else:
            set_learning_rates(optimiser, job.train, clock)
            terms, watched = training_step(work, ddp, optimiser, clock.step, record)
        clock.step += 1
        stopped, clock.seconds = together.agree(context.should_stop(), speed.seconds())

        ends = clock.done or stopped
        save_now = ends or clock.step % job.train.checkpoint_every == 0
        log_now = (clock.done or clock.step % job.train.log_every == 0) and bool(terms)
        if save_now or log_now or clock.step % LOOK_EVERY == 0:
            check_finite(work, together, record, model if save_now else None)
            progress.update(clock.progress, f"step {clock.step}  loss {float(sum(terms.values())):.4f}")
        if heartbeat.due():
            heartbeat.beat("training", ranks=context.world_size, **speed.facts())
        if log_now and lead:
            numbers = speed.numbers(terms, watched)
            board.write(write_scalars, clock.step, terms, watched, optimiser, numbers)
            context.watch(numbers)
        if save_now:
            meta = identity | {
                "seconds": clock.seconds,
                "finished": clock.done,
                "world_size": context.world_size,
                "photos": len(data.index),
                "skipped": sorted(skipped),
            }
            save(work, together, record, speed, model, optimiser, meta, last=ends)
            if terms and (ends or clock.seconds - reported >= REPORT_EVERY):
                reported = clock.seconds
                context.report(speed.numbers(terms, watched))
        if lead and (clock.step % job.train.picture_every == 0 or clock.done):
            board.write(write_pictures, clock.step, model, photos)  # after saving: nothing that it meets loses a step
    progress.close()
    board.close()
    heartbeat.beat("trained" if clock.done else "stopped", ranks=context.world_size, **speed.facts())
    result = {
        "steps": clock.step,
        "train_seconds": clock.seconds,
        "checkpoint_seconds": speed.all_checkpoint_seconds,
        "ranks": context.world_size,
        "finished": clock.done,
        "steps_per_epoch": work.steps_per_epoch,
        "rays_a_step": work.rays_a_step,
        "device": device_name(context.device),
        "bfloat16": model.use_bfloat16,
        "parameters": sum(p.numel() for p in model.parameters()),
    }
    if lead:
        atomic_write(job.run / "training.json", json.dumps(result, indent=2))
    return result


def training_step(
    work: Work, ddp: torch.nn.Module, optimiser: torch.optim.Optimizer, step: int, record: LossRecord
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """One optimisation step; returns the loss terms and what is worth watching."""
    try:
        terms, watched = forward(work, ddp, step)
    except (ValueError, torch.linalg.LinAlgError) as error:  # a closed form refuses numbers that are not finite
        bad = record.look()
        raise broken_step(work, bad.step if bad else step, [work.context.rank], str(error)) from error
    optimiser.zero_grad(set_to_none=True)
    torch.stack(list(terms.values())).sum().backward()
    terms = {name: value.detach() for name, value in terms.items()}
    watched["gradient_norm"] = gradient_norm(optimiser)
    record.add(terms | {GRADIENT: watched["gradient_norm"]})
    optimiser.step()
    return terms, watched


def gradient_norm(optimiser: torch.optim.Optimizer) -> Tensor:
    """Norm of the gradient of all networks. Hash tables are left out: they are large, and their gradient comes through
    a network, so what is not finite there is not finite here."""
    groups = (group["params"] for group in optimiser.param_groups if group["part"] != "grid")
    return get_total_norm([p.grad for group in groups for p in group if p.grad is not None])


def forward(work: Work, ddp: torch.nn.Module, step: int) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """The loss terms of one step of this rank."""
    return ddp(work.batch(step), step, work.generator(step), work.job.losses)


# ------------------------------------------------------------------------------------------------------ set-up


def set_up_torch(job: Job, device: torch.device) -> None:
    """Threads, and how exact float32 is."""
    torch.set_num_threads(job.threads)
    torch.backends.cudnn.allow_tf32 = False  # float32 is float32; torch's default would round in convolutions
    if job.train.deterministic and device.type == "cuda":
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
        torch.use_deterministic_algorithms(True, warn_only=True)  # where there is no such algorithm, torch says so
        torch.backends.cudnn.benchmark = False


def build_model(job: Job, photos: Photos, device: torch.device) -> SceneModel:
    """The job's model with its initial weights, which depend on the seed alone."""
    torch.manual_seed(job.patch.seed)
    model = SceneModel(job.model, torch.tensor(photos.manifest.scene.box), len(photos.indices("train"))).to(device)
    model.use_bfloat16 = uses_bfloat16(job, device)
    model.freeze_idle(job.losses)
    return model


def build_optimiser(model: SceneModel, train_job: TrainJob) -> torch.optim.Optimizer:
    """Adam, with one learning rate a part of the model."""
    rates = train_job.learning_rates
    groups = [
        {"params": parameters, "lr": getattr(rates, part), "base_lr": getattr(rates, part), "part": part}
        for part, parameters in model.parameter_groups().items()
    ]
    return torch.optim.Adam(groups, betas=train_job.adam_betas, eps=train_job.adam_epsilon, fused=True)


def warm_up(work: Work, ddp: torch.nn.Module) -> None:
    """Two backward passes whose gradients are dropped.

    DDP orders its buckets anew after the first one, and with more than two ranks nccl's sums depend on the order: a
    resumed run must start with the one that an undisturbed run has. Buffers are put back as they were.
    """
    before = {name: buffer.clone() for name, buffer in ddp.named_buffers()}
    step = next(step for step in itertools.count() if step not in work.job.train.skip_steps)
    for _ in range(2):
        terms, _ = forward(work, ddp, step)
        torch.stack(list(terms.values())).sum().backward()
        ddp.zero_grad(set_to_none=True)
    for name, buffer in ddp.named_buffers():
        buffer.copy_(before[name])


def epoch_length(job: Job, sizes: np.ndarray, world_size: int) -> int:
    """Steps an epoch."""
    if job.train.steps_per_epoch == "auto":
        return steps_per_epoch(job.patch, sizes, world_size)
    return job.train.steps_per_epoch


def uses_bfloat16(job: Job, device: torch.device) -> bool:
    """Whether the field computes in bfloat16. `auto`: on GPUs that have it; on CPUs with bfloat16 instructions for the
    paper's MLPs, whose step it halves, but not for the fast field, where it gains a tenth at most
    (benchmarks/results/precision.json)."""
    if job.train.precision != "auto":
        return job.train.precision == "bfloat16"
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return job.model.field == "mlp" and bool(torch.cpu._is_avx512_bf16_supported())


# ---------------------------------------------------------------------------------------------------- schedule


def set_learning_rates(optimiser: torch.optim.Optimizer, train_job: TrainJob, clock: Clock) -> None:
    """The learning rate of each part at this moment."""
    for group in optimiser.param_groups:
        group["lr"] = learning_rate(group["base_lr"], train_job, clock.step, clock.progress)


def learning_rate(base: float, train_job: TrainJob, step: int, progress: float) -> float:
    """`base` after warm-up and decay at `step`, when `progress` in [0, 1] of the training is done."""
    rate = base * min(1.0, (step + 1) / (train_job.warmup_steps + 1))
    if train_job.decay == "cosine":
        epoch = math.floor(progress * train_job.epochs + 1e-9)  # released code: constant inside an epoch
        low = 1e-8
        return low + (rate - low) * 0.5 * (1 + math.cos(math.pi * epoch / train_job.epochs))
    late = max(0.0, (progress - train_job.decay_from) / (1 - train_job.decay_from))
    return rate * train_job.decay_floor**late
