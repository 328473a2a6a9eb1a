"""The training loop.

Each rank draws its own patches: what rank r sees in step s is a pure function of (seed, s, r), so a run can be stopped
and resumed anywhere. DDP averages gradients over the ranks; rank 0 alone writes: TensorBoard, checkpoints, progress.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor
from torch.nn.parallel import DistributedDataParallel
from torch.utils.tensorboard import SummaryWriter

from model.methods import smallest_reference
from model.scene_model import Batch, SceneModel, needs_other, needs_references
from pipeline.batches import TrainingPhotos, check_references, jitter_colours
from pipeline.board import psnr_of, write_pictures, write_scalars
from pipeline.checkpoint import latest_checkpoint, prune, save_checkpoint
from pipeline.config import BOOKKEEPING, Job, TrainJob
from pipeline.errors import CrossrayError
from pipeline.files import atomic_write
from pipeline.patches import Patch, patches, step_generator, steps_per_epoch
from pipeline.photos import Photos, open_photos
from pipeline.progress import Progress

log = logging.getLogger("crossray")

JITTER = 4  # keeps these draws apart from those of the patches
AGREE_EVERY = 10  # steps between the moments at which all ranks agree on time and on stopping
SLOW_STEP = 1.0  # seconds; steps longer than this end with an agreement each, so that a stop is heard in time


class TrainingError(CrossrayError):
    """Training cannot go on."""


@dataclass(frozen=True)
class Context:
    """What a launcher tells a rank; the process group, if there are several ranks, is already there."""

    rank: int = 0
    world_size: int = 1
    device: torch.device = torch.device("cpu")
    should_stop: Callable[[], bool] = lambda: False
    watch: Callable[[dict[str, float]], None] = lambda numbers: None
    """Takes speed and loss every `log_every` steps, on rank 0 alone."""
    report: Callable[[dict[str, float]], None] = lambda numbers: None
    """Takes the same after a checkpoint, on all ranks in the same step; it may cost seconds, so it is called rarely."""


@dataclass(frozen=True)
class Work:
    """What a rank does in each step: fixed for the whole run, and a pure function of the step."""

    job: Job
    context: Context
    data: TrainingPhotos
    steps_per_epoch: int

    def patches(self, step: int) -> list[Patch]:
        """Which patches this rank sees in a step."""
        return patches(
            self.job.patch,
            self.data.sizes,
            step=step,
            rank=self.context.rank,
            world_size=self.context.world_size,
            steps_per_epoch=self.steps_per_epoch,
        )

    def batch(self, step: int) -> Batch:
        """The pixels, rays and references of these patches."""
        model, size = self.job.model, self.job.patch.size
        others, references = needs_other(model, self.job.losses), needs_references(model)
        batch = self.data.batch(self.patches(step), size, others, references)
        strength = self.job.train.colour_jitter
        if strength == 0:
            return batch
        return jitter_colours(batch, strength, np.random.default_rng((JITTER, self.seed, step, self.context.rank)))

    def generator(self, step: int) -> torch.Generator:
        """The source of everything else that is drawn in a step."""
        return step_generator(self.seed, step, self.context.rank, self.context.device)

    @property
    def seed(self) -> int:
        """Of everything that is drawn."""
        return self.job.patch.seed

    @property
    def rays_a_step(self) -> int:
        """Over all ranks."""
        return self.job.patch.photos * self.job.patch.size**2 * self.context.world_size


@dataclass
class Clock:
    """How far training is: by steps, or by seconds where the job gives seconds."""

    total_steps: int | None
    total_seconds: float | None
    step: int = 0
    seconds: float = 0.0

    @property
    def progress(self) -> float:
        """Share of the training that is done, in [0, 1]."""
        if self.total_seconds is not None:
            return min(self.seconds / self.total_seconds, 1.0)
        assert self.total_steps is not None
        return self.step / self.total_steps

    @property
    def done(self) -> bool:
        """Whether no step is left."""
        return self.progress >= 1


def train(job: Job, context: Context) -> dict[str, Any]:
    """Train until the job's end, or until the launcher asks to stop; returns what `training.json` of the run holds.

    Resumes from the run's newest whole checkpoint.

    Raises:
        TrainingError: a loss that is not a finite number, or a checkpoint that is not this run's.
    """
    torch.set_num_threads(job.threads)
    torch.backends.cudnn.allow_tf32 = False  # float32 is float32; torch's default would round in convolutions
    photos = open_photos(job.shards)
    check_references(photos, smallest_reference(job.model))
    data = TrainingPhotos(photos, context.device, job.model.pixel_center, masks=job.model.transient == "fixed")
    work = Work(job, context, data, epoch_length(job, data.sizes, context.world_size))
    model = build_model(job, photos, context.device)
    optimiser = build_optimiser(model, job.train)
    seconds = job.train.seconds
    clock = Clock(None if seconds else job.train.epochs * work.steps_per_epoch, seconds)
    identity = run_identity(job, photos)
    ddp = distribute(model, context)
    if context.world_size > 2:
        warm_up(work, ddp)
    resume(job, identity, model, optimiser, clock, context)

    lead = context.rank == 0
    writer = SummaryWriter(str(job.run / "tensorboard"), purge_step=clock.step + 1) if lead else None
    progress = Progress(f"training {job.name}", clock.progress, enabled=lead)
    last_saved, stopped, slow = clock.step, False, False
    last_log = (clock.step, time.perf_counter())
    started = time.perf_counter() - clock.seconds
    while not clock.done:
        set_learning_rates(optimiser, job.train, clock)
        terms, watched = training_step(work, ddp, optimiser, clock.step)
        clock.step += 1

        if slow or clock.step % AGREE_EVERY == 0 or clock.total_steps == clock.step:
            stopped, clock.seconds = agree(context, time.perf_counter() - started)
            slow = clock.seconds / clock.step > SLOW_STEP
            progress.update(clock.progress, f"step {clock.step}  PSNR {psnr_of(watched['mse']):.1f}")
        save_now = clock.done or stopped or clock.step % job.train.checkpoint_every == 0
        log_now = clock.done or clock.step % job.train.log_every == 0
        if save_now or log_now:
            check_finite(work, terms, model, clock.step - 1)
        if writer is not None and log_now:
            rate = (clock.step - last_log[0]) * work.rays_a_step / (time.perf_counter() - last_log[1])
            write_scalars(writer, clock.step, terms, watched, optimiser, rate)
            last_log = (clock.step, time.perf_counter())
        if save_now:
            if lead and clock.step != last_saved:
                meta = identity | {
                    "seconds": clock.seconds,
                    "finished": clock.done,
                    "world_size": context.world_size,
                    "photos": len(data.index),
                }
                save_checkpoint(checkpoints(job), clock.step, model.state_dict(), optimiser.state_dict(), meta)
                prune(checkpoints(job), job.train.keep_checkpoints)
            last_saved = clock.step
        if writer is not None and (clock.step % job.train.picture_every == 0 or clock.done):
            write_pictures(writer, clock.step, model, photos)  # after saving: nothing that it meets can lose a step
        if stopped:
            break
    progress.close()
    if writer is not None:
        writer.close()
    result = {
        "steps": clock.step,
        "train_seconds": clock.seconds,
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
    work: Work, ddp: torch.nn.Module, optimiser: torch.optim.Optimizer, step: int
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """One optimisation step; returns the loss terms and what is worth watching."""
    try:
        terms, watched = forward(work, ddp, step)
    except (
        ValueError,
        torch.linalg.LinAlgError,
    ) as error:  # a closed form cannot go on from numbers that are not finite
        raise TrainingError(f"step {step}: {error}; the last good checkpoint is in {checkpoints(work.job)}") from error
    optimiser.zero_grad(set_to_none=True)
    torch.stack(list(terms.values())).sum().backward()
    optimiser.step()
    return {k: v.detach() for k, v in terms.items()}, watched


def forward(work: Work, ddp: torch.nn.Module, step: int) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """The loss terms of one step of this rank."""
    return ddp(work.batch(step), step, work.generator(step), work.job.losses)


# ------------------------------------------------------------------------------------------------------ set-up


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


def distribute(model: SceneModel, context: Context) -> torch.nn.Module:
    """DDP where there are several ranks; buffers follow rank 0's."""
    if context.world_size == 1:
        return model
    devices = [context.device.index] if context.device.type == "cuda" else None
    return DistributedDataParallel(model, device_ids=devices)


