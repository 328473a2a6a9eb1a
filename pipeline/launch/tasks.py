"""Mappers: they run a stage's pure function over its specs, in this process or as Ray tasks; and the Ray on which they
and the ranks of a job run.

A mapper is called as `mapper(fn, specs)` and yields the results as they complete, in any order. `fn` is a
function of a module (Ray workers import it by name) of one spec that can be pickled. The first exception ends
the iteration and reaches the caller as it was raised.
"""

from __future__ import annotations

import os
import secrets
import shutil
import signal
import socket
import sys
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

from pipeline.errors import CrossrayError
from pipeline.launch.home import follow

Mapper = Callable[[Callable[[Any], Any], Iterable[Any]], Iterator[Any]]
Needs = Callable[[Any], dict[str, float]]  # of a spec: {"num_cpus": 2}, {"num_cpus": 0, "num_gpus": 0.25}

RETRIES = 3  # of a task whose process died; an exception is never retried
OBJECT_STORE_BYTES = 128 * 2**20  # specs and results are small
PRIVATE_RAY = {  # read when Ray is imported; what the user has set stays
    "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",  # without it, Ray listens on all interfaces whatever address it is given
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_worker_niceness": "0",  # a run trains as fast in a task as one that was started by hand
    "GLOO_SOCKET_IFNAME": "lo",
}


class TaskError(CrossrayError):
    """A task whose process died again and again."""


def in_process(fn: Callable[[Any], Any], specs: Iterable[Any]) -> Iterator[Any]:
    """The mapper without Ray: one spec after the other."""
    yield from map(fn, specs)


def one_cpu(spec: Any) -> dict[str, float]:
    """What a task of a stage takes."""
    return {"num_cpus": 1}


def one_gpu_if_any(spec: Any) -> dict[str, float]:
    """What a task takes that renders: a GPU where the connected cluster has one, else a CPU."""
    import ray

    return {"num_cpus": 1, "num_gpus": 1} if ray.cluster_resources().get("GPU", 0) >= 1 else {"num_cpus": 1}


@contextmanager
def ray_tasks(
    num_cpus: int | None = None,
    needs: Needs = one_cpu,
    died: Callable[[Any, TaskError], Any] | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> Iterator[Mapper]:
    """A mapper that runs each spec as a Ray task in this process's folder, restarted up to `RETRIES` times if its
    process dies.

    Args:
        num_cpus: of a private Ray, where there is no other (`ray_session`).
        needs: what a spec's task takes; no more CPUs are asked for than the largest node has.
        died: gives the result of a spec whose process died again and again; by default that is a TaskError,
            which ends the iteration.
        stop: asked every second; once it says so, the results end, and what is under way is cancelled.
    """
    with ray_session(num_cpus):
        yield partial(_map_tasks, needs=needs, died=died, stop=stop)


@contextmanager
def ray_session(num_cpus: int | None = None) -> Iterator[None]:
    """Ray, for as long as the block lasts.

    Uses the Ray to which this process is connected, else joins the cluster at `$RAY_ADDRESS`, else starts a
    private Ray with `num_cpus` (default: all) on loopback, which takes orders only from those who know its token, and
    shuts it down at the end. A cluster that was joined is only left.

    Raises:
        CrossrayError: nothing answers at `$RAY_ADDRESS`, or it refuses this process.
    """
    if "ray" in sys.modules and sys.modules["ray"].is_initialized():
        yield
    elif os.environ.get("RAY_ADDRESS"):
        with _joined(os.environ["RAY_ADDRESS"]):
            yield
    else:
        with _private_environment(), _private_ray(num_cpus):
            yield


@contextmanager
def _joined(address: str) -> Iterator[None]:
    """Connected to a cluster."""
    import ray

    try:
        _knock(address)
        _init_ray(address=address)
    except (OSError, ray.exceptions.AuthenticationError) as error:
        raise CrossrayError(
            f"RAY_ADDRESS: no Ray cluster at {address} takes this process in ({error}). Is it running? One that was "
            "started with a token needs RAY_AUTH_MODE=token, and the token in RAY_AUTH_TOKEN or in the file that "
            "RAY_AUTH_TOKEN_PATH names"
        ) from None
    try:
        yield
    finally:
        ray.shutdown()


def _knock(address: str) -> None:
    """OSError where nobody listens at host:port; Ray would ask for minutes."""
    host, _, port = address.rpartition(":")
    if port.isdigit() and "://" not in host:
        socket.create_connection((host.strip("[]"), int(port)), timeout=10).close()


@contextmanager
def _private_ray(num_cpus: int | None) -> Iterator[None]:
    """A Ray of this process alone; nothing of it is left."""
    import ray

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
        yield
    finally:
        ray.shutdown()
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _private_environment() -> Iterator[None]:
    """What a private Ray finds in the environment, with a new token: that is in no file, and gone with the block."""
    ours = {name: value for name, value in PRIVATE_RAY.items() if name not in os.environ}
    ours |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
    before = {name: os.environ[name] for name in ours if name in os.environ}
    os.environ.update(ours)
    _read_token_again()
    try:
        yield
    finally:
        for name in ours:
            del os.environ[name]
        os.environ.update(before)
        _read_token_again()


def _read_token_again() -> None:
    """Ray keeps the token, and whether there is one, from its first look at the environment.

    It has no public way to look again. Where the names have changed, a second private Ray of one process may find the
    token of the first, and say so.
    """
    with suppress(ImportError, AttributeError):
        from ray._raylet import AuthenticationTokenLoader, Config  # type: ignore[attr-defined]

        Config.initialize("")  # first: a thread of Ray's that still ends must not look for a token that has gone
        AuthenticationTokenLoader.instance().reset_cache()


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
    fn: Callable[[Any], Any],
    specs: Iterable[Any],
    needs: Needs,
    died: Callable[[Any, TaskError], Any] | None,
    stop: Callable[[], bool],
) -> Iterator[Any]:
    import ray

    name = getattr(fn, "__name__", str(fn))
    task = ray.remote(max_retries=RETRIES)(_run_in)
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    folder = Path.cwd()
    pending: dict[Any, Any] = {}
    try:
        for spec in specs:
            pending[task.options(name=name, **_fitting(needs(spec), nodes)).remote(folder, fn, spec)] = spec
        while pending and not stop():
            done, _ = ray.wait(list(pending), num_returns=1, timeout=1)
            if not done:
                continue
            spec = pending.pop(done[0])
            try:
                result = ray.get(done[0])
            except ray.exceptions.RayTaskError as error:
                raise (error.cause or error) from None
            except (ray.exceptions.WorkerCrashedError, ray.exceptions.OutOfMemoryError) as error:
                lost = TaskError(
                    f"{name}: the process of a task died {RETRIES + 1} times; it may be out of "
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


def _run_in(folder: Path, fn: Callable[[Any], Any], spec: Any) -> Any:
    """What a task does: `fn(spec)` in the driver's folder, from which relative paths are meant."""
    follow(folder)
    return fn(spec)


def _fitting(needs: dict[str, float], nodes: list[dict[str, float]]) -> dict[str, float]:
    """`needs` with no more CPUs than the largest node has: a task that asks for more would wait for ever.

    Raises:
        TaskError: no node has as many GPUs.
    """
    cpus, gpus = (max(node.get(kind, 0) for node in nodes) for kind in ("CPU", "GPU"))
    if needs.get("num_gpus", 0) > gpus:
        raise TaskError(f"a task needs {needs['num_gpus']:g} GPUs, and Ray's largest node has {gpus:g}")
    return needs | {"num_cpus": min(needs["num_cpus"], cpus)}
