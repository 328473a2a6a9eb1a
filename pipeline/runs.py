"""A trained run, read from its folder: job, checkpoint, model, photos."""

from __future__ import annotations

from pathlib import Path

import torch

from model.scene_model import SceneModel
from pipeline.checkpoint import Checkpoint, CheckpointError, committed, folder_name, latest_checkpoint, read_checkpoint
from pipeline.config import Job, load_job
from pipeline.errors import CrossrayError
from pipeline.files import resolved
from pipeline.photos import Photos, open_photos


def job_of(run: Path) -> Job:
    """The job of a run's folder. A run that was moved is where it is now; its shards stay where they were, or have
    moved with it.

    Raises:
        CrossrayError: no such run.
    """
    if not (run / "job.yaml").is_file():
        raise CrossrayError(f"{run} is not a run: it has no job.yaml")
    job, folder = load_job(run / "job.yaml"), resolved(run)
    scene = job.scene.model_copy(update={"shards": shards_of(job, folder)})
    return job.model_copy(update={"runs": folder.parent, "name": folder.name, "scene": scene})


def shards_of(job: Job, folder: Path) -> Path:
    """The shards of the run in `folder`. Paths of a job are relative to where it was started, which the run's own path
    tells; else they are as seen from here.
    """
    told = job.run.parts
    if job.shards.is_absolute() or job.run.is_absolute() or folder.parts[-len(told) :] != told:
        return job.shards
    started = folder.parents[len(told) - 1]
    elsewhere = started != resolved(Path()) and (started / job.shards).exists()
    return started / job.shards if elsewhere else job.shards


def checkpoint_of(run: Path, step: int | None = None) -> Checkpoint:
    """A run's checkpoint of `step`, by default the newest whole one.

    Raises:
        CheckpointError: there is none, or it is damaged.
    """
    if step is None:
        checkpoint = latest_checkpoint(run / "checkpoints")
        if checkpoint is None:
            raise CheckpointError(f"{run / 'checkpoints'}: no committed checkpoint; has the run been trained?")
        return checkpoint
    steps = [int(p.name.removeprefix("step-")) for p in committed(run / "checkpoints")]
    if step not in steps:
        raise CheckpointError(f"{run}: no checkpoint of step {step}; there are {', '.join(map(str, steps)) or 'none'}")
    return read_checkpoint(run / "checkpoints" / folder_name(step))


def model_of(job: Job, checkpoint: Checkpoint, device: torch.device | None = None) -> SceneModel:
    """A checkpoint's model in evaluation mode; by default on the GPU that this process has, if the job wants one."""
    torch.backends.cudnn.allow_tf32 = False  # as in training
    device = device or torch.device("cuda" if torch.cuda.is_available() and job.device != "cpu" else "cpu")
    box = torch.zeros(2, 3)  # the scene's box is one of its buffers
    model = SceneModel(job.model, box, checkpoint.meta["photos"]).to(device).requires_grad_(False)
    model.load_state_dict(checkpoint.model)
    return model.eval()


def load_run(
    run: Path, step: int | None = None, device: torch.device | None = None
) -> tuple[Job, SceneModel, Checkpoint]:
    """A run's job, its model in evaluation mode, and the checkpoint that it was read from (the newest, or `step`).

    Raises:
        CrossrayError: no such run, or no usable checkpoint in it.
    """
    job, checkpoint = job_of(run), checkpoint_of(run, step)
    return job, model_of(job, checkpoint, device), checkpoint


def photos_of(job: Job, checkpoint: Checkpoint) -> Photos:
    """The photos that a checkpoint was trained on.

    Raises:
        CrossrayError: the job's shards hold other ones, or cannot be read.
    """
    photos = open_photos(job.shards)
    if photos.manifest.content_hash != checkpoint.meta["shards"]:
        raise CrossrayError(
            f"{job.shards}: other photos or masks than {job.run} was trained on; --set scene.shards=... in a new run, "
            "or cut the shards again as they were"
        )
    return photos