def warm_up(work: Work, ddp: torch.nn.Module) -> None:
    """Two backward passes whose gradients are dropped.

    DDP orders its buckets anew after the first one, and with more than two ranks the order of a sum changes its last
    bits: a resumed run must start with the order that an undisturbed one has. Buffers are put back as they were.
    """
    before = {name: buffer.clone() for name, buffer in ddp.named_buffers()}
    for _ in range(2):
        terms, _ = forward(work, ddp, 0)
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


# ------------------------------------------------------------------------------------------------------ resume


def checkpoints(job: Job) -> Path:
    """The folder of the run's checkpoints."""
    return job.run / "checkpoints"


def run_identity(job: Job, photos: Photos) -> dict[str, str]:
    """What must agree for a checkpoint to be this run's: the photos, and all of the job that enters the result."""
    relevant = job.model_dump(
        mode="json", include={"method", "model", "patch", "losses", "train"}, exclude={"train": set(BOOKKEEPING)}
    )
    text = json.dumps(relevant, sort_keys=True)
    return {"shards": photos.manifest.content_hash, "job": hashlib.sha256(text.encode()).hexdigest()}


def resume(
    job: Job,
    identity: dict[str, str],
    model: SceneModel,
    optimiser: torch.optim.Optimizer,
    clock: Clock,
    context: Context,
) -> None:
    """Go on from the run's newest whole checkpoint, if there is one.

    Raises:
        TrainingError: the checkpoint belongs to other photos, another job, or another number of ranks.
    """
    checkpoint = latest_checkpoint(checkpoints(job))
    if checkpoint is None:
        return
    expected = identity | {"world_size": context.world_size}
    differs = [key for key, value in expected.items() if checkpoint.meta.get(key) != value]
    if differs:
        raise TrainingError(
            f"{checkpoint.folder} was written with other {' and '.join(differs)}: it cannot be gone on from. "
            f"Choose another name (--set name=...), or remove {job.run}"
        )
    model.load_state_dict(checkpoint.model)
    optimiser.load_state_dict(checkpoint.optimiser())
    clock.step, clock.seconds = checkpoint.step, float(checkpoint.meta["seconds"])
    if context.rank == 0:
        log.info("resuming %s from step %d", job.name, clock.step)


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


