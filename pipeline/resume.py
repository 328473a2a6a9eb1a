"""Where a run goes on, what it leaves behind for that, and that nobody else trains it meanwhile."""

from __future__ import annotations

import hashlib
import json
import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from filelock import FileLock, Timeout

from model.scene_model import SceneModel
from pipeline.checkpoint import Checkpoint, latest_checkpoint
from pipeline.clock import Clock
from pipeline.config import BOOKKEEPING, Job
from pipeline.errors import CrossrayError
from pipeline.heartbeat import alive, rank_path, read_beat
from pipeline.photos import Photos

log = logging.getLogger("crossray")

LOCK = ".training.lock"  # held by who trains the run
PATIENCE = 20.0  # seconds in which a rank that was killed has let go of the run
LEASE = 150.0  # seconds until a network's disk lets go of what a node held that was lost


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
    lock, began = FileLock(job.run / LOCK), time.monotonic()
    while not lock.is_locked:
        try:
            lock.acquire(timeout=PATIENCE)
            break
        except Timeout:
            beat = read_beat(rank_path(job.run, 0)) or {}
        if beat and not alive(beat) and time.monotonic() - began < LEASE:
            continue
        where = f"process {beat['pid']} on {beat['host']}" if beat else "another process"
        raise TrainingError(
            f"{job.run}: {where} trains this run already; wait for it (`crossray status {job.run}`), stop it, or "
            "choose another name (--set name=...)"
        )
    try:
        yield
    finally:
        lock.release()


def check_run_folder(job: Job) -> None:
    """OSError where the folder of the run that this process holds has been moved or removed, or its disk has gone: a
    new one in its place would hold half a run."""
    if not (job.run / LOCK).exists():
        raise OSError(f"{job.run} has vanished: it was moved or removed, or its disk has gone")


def run_identity(job: Job, photos: Photos, steps_per_epoch: int) -> dict[str, Any]:
    """What must agree for a checkpoint to be this run's: the photos, and all of the job that enters the result; of the
    epoch's length the number, whether the job gives it or not."""
    left_out = {"train": {*BOOKKEEPING, "steps_per_epoch"}}
    relevant = job.model_dump(mode="json", include={"method", "model", "patch", "losses", "train"}, exclude=left_out)
    text = json.dumps(relevant, sort_keys=True)
    return {
        "shards": photos.manifest.content_hash,
        "job": hashlib.sha256(text.encode()).hexdigest(),
        "steps_per_epoch": steps_per_epoch,
    }


def resume(
    job: Job,
    identity: dict[str, Any],
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
    differs = [key for key in ("shards", "job") if checkpoint.meta.get(key) != identity[key]]
    if differs:
        raise TrainingError(
            f"{checkpoint.folder} was written with other {' and '.join(differs)}: it cannot be gone on from. "
            f"Choose another name (--set name=...), or remove {job.run}"
        )
    check_ranks(job, checkpoint, world_size)
    length = checkpoint.meta["steps_per_epoch"]
    if length != identity["steps_per_epoch"]:
        raise TrainingError(
            f"train.steps_per_epoch: {checkpoint.folder} is of epochs of {length} steps, and now they would have "
            f"{identity['steps_per_epoch']}; --set train.steps_per_epoch={length} goes on with it"
        )
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
