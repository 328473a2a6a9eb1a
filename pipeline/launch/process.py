"""One training run as a process of its own, for the tasks of a study.

A task holds the CPUs or GPUs of its run and does nothing but wait for the process, so this file imports no torch.
"""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

POLL = 0.2  # seconds between two looks at a process


class Spec(NamedTuple):
    """What a task has to know of its run; all paths are absolute."""

    name: str
    run: Path
    shards: Path
    folder: Path  # the working directory, from which the job's relative paths are meant
    stop: Path  # a file that appears when the study is asked to stop
    threads: int
    cpus: int
    gpus: int


class Outcome(NamedTuple):
    """How a run's process ended; `how` is None for a run that was asked to stop."""

    name: str
    how: str | None


def run_one(spec: Spec) -> Outcome:
    """Run one training job as a process of its own, and wait for it."""
    log_file = spec.run / "log.txt"
    try:
        with alone(spec) as lock, log_file.open("ab") as output:
            if lock is None or spec.stop.exists():
                return Outcome(spec.name, None)
            if not (spec.shards / "manifest.json").is_file():  # the process would start a Ray of its own to cut them
                return Outcome(spec.name, f"the shards in {spec.shards} are gone")
            start = output.tell()
            process = subprocess.Popen(
                command(spec),
                cwd=spec.folder,
                env=environment(spec.threads),
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # a terminal's Ctrl-C is not meant for it
                pass_fds=[lock],
            )
            stopped = wait_for(process, spec.stop)
            return Outcome(
                spec.name, None if stopped else f"{ending(process.returncode)}: {last_line(log_file, start)}"
            )
    except OSError as error:
        return Outcome(spec.name, str(error))


def command(spec: Spec) -> list[str]:
    """What runs the run."""
    return [sys.executable, "-m", "pipeline", "run", str(spec.run / "job.yaml")]


@contextmanager
def alone(spec: Spec) -> Iterator[int | None]:
    """Wait until nobody else runs this run; gives the descriptor of the lock, None if the study is asked to stop first.

    The process inherits the lock. So it is held by whoever trains, also when the task has died over it and is tried
    again, or another study has started the same run.
    """
    with (spec.run / ".running.lock").open("a") as file:
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if spec.stop.exists():
                    yield None
                    return
                time.sleep(POLL)
        yield file.fileno()


def environment(threads: int) -> dict[str, str]:
    """Of the process: this one's, without what Ray sets for its own workers. The GPUs that Ray has chosen stay."""
    strange = ("PYTHONBREAKPOINT", "RANK", "LOCAL_RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")
    ours = {k: v for k, v in os.environ.items() if not k.startswith("RAY_") and k not in strange}
    return ours | {"OMP_NUM_THREADS": str(threads), "OMP_WAIT_POLICY": "PASSIVE", "COLUMNS": "200"}


def wait_for(process: subprocess.Popen, stop: Path) -> bool:
    """Wait for a process; once the file `stop` is there, it gets a SIGTERM and all the time it needs to save.

    Returns:
        Whether it was asked to stop.
    """
    while process.poll() is None:
        if stop.exists():
            process.terminate()
            process.wait()
            return True
        time.sleep(POLL)
    return False


def ending(status: int) -> str:
    """A process's exit status in words."""
    return f"ended by {signal.Signals(-status).name}" if status < 0 else f"exit status {status}"


def last_line(path: Path, start: int) -> str:
    """The last line with words in it, from byte `start` on."""
    with path.open("rb") as file:
        file.seek(start)
        lines = file.read().decode(errors="replace").splitlines()
    return next((line.strip() for line in reversed(lines) if line.strip()), "it printed nothing")