def agree(context: Context, seconds: float) -> tuple[bool, float]:
    """All ranks take rank 0's clock, and stop if any of them was asked to."""
    if context.world_size == 1:
        return context.should_stop(), seconds
    shared = torch.tensor([float(context.should_stop()), seconds if context.rank == 0 else 0.0], dtype=torch.float64)
    shared = shared.to(context.device)
    dist.all_reduce(shared)
    return bool(shared[0] > 0), float(shared[1])


def check_finite(work: Work, terms: dict[str, Tensor], model: SceneModel, step: int) -> None:
    """Stop before numbers that are not finite reach a checkpoint."""
    bad = [f"the loss {name}" for name, value in terms.items() if not math.isfinite(float(value))]
    bad += [f"the weights {name}" for name, value in model.named_parameters() if not bool(value.isfinite().all())][:3]
    if bad:
        records = work.data.photos.records
        names = sorted({records[work.data.index[p.photo]].name for p in work.patches(step)})
        raise TrainingError(
            f"step {step}: {', '.join(bad)} not finite (this rank's photos in this step: {', '.join(names)}). "
            f"The last good checkpoint is in {checkpoints(work.job)}; a lower learning rate is the usual cure"
        )


def device_name(device: torch.device) -> str:
    """The device as its maker calls it."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    for line in Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []:
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return "cpu"
