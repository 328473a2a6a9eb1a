"""Runs a timing: inference in this process, training steps in as many ranks as the job says; then timing.json."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import cache
from typing import Any

from pipeline.config import Job
from pipeline.errors import CrossrayError
from pipeline.launch.local import first_line, start_ranks
from pipeline.launch.torchrun import pick_device, run_rank
from pipeline.log import set_up_logging
from pipeline.provenance import provenance
from pipeline.timing import TimingRow, write_timing
from pipeline.timing_inference import inference_rows
from pipeline.timing_job import TimingJob, make_timing, method_job, threads_of
from pipeline.timing_measure import Meter, peak_flops
from pipeline.timing_training import training_rows
from pipeline.train import set_up_torch
from pipeline.work import Context


def run_timing(timing: TimingJob) -> list[TimingRow]:
    """Time what the job says, and write `<runs>/<name>/timing.json`; ranks other than 0 return no rows.

    Raises:
        CrossrayError: there are fewer GPUs than ranks, or torchrun's ranks are not those of the job.
    """
    origin = provenance()
    rows: list[TimingRow] = []
    job = method_job(timing, "crnerf")  # of any method: it says where the ranks are, and how many threads they have
    if "RANK" in os.environ:
        if timing.what != ("training",):
            raise CrossrayError("what: torchrun starts ranks, and images are rendered by one; --set 'what=[training]'")
        rows = [TimingRow(**row) for row in run_rank(job, lambda _, context: time_steps(timing, context))]
        if os.environ["RANK"] != "0":
            return []
    else:
        pick_device(job, job.ranks - 1)  # a job that wants more than there is says so before anything is timed
        if "inference" in timing.what:
            rows += time_images(timing, job)
        if "training" in timing.what:
            rows += in_ranks(timing, job)
    write_timing(timing.folder, rows, timing.model_dump(mode="json"), origin)
    return rows


def time_images(timing: TimingJob, job: Job) -> list[TimingRow]:
    """The rows of pictures, in this process."""
    device = pick_device(job, 0)
    set_up_torch(job.model_copy(update={"threads": threads_of(timing)}), device)
    meter = Meter(device, timing.seconds)
    return inference_rows(timing, meter, peaks(meter))


def in_ranks(timing: TimingJob, job: Job) -> list[TimingRow]:
    """The rows of training steps, in the job's ranks on this machine."""
    from torch.distributed.elastic.multiprocessing.api import SignalException
    from torch.distributed.elastic.multiprocessing.errors import ChildFailedError

    if job.ranks == 1:
        return [TimingRow(**row) for row in time_steps(timing, Context(device=pick_device(job, 0)))]
    try:
        found = start_ranks(job, time_steps_as_rank, timing.model_dump(mode="json"))[0]
    except SignalException:
        raise KeyboardInterrupt from None
    except ChildFailedError as error:
        rank, failure = error.get_first_failure()
        raise CrossrayError(f"timing stopped: rank {rank} failed: {first_line(failure.message)}") from None
    return [TimingRow(**row) for row in found]


def time_steps_as_rank(mapping: dict[str, Any]) -> list[dict[str, Any]]:
    """Entry point of a rank that this machine's own launcher starts."""
    set_up_logging()
    timing = make_timing(mapping)
    return run_rank(method_job(timing, "crnerf"), lambda _, context: time_steps(timing, context))


def time_steps(timing: TimingJob, context: Context) -> list[dict[str, Any]]:
    """The rows of training steps as plain values, on a rank."""
    meter = Meter(context.device, timing.seconds)
    set_up_torch(method_job(timing, "crnerf"), context.device)
    rows = training_rows(timing, context, meter, peaks(meter))
    return [row.model_dump(mode="json") for row in rows]


def peaks(meter: Meter) -> Callable[[str], float]:
    """What the device reaches at best in a precision, measured when it is first asked for."""
    return cache(lambda precision: peak_flops(meter, precision))
