"""Runs a re-evaluation: one pass, or pass after pass until it is asked to stop; in this process or as Ray tasks.

Each pass is the same idempotent one, whoever makes it: a job that stays and passes on a clock, or a CronJob that starts
one and ends. The driver of a training evaluates each checkpoint beside it by the same means.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any

from pipeline.config import Job
from pipeline.errors import CrossrayError
from pipeline.evaluate import Mapper
from pipeline.launch.tasks import TaskError, in_process, ray_session, ray_tasks
from pipeline.reeval import ReevalJob, Summary, evaluate_all, find_runs, interval, look, lost, one_pass

log = logging.getLogger("crossray")

POLL = 3.0  # seconds between two looks for a new checkpoint


def run_reeval(reeval: ReevalJob) -> Summary | None:
    """Make one pass and return what it did; with `every`, pass until SIGTERM or Ctrl-C and return None.

    Raises:
        CrossrayError: there is no such run, or no such cluster.
        KeyboardInterrupt: asked to stop in the middle of a single pass; nothing is half-written.
    """
    if "RANK" in os.environ:
        raise CrossrayError("a re-evaluation starts its tasks itself; start it without torchrun")
    find_runs(reeval)
    seconds = interval(reeval)
    if seconds is None:
        with tasks_for(reeval) as mapper:
            return one_pass(reeval, mapper)
    try:
        with tasks_for(reeval) as mapper:
            keep_passing(reeval, mapper, seconds)
    except KeyboardInterrupt:
        log.info("stopped; nothing is half-written, and the next start goes on")
    return None


def keep_passing(reeval: ReevalJob, mapper: Mapper, seconds: float) -> None:
    """Pass after pass, `seconds` from start to start; one that takes longer is followed by the next at once. An error
    ends a pass, not the schedule. What is skipped for the same reason again is said once."""
    said: set[str] = set()
    while True:
        began = time.monotonic()
        try:
            summary = one_pass(reeval, mapper)
            for line in summary.skipped:
                if line not in said:
                    log.info("skipped: %s", line)
            said.update(summary.skipped)
            for line in summary.failed:
                log.warning("failed: %s", line)
            log.info("%s; the next pass comes %s after the start of this one", summary, reeval.every)
        except Exception as error:  # a network's disk that was away, for example
            log.error("this pass failed (%s); the next one comes", error)
        time.sleep(max(0.0, began + seconds - time.monotonic()))


def tasks_for(reeval: ReevalJob) -> AbstractContextManager[Mapper]:
    """Who evaluates."""
    if reeval.launcher == "ray" or (reeval.launcher == "auto" and os.environ.get("RAY_ADDRESS")):
        return evaluation_tasks(reeval.gpus, lost)
    return nullcontext(in_process)


@contextmanager
def evaluation_tasks(
    gpus: float | None = None,
    died: Callable[[Any, TaskError], Any] | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> Iterator[Mapper]:
    """A mapper that evaluates views as Ray tasks.

    Args:
        gpus: share of a GPU that a task takes, instead of what the job of its run says.
        died, stop: as in `ray_tasks`.
    """
    with ray_session():
        import ray

        def needs(task: Any) -> dict[str, float]:
            return needs_of_evaluation(task.job, gpus, ray.cluster_resources().get("GPU", 0))

        with ray_tasks(needs=needs, died=died, stop=stop) as mapper:
            yield mapper


def needs_of_evaluation(job: Job, gpus: float | None, there: float) -> dict[str, float]:
    """What Ray is asked for: a share of a GPU for a job that uses them, if the cluster has any (`there`), else the
    job's threads."""
    if job.device != "cpu" and there > 0:
        return {"num_cpus": 0, "num_gpus": gpus or job.evaluate.gpus}
    return {"num_cpus": job.threads}


class EachCheckpoint(threading.Thread):
    """Evaluates the checkpoints of a run while it is trained, by Ray tasks on what the ranks leave free.

    Its failures only warn: training goes on.
    """

    def __init__(self, job: Job) -> None:
        super().__init__(name="evaluate", daemon=True)
        self.job = job
        self.ended = threading.Event()
        self.tried: set[str] = set()  # names of checkpoints: one that fails is left to a later pass

    def run(self) -> None:
        """See the class."""
        try:
            with evaluation_tasks(died=lost, stop=self.ended.is_set) as mapper:
                while not self.ended.wait(POLL):
                    self.evaluate_new(mapper)
        except Exception as error:
            log.warning("%s: its checkpoints are not evaluated any more (%s)", self.job.run, error)

    def evaluate_new(self, mapper: Mapper) -> None:
        """Evaluate what was committed since the last look."""
        summary = Summary()
        for lacking in look(self.job.run, self.job.evaluate.protocols, summary):
            if lacking.target.name not in self.tried and not self.ended.is_set():
                self.tried.add(lacking.target.name)
                evaluate_all([lacking], mapper, summary)
        for line in summary.failed:
            log.warning("not evaluated: %s", line)

    def stop(self, patience: float = 15.0) -> None:
        """Begin nothing more, cancel what is under way, and wait for that."""
        self.ended.set()
        self.join(patience)


def evaluate_rest(job: Job) -> None:
    """Evaluate the checkpoints for which the ranks have left nothing free, once they are gone."""
    summary = Summary()
    with evaluation_tasks(died=lost) as mapper:
        evaluate_all(look(job.run, job.evaluate.protocols, summary), mapper, summary)
    for line in summary.failed:
        log.warning("not evaluated: %s", line)


@contextmanager
def each_checkpoint(job: Job) -> Iterator[None]:
    """Evaluate the job's checkpoints while the block trains; inside `ray_session`."""
    evaluations = EachCheckpoint(job)
    evaluations.start()
    try:
        yield
    finally:
        evaluations.stop()
