"""Ranks that somebody has already started: torchrun's variables are in the environment."""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist

from pipeline.config import Job, load_job
from pipeline.errors import CrossrayError
from pipeline.log import set_up_logging
from pipeline.train import Context, train


class StopFlag:
    """Set by SIGTERM or Ctrl-C: the ranks agree on it, write a checkpoint and return. A later Ctrl-C ends at once."""

    def __init__(self) -> None:
        self.set = False
        self.since = 0.0

    def install(self) -> StopFlag:
        """Listen from now on."""
        signal.signal(signal.SIGTERM, self.stop)
        signal.signal(signal.SIGINT, self.stop)
        return self

    def stop(self, number: int, frame: object) -> None:
        """The handler. One Ctrl-C arrives twice where a launcher hands it to ranks that had it from the terminal."""
        if self.set and number == signal.SIGINT and time.monotonic() - self.since > 2:
            raise KeyboardInterrupt
        if not self.set:
            self.set, self.since = True, time.monotonic()

    def __call__(self) -> bool:
        return self.set


def pick_device(job: Job, local_rank: int) -> torch.device:
    """The device of one rank.

    Raises:
        CrossrayError: the job wants CUDA, or more ranks than there are GPUs, and the machine lacks them.
    """
    available = torch.cuda.is_available()
    if job.device == "cuda" and not available:
        raise CrossrayError(
            "device: cuda, but torch sees no GPU here; jobs/train_scene_cpu.yaml is made for training without one, and "
            "--set device=cpu runs any job on the processor"
        )
    if job.device == "cpu" or not available:
        return torch.device("cpu")
    if local_rank >= torch.cuda.device_count():
        raise CrossrayError(
            f"ranks: rank {local_rank} of this machine has no GPU of its own ({torch.cuda.device_count()} here); "
            f"--set ranks={torch.cuda.device_count()} fits"
        )
    return torch.device("cuda", local_rank)


def run_rank(job: Job) -> dict[str, Any]:
    """Train as the rank that RANK, WORLD_SIZE and LOCAL_RANK say.

    Raises:
        CrossrayError: the variables are missing, or WORLD_SIZE is not the job's `ranks`.
    """
    try:
        rank, world, local_rank = (int(os.environ[k]) for k in ("RANK", "WORLD_SIZE", "LOCAL_RANK"))
    except KeyError as error:
        raise CrossrayError(
            f"launcher: torchrun, but {error} is not set; start the ranks with "
            f"`torchrun --nproc-per-node={job.ranks} -m pipeline run JOB.yaml --launcher torchrun`"
        ) from None
    if world != job.ranks:
        raise CrossrayError(f"ranks: the job wants {job.ranks}, torchrun started {world}; --set ranks={world} fits")
    device = pick_device(job, local_rank)
    if device.type == "cuda":
        torch.cuda.set_device(device)
    dist.init_process_group("nccl" if device.type == "cuda" else "gloo")
    try:
        return train(job, Context(rank, world, device, StopFlag().install()))
    finally:
        dist.destroy_process_group()


def run_rank_of(job_file: str) -> dict[str, Any]:
    """Entry point of a rank that this machine's own launcher starts."""
    set_up_logging()
    result = run_rank(load_job(Path(job_file)))
    if not result["finished"]:
        sys.stdout.flush()
        sys.stderr.flush()
        # Asked to stop: the agent that started this rank reads no results any more, and a return would wait for it.
        os._exit(0)
    return result
