"""Mappers: they run a stage's pure function over its specs, in this process or as Ray tasks.

A mapper is called as `mapper(fn, specs)` and yields the results as they complete, in any order. `fn` is a
function of a module (Ray workers import it by name) of one spec that can be pickled. The first exception ends
the iteration and reaches the caller as it was raised.
"""

from __future__ import annotations

import os
import shutil
import signal
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

from pipeline.errors import CrossrayError

Mapper = Callable[[Callable[[Any], Any], Iterable[Any]], Iterator[Any]]
Needs = Callable[[Any], dict[str, int]]  # of a spec: {"num_cpus": 2}, {"num_cpus": 0, "num_gpus": 1}

RETRIES = 3  # of a task whose process died; an exception is never retried
OBJECT_STORE_BYTES = 128 * 2**20  # specs and results are small
# Infrastructure notes, 1.5: without the first, Ray listens on all interfaces whatever address it is given.
PRIVATE_RAY = {
    "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_AUTH_MODE": "disabled",  # loopback only, and no token file in the user's home
    "RAY_worker_niceness": "0",  # a run trains as fast in a task as one that was started by hand
}


class TaskError(CrossrayError):
    """A task whose process died again and again."""


def in_process(fn: Callable[[Any], Any], specs: Iterable[Any]) -> Iterator[Any]:
    """The mapper without Ray: one spec after the other."""
    yield from map(fn, specs)


def one_cpu(spec: Any) -> dict[str, int]:
    """What a task of a stage takes."""
    return {"num_cpus": 1}


@contextmanager
def ray_tasks(
    num_cpus: int | None = None, needs: Needs = one_cpu, died: Callable[[Any, TaskError], Any] | None = None
) -> Iterator[Mapper]:
    """A mapper that runs each spec as a Ray task, restarted up to `RETRIES` times if its process dies.

    Uses the Ray to which this process is connected, else joins the cluster at `$RAY_ADDRESS`, else starts a
    private Ray with `num_cpus` (default: all) on loopback and shuts it down at the end. A cluster that was
    joined is only left.

    Args:
        needs: what a spec's task takes; no more CPUs are asked for than the largest node has.
        died: gives the result of a spec whose process died again and again; by default that is a TaskError,
            which ends the iteration.
    """
    mapper = partial(_map_tasks, needs=needs, died=died)
    address = os.environ.get("RAY_ADDRESS")
    if not address:
        for name, value in PRIVATE_RAY.items():
            os.environ.setdefault(name, value)  # read when Ray is imported
    import ray

    if ray.is_initialized():
        yield mapper
        return
    if address:
        _init_ray(address=address)
        try:
            yield mapper
        finally:
            ray.shutdown()
        return
    # Short, for the paths of Ray's sockets must stay under 108 characters.
    folder = tempfile.mkdtemp(prefix="crossray-", dir="/tmp")
    try:
        _init_ray(
            num_cpus=num_cpus,
            include_dashboard=False,
            object_store_memory=OBJECT_STORE_BYTES,
            _node_ip_address="127.0.0.1",
            _temp_dir=folder,
        )
        yield mapper
    finally:
        ray.shutdown()
        shutil.rmtree(folder, ignore_errors=True)


def _init_ray(**options: Any) -> None:
    """`ray.init`, quiet, with this process's own SIGTERM handler back in place afterwards."""
    import ray

    handler = signal.getsignal(signal.SIGTERM)
    try:
        ray.init(log_to_driver=False, logging_level="ERROR", **options)
    finally:
        if threading.current_thread() is threading.main_thread() and handler is not None:
            signal.signal(signal.SIGTERM, handler)


def _map_tasks(
    fn: Callable[[Any], Any], specs: Iterable[Any], needs: Needs, died: Callable[[Any, TaskError], Any] | None
) -> Iterator[Any]:
    import ray

    task = ray.remote(max_retries=RETRIES)(fn)
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    pending = {task.options(**_fitting(needs(spec), nodes)).remote(spec): spec for spec in specs}
    try:
        while pending:
            done, _ = ray.wait(list(pending), num_returns=1)
            spec = pending.pop(done[0])
            try:
                result = ray.get(done[0])
            except ray.exceptions.RayTaskError as error:
                raise (error.cause or error) from None
            except (ray.exceptions.WorkerCrashedError, ray.exceptions.OutOfMemoryError) as error:
                lost = TaskError(
                    f"{fn.__name__}: the process of a task died {RETRIES + 1} times; it may be out of "
                    "memory: give Ray fewer CPUs, so that fewer tasks run at once"
                )
                if died is None:
                    raise lost from error
                result = died(spec, lost)
            yield result
    finally:
        for reference in pending:
            ray.cancel(reference)
        if pending:  # shutting Ray down under a task that is being cancelled can crash this process
            ray.wait(list(pending), num_returns=len(pending), timeout=10)


def _fitting(needs: dict[str, int], nodes: list[dict[str, float]]) -> dict[str, int]:
    """`needs` with no more CPUs than the largest node has: a task that asks for more would wait for ever.

    Raises:
        TaskError: no node has as many GPUs.
    """
    cpus, gpus = (int(max(node.get(kind, 0) for node in nodes)) for kind in ("CPU", "GPU"))
    if needs.get("num_gpus", 0) > gpus:
        raise TaskError(f"a task needs {needs['num_gpus']} GPUs, and Ray's largest node has {gpus}")
    return needs | {"num_cpus": min(needs["num_cpus"], cpus)}
