"""Ray Train starts the ranks on a cluster, and starts them again where one of them, or its node, is lost.

Our committed checkpoints are the only state: whatever Ray Train remembers of a start is in a folder of that start's own
and goes with it.

    <run>/ray/<start>/stop       empty; whoever writes to it asks the ranks to stop
                      running    empty unless the ranks run
                      *.log      what the ranks, and Ray Train's controller, have to say; the driver passes it on

All of these files are there from the start, and only their content changes: whether a file exists, a network's disk may
remember for half a minute; what is in it, it looks up whenever the file is opened.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
import socket
import threading
import time
import uuid
from collections.abc import Callable
from concurrent.futures import Future, wait
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from pipeline.checkpoint import META, committed
from pipeline.config import Job
from pipeline.errors import CrossrayError
from pipeline.launch.home import follow
from pipeline.launch.room import Wanted, alive_nodes, check_room, places, wanted
from pipeline.launch.stop import StopFile, StopRequest, stopped_by_signals
from pipeline.launch.tasks import ray_session
from pipeline.photos import open_photos
from pipeline.resume import checkpoints
from pipeline.train import train
from pipeline.work import Context

log = logging.getLogger("crossray")

POLL = 0.2  # seconds between two looks at what the ranks say
PATIENCE = 60.0  # seconds without ranks after which the user hears why, and then again


class Metric(NamedTuple):
    """A number that Ray's metrics endpoints show to Prometheus."""

    key: str
    """Under which training gives it."""
    unit: str
    meaning: str


METRICS = {  # Ray puts `ray_` before each name; all have the tags run, method and scene
    "crossray_step": Metric("step", "steps", "Training steps that are done."),
    "crossray_step_seconds": Metric("step_seconds", "seconds", "Time of one training step, lately."),
    "crossray_rays_per_second": Metric("rays_per_second", "rays/second", "Rays that all ranks together train on."),
    "crossray_loss": Metric("loss", "1", "Sum of all loss terms of rank 0 in the last step."),
    "crossray_checkpoint_seconds": Metric(
        "checkpoint_seconds", "seconds", "Time that the ranks waited for the last checkpoint."
    ),
}


@dataclass(frozen=True)
class Start:
    """One start of a job's ranks, as the driver and they know it."""

    job: Job
    home: Path
    """Where the job's relative paths are meant from."""
    folder: Path
    """Of this start; absolute."""

    @property
    def stop(self) -> Path:
        """The file by which the ranks are asked to stop."""
        return self.folder / "stop"

    @property
    def running(self) -> Path:
        """The file that tells whether the ranks run."""
        return self.folder / "running"

    def log_of(self, who: int | str) -> Path:
        """The file of what a rank or the controller says."""
        return self.folder / f"{who}.log"

    @property
    def logs(self) -> list[Path]:
        """All of these."""
        return [self.log_of(who) for who in (*range(self.job.ranks), "controller")]

    def make(self) -> None:
        """Make the folder and its files."""
        self.folder.mkdir(parents=True)
        for path in (self.stop, self.running, *self.logs):
            path.touch()

    def remove(self) -> None:
        """Remove it, and the folder of all starts if no other is left."""
        shutil.rmtree(self.folder, ignore_errors=True)
        with suppress(OSError):
            self.folder.parent.rmdir()

    def remove_earlier(self) -> None:
        """Remove what drivers that were killed have left. Only for a start that has trained: nobody else did then."""
        for folder in self.folder.parent.iterdir():
            if folder.name < self.folder.name:
                shutil.rmtree(folder, ignore_errors=True)


def new_start(job: Job) -> Start:
    """A start of its own; names are in the order of time."""
    name = f"{time.strftime('%Y%m%d-%H%M%S', time.gmtime())}-{uuid.uuid4().hex[:8]}"
    return Start(job, Path.cwd(), (job.run / "ray" / name).absolute())


def run_ray(job: Job) -> dict[str, Any]:
    """Train with the job's ranks on the Ray that there is (`ray_session`); returns rank 0's result.

    Raises:
        CrossrayError: the cluster cannot hold the ranks, or one of them failed.
    """
    with ray_session():
        need = check_cluster(job)
        open_photos(job.shards)  # damaged shards are found once, here, and not by every rank
        start = new_start(with_device(job, need))
        start.make()
        log.info("Ray starts %s", need)
        try:
            with stopped_by_signals(start.stop) as stop:
                result = attend(start, need, stop, start_ranks(start, need))
            start.remove_earlier()
        finally:
            start.remove()
        return result


