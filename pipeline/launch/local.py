"""All ranks on this machine: one runs in this process, several are started by torch's own elastic launcher."""

from __future__ import annotations

import json
import logging
import os
import signal
import uuid
from collections.abc import Callable
from typing import Any

from pipeline.config import Job, save_job
from pipeline.errors import CrossrayError
from pipeline.launch.stop import StopFlag
from pipeline.launch.torchrun import STOPPED, pick_device, run_rank_of
from pipeline.photos import open_photos
from pipeline.train import train
from pipeline.work import Context

RANKS_A_CORE = 16  # more than anyone wants
GRACE = 120  # seconds that ranks have for their last checkpoint and picture


def run_local(job: Job) -> dict[str, Any]:
    """Train with the job's ranks on this machine; returns rank 0's result.

    Raises:
        CrossrayError: more ranks than this machine could run, or one failed; its own message stands above.
    """
    device, most = pick_device(job, 0), RANKS_A_CORE * (os.cpu_count() or 1)
    if device.type == "cpu" and job.ranks > most:
        raise CrossrayError(f"ranks: {job.ranks} processes on this machine's {os.cpu_count()} cores; at most {most}")
    if job.ranks == 1:
        previous = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
        try:
            return train(job, Context(device=device, should_stop=StopFlag().install()))
        finally:
            for number, handler in previous.items():
                signal.signal(number, handler)
    return run_ranks(job)


def run_ranks(job: Job) -> dict[str, Any]:
    """Several ranks as processes; if one fails, all are ended."""
    from torch.distributed.elastic.multiprocessing.api import SignalException
    from torch.distributed.elastic.multiprocessing.errors import ChildFailedError

    open_photos(job.shards)  # damaged shards are found once, here, and not by every rank
    job_file = job.run / "job.yaml"
    save_job(job, job_file)
    before = written(job)
    try:
        return start_ranks(job, run_rank_of, str(job_file))[0]
    except SignalException:
        return stopped(job, before)
    except ChildFailedError as error:
        rank, failure = error.get_first_failure()
        if failure.exitcode == STOPPED:  # somebody has asked one of the ranks, and not this process
            return stopped(job, before)
        raise CrossrayError(f"training stopped: rank {rank} failed: {first_line(failure.message)}") from None


def start_ranks(job: Job, entry: Callable[..., Any], *arguments: Any) -> dict[int, Any]:
    """Call `entry` in a process each of the job's ranks, with torchrun's variables set; what it returns, by rank.

    Raises:
        ChildFailedError, SignalException: torch's, when a rank failed or this process was told to stop.
    """
    from torch.distributed.launcher.api import LaunchConfig, elastic_launch

    logging.getLogger("torch.distributed.elastic").setLevel(logging.CRITICAL)  # what went wrong is raised below
    # A rank waiting for another one must not spin on the core that the other needs.
    for name, value in (("OMP_NUM_THREADS", str(job.threads)), ("OMP_WAIT_POLICY", "PASSIVE")):
        os.environ.setdefault(name, value)
    os.environ.setdefault("GLOO_SOCKET_IFNAME", "lo")
    config = LaunchConfig(
        min_nodes=1,
        max_nodes=1,
        nproc_per_node=job.ranks,
        run_id=uuid.uuid4().hex,
        rdzv_backend="c10d",
        rdzv_endpoint="127.0.0.1:0",
        local_addr="127.0.0.1",
        max_restarts=0,
        monitor_interval=0.1,
        start_method="spawn",
        shutdown_timeout=GRACE,
    )
    return elastic_launch(config, entry)(*arguments)


def written(job: Job) -> int | None:
    """When the run's training.json was written, None if it is not there."""
    path = job.run / "training.json"
    return path.stat().st_mtime_ns if path.exists() else None


def stopped(job: Job, before: int | None) -> dict[str, Any]:
    """The result of ranks that were stopped.

    Raises:
        CrossrayError: they have not saved; `before` is when training.json had been written before they started.
    """
    if written(job) == before:
        raise CrossrayError(
            f"{job.run}: stopped, and nothing was saved since it was started (what is said above tells why); the same "
            "command goes on from the last checkpoint"
        )
    return json.loads((job.run / "training.json").read_text())


def first_line(message: Any) -> str:
    """What went wrong, from an elastic failure record."""
    text = message.get("message", "") if isinstance(message, dict) else str(message)
    return text.strip().splitlines()[0] if text.strip() else "no message; see the log above"
