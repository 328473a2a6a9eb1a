"""Where a run goes on, what it leaves behind for that, and that nobody else trains it meanwhile."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from filelock import FileLock, Timeout

from model.scene_model import SceneModel
from pipeline.checkpoint import Checkpoint, latest_checkpoint
from pipeline.clock import Clock
from pipeline.config import BOOKKEEPING, Job
from pipeline.errors import CrossrayError
from pipeline.heartbeat import rank_path, read_beat
from pipeline.photos import Photos

log = logging.getLogger("crossray")

PATIENCE = 20.0  # seconds in which a rank that was killed, or a node that was lost, has let go of the run


class TrainingError(CrossrayError):
    """Training cannot go on."""


def checkpoints(job: Job) -> Path:
    """The folder of the run's checkpoints."""
    return job.run / "checkpoints"


@contextmanager
def own_run(job: Job) -> Iterator[None]:
    """Hold the run, so that no second process writes into it; whoever dies lets go of it.

    Raises:
        TrainingError: another process holds it.
    """
    job.run.mkdir(parents=True, exist_ok=True)
    lock = FileLock(job.run / ".training.lock")
    try:
        lock.acquire(timeout=PATIENCE)
    except Timeout:
        beat = read_beat(rank_path(job.run, 0)) or {}
        where = f"process {beat['pid']} on {beat['host']}" if beat else "another process"
        raise TrainingError(
            f"{job.run}: {where} trains this run already; wait for it (`crossray status {job.run}`), stop it, or "
            "choose another name (--set name=...)"
        ) from None
    try:
        yield
    finally:
        lock.release()


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
    world_size: int,
) -> tuple[int, ...]:
    """Go on from the run's newest whole checkpoint, if there is one; returns the steps that were left out before it.

    Raises:
        TrainingError: the checkpoint belongs to other photos, another job, or another number of ranks; or it has
            trained on a step that the job leaves out.
    """
    checkpoint = latest_checkpoint(checkpoints(job))
    if checkpoint is None:
        return ()
    differs = [key for key, value in identity.items() if checkpoint.meta.get(key) != value]
    if differs:
        raise TrainingError(
            f"{checkpoint.folder} was written with other {' and '.join(differs)}: it cannot be gone on from. "
            f"Choose another name (--set name=...), or remove {job.run}"
        )
    check_ranks(job, checkpoint, world_size)
    skipped = tuple(checkpoint.meta["skipped"])
    late = [step for step in job.train.skip_steps if step < checkpoint.step and step not in skipped]
    if late:
        raise TrainingError(
            f"train.skip_steps: {checkpoint.folder} has been trained on step {late[0]} already; remove it and later "
            "checkpoints to go on from an earlier one, or take that step out of the list"
        )
    model.load_state_dict(checkpoint.model)
    optimiser.load_state_dict(checkpoint.optimiser())
    clock.step, clock.seconds = checkpoint.step, float(checkpoint.meta["seconds"])
    log.info("resuming %s from step %d", job.name, clock.step)
    return skipped


def check_ranks(job: Job, checkpoint: Checkpoint, world_size: int) -> None:
    """TrainingError where the checkpoint is of another number of ranks and the job does not allow that."""
    before = checkpoint.meta["world_size"]
    if before == world_size:
        return
    if not job.train.any_ranks:
        raise TrainingError(
            f"{checkpoint.folder} was written by {before} ranks, and now there are {world_size}: --set ranks={before} "
            "goes on exactly; --set train.any_ranks=true goes on with other numbers of rays a step"
        )
    if job.train.steps_per_epoch == "auto":
        raise TrainingError(
            "train.steps_per_epoch: auto depends on the number of ranks; to go on with another one, set it to the "
            f"number in {job.run / 'training.json'}"
        )
    log.warning(
        "%s goes on from %d ranks with %d: from step %d on a step averages over %d patches instead of %d, and the "
        "result is not the one of either number of ranks",
        job.name,
        before,
        world_size,
        checkpoint.step,
        world_size * job.patch.photos,
        before * job.patch.photos,
    )