def check_cluster(job: Job) -> Wanted:
    """What the job's ranks take of the Ray that there is.

    Raises:
        CrossrayError: it has no room for them, however long they wait.
    """
    nodes = alive_nodes()
    need = wanted(job, nodes)
    check_room(need, nodes)
    return need


def with_device(job: Job, need: Wanted) -> Job:
    """The job with its device settled: what one node has must not decide for the others."""
    return job.model_copy(update={"device": "cuda" if need.gpus else "cpu"})


# --------------------------------------------------------------------------------------------------- in the driver


def start_ranks(start: Start, need: Wanted) -> Future[dict[str, Any]]:
    """Have Ray Train start the ranks.

    It waits for them in a thread, so that this process's signals stay ours: in the main thread it would take Ctrl-C for
    itself, and end the ranks before they have saved.
    """
    from ray.train import FailureConfig, RunConfig, ScalingConfig
    from ray.train.torch import TorchTrainer

    # Its watcher for nodes that are about to go would be one more process to wait for, and our ranks do not ask it.
    os.environ.setdefault("RAY_TRAIN_ENABLE_PREEMPTION_WATCHER", "0")
    job = start.job
    trainer = TorchTrainer(
        train_rank,
        train_loop_config={"start": start},
        scaling_config=ScalingConfig(
            num_workers=need.ranks,
            use_gpu=need.gpus > 0,
            resources_per_worker=need.bundle,
            placement_strategy=need.placement,
        ),
        run_config=RunConfig(
            name=start.folder.name,
            storage_path=str(start.folder.parent),
            failure_config=FailureConfig(max_failures=job.ray.max_failures),
            callbacks=[failure_callback(start)],
            worker_runtime_env={"env_vars": environment(job)},
        ),
    )
    future: Future[dict[str, Any]] = Future()

    def fit() -> None:
        try:
            future.set_result(trainer.fit().return_value)
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=fit, daemon=True, name="ray-train").start()
    return future


def environment(job: Job) -> dict[str, str]:
    """Of a rank: what has to be there before torch is imported. A rank that waits for another one must not spin on the
    core that the other needs."""
    ours = {"OMP_NUM_THREADS": str(job.threads), "OMP_WAIT_POLICY": "PASSIVE"}
    return ours | ({"CUBLAS_WORKSPACE_CONFIG": ":4096:8"} if job.train.deterministic else {})


def attend(start: Start, need: Wanted, stop: StopFile, future: Future[dict[str, Any]]) -> dict[str, Any]:
    """Wait for the ranks and pass on what they say; without ranks a stop has nothing to wait for."""
    said = Said(start.logs)
    quiet_since = time.monotonic()
    while not future.done():
        wait([future], timeout=POLL)
        said.pass_on()
        if start.running.read_bytes():
            quiet_since = time.monotonic()
        elif stop() and not future.done():
            return stopped_before(start.job)
        elif time.monotonic() - quiet_since > PATIENCE:
            quiet_since = time.monotonic()
            log.warning("%s", why_waiting(need))
    said.pass_on()
    error = future.exception()
    if error is not None:
        raise explained(error, start.job) from None
    return future.result()


class Said:
    """The lines that ranks and controller write to their files, each passed on once."""

    def __init__(self, paths: list[Path]) -> None:
        self.read = dict.fromkeys(paths, 0)

    def pass_on(self) -> None:
        """Log what is new."""
        for path, start in self.read.items():
            with path.open("rb") as file:
                file.seek(start)
                new, newline, _ = file.read().rpartition(b"\n")
            self.read[path] = start + len(new) + len(newline)
            for line in new.decode(errors="replace").splitlines():
                log.info("%s", line)


def why_waiting(need: Wanted) -> str:
    """Why there are no ranks."""
    import ray

    fit = places(alive_nodes(), need)
    if fit < need.ranks:
        return f"waiting for a node: of {need}, the cluster has places for {fit} now"
    free = ray.available_resources()
    return (
        f"waiting for {need}: {free.get('CPU', 0):g} CPUs and {free.get('GPU', 0):g} GPUs of the cluster are free; "
        "`ray status` shows who has the others"
    )


def stopped_before(job: Job) -> dict[str, Any]:
    """The result of a start that was stopped while no rank ran."""
    newest = committed(checkpoints(job))
    meta = json.loads((newest[-1] / META).read_text()) if newest else {"step": 0, "seconds": 0.0}
    return {"steps": meta["step"], "train_seconds": meta["seconds"], "ranks": job.ranks, "finished": False}


