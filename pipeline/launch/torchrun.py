"""Ranks that somebody has already started: torchrun's variables are in the environment."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist

from pipeline.config import Job, load_job
from pipeline.errors import CrossrayError
from pipeline.launch.stop import RankStop
from pipeline.log import set_up_logging
from pipeline.train import train
from pipeline.work import Context

STOPPED = 143  # exit status of a rank that was asked to stop: 128 + SIGTERM, as a shell counts


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


def run_rank(job: Job, stage: Callable[[Job, Context], Any] = train) -> Any:
    """Train, or do what `stage` does, as the rank that RANK, WORLD_SIZE and LOCAL_RANK say.

    Raises:
        CrossrayError: the variables are missing, WORLD_SIZE is not the job's `ranks`, or restarts would not work.
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
    check_restarts()
    device = pick_device(job, local_rank)
    if device.type == "cuda":
        torch.cuda.set_device(device)
    dist.init_process_group("nccl" if device.type == "cuda" else "gloo")
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        result = stage(job, Context(rank, world, device, RankStop().install()))
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)  # nobody asks a rank that has returned whether it was told to stop
    dist.destroy_process_group()  # not after an error: it may wait for ranks that wait for this one
    return result


def check_restarts() -> None:
    """CrossrayError where torchrun would start ranks again with the addresses of dead ones: it keeps one store for all
    tries unless it is told not to (pytorch issue 135712)."""
    restarts = os.environ.get("TORCHELASTIC_MAX_RESTARTS", "0")
    if restarts != "0" and os.environ.get("TORCH_DISABLE_SHARE_RDZV_TCP_STORE") != "1":
        raise CrossrayError(
            f"torchrun --max-restarts={restarts} lets new ranks read the addresses of dead ones, and the restart can "
            "fail; start it with TORCH_DISABLE_SHARE_RDZV_TCP_STORE=1 in the environment"
        )


def run_rank_of(job_file: str) -> dict[str, Any]:
    """Entry point of a rank that this machine's own launcher starts.

    A rank that was stopped, or has lost its launcher, ends here: a return would wait for an agent that reads no results
    any more.
    """
    launcher = os.getppid()
    set_up_logging()
    result = run_rank(load_job(Path(job_file)))
    if not result["finished"] or os.getppid() != launcher:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(STOPPED)
    return result