def explained(error: BaseException, job: Job) -> BaseException:
    """An error of Ray Train as one message."""
    from ray.exceptions import RayActorError
    from ray.train import ControllerError, TrainingFailedError, WorkerGroupError

    if isinstance(error, ControllerError) and isinstance(error.controller_failure, CrossrayError):
        return error.controller_failure
    again = "run the same command again to go on from the last checkpoint"
    if isinstance(error, WorkerGroupError):
        reason = what_failed(error.worker_failures)
        return CrossrayError(f"training stopped: {reason} (ray.max_failures: {job.ray.max_failures}); {again}")
    if isinstance(error, RayActorError):
        return CrossrayError(f"training stopped: Ray Train's controller died with its node or was killed; {again}")
    if isinstance(error, TrainingFailedError):
        return CrossrayError(f"training stopped: {first_words(error)}; {again}")
    return error


# ----------------------------------------------------------------------------------------------- in the controller


def failure_callback(start: Start) -> Any:
    """What Ray Train's controller does when ranks fail: an error that the user has to put right ends the training at
    once, for a second try would meet it again; all else is noted, and Ray Train starts the ranks anew."""
    from ray.train import UserCallback

    class OnFailure(UserCallback):
        failures = 0

        def after_exception(self, run_context: Any, worker_exceptions: dict[int, Exception]) -> None:
            ours = [error for error in worker_exceptions.values() if isinstance(error, CrossrayError)]
            if ours:
                raise ours[0]
            self.failures += 1
            start.running.write_text("")
            limit = start.job.ray.max_failures
            if limit == -1 or self.failures <= limit:
                of = "" if limit == -1 else f" of {limit}"
                with start.log_of("controller").open("a") as file:
                    file.write(f"{what_failed(worker_exceptions)}; the ranks start again ({self.failures}{of})\n")

    return OnFailure()


def what_failed(failures: dict[int, Exception]) -> str:
    """The first cause: where a process has died, what the others say of it matters less."""
    from ray.exceptions import RayActorError

    def died(error: Exception) -> bool:
        return isinstance(getattr(error, "health_check_failure", error), RayActorError)

    rank, error = min(failures.items(), key=lambda item: (not died(item[1]), item[0]))
    if died(error):
        return f"rank {rank} is lost: its process was killed, ran out of memory, or went with its node"
    return f"rank {rank} failed: {type(error).__name__}: {first_words(error)}"


def first_words(error: BaseException) -> str:
    """The first line with words of an error's message."""
    return next((line.strip() for line in str(error).splitlines() if line.strip()), "no message")


# ------------------------------------------------------------------------------------------------------ in a rank


def train_rank(config: dict[str, Any]) -> dict[str, Any]:
    """What Ray Train runs in each rank's process; the process group is there."""
    import ray.train

    start: Start = config["start"]
    follow(start.home)
    session = ray.train.get_context()
    rank = session.get_world_rank()
    speak_to(start.log_of(rank), logging.INFO if rank == 0 else logging.WARNING)
    if rank == 0:
        start.running.write_text("running\n")
    context = Context(
        rank=rank,
        world_size=session.get_world_size(),
        device=own_device(start.job),
        should_stop=StopRequest(start.stop),
        watch=gauges(start.job) if rank == 0 else lambda numbers: None,
        report=ray.train.report,
    )
    return train(start.job, context)


def own_device(job: Job) -> Any:
    """The rank's device.

    Raises:
        CrossrayError: Ray counts a GPU where torch sees none.
    """
    import torch
    from ray.train.torch import get_device

    if job.device == "cpu":
        return torch.device("cpu")
    if not torch.cuda.is_available():
        raise CrossrayError(
            f"node {socket.gethostname()}: Ray counts GPUs there, but torch sees none; install a torch with CUDA, or "
            "--set device=cpu"
        )
    return get_device()


def speak_to(path: Path, level: int) -> None:
    """The project's log goes to a file, one line a message, from where the driver passes it on."""
    handler = logging.FileHandler(path)
    handler.setFormatter(logging.Formatter("%(message)s"))
    log.handlers[:] = [handler]
    log.setLevel(level)
    log.propagate = False


def gauges(job: Job) -> Callable[[dict[str, float]], None]:
    """Shows the numbers of training to Prometheus."""
    from ray.util.metrics import Gauge

    tags = {"run": job.name, "method": job.method, "scene": job.scene.path.name}
    shown = {
        metric.key: Gauge(name, f"{metric.meaning} Unit: {metric.unit}.", tuple(tags))
        for name, metric in METRICS.items()
    }
    for gauge in shown.values():
        gauge.set_default_tags(tags)

    def watch(numbers: dict[str, float]) -> None:
        for key, gauge in shown.items():
            gauge.set(numbers[key])

    return watch
