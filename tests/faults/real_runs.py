"""Runs as real processes, on loopback, in sessions of their own; what breaks in them is in sabotage.py."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from tiny_run import tiny_job

from pipeline.compare import compare_runs
from pipeline.config import Job, save_job

ROOT = Path(__file__).resolve().parents[2]
SABOTAGE = Path(__file__).with_name("sabotage.py")
PATIENCE = 120.0  # seconds until a test gives a process up
STEPS, EVERY = 40, 10  # steps of a run, steps between its checkpoints


def small_job(cut: Path, name: str, ranks: int = 2, **over: Any) -> Job:
    """A run of a second or two; `over` are keys of `train`."""
    train = {"epochs": 2, "steps_per_epoch": STEPS // 2, "checkpoint_every": EVERY} | over
    return tiny_job(cut, "crossray", {"name": name, "ranks": ranks, "patch": {"size": 4}, "train": train})


STARTED: list[Running] = []  # by the test that is going on, for its clean-up


class Running:
    """A process and all that it has started.

    Args:
        launcher: `local`, or `torchrun`, whose ranks are started again `restarts` times.
        faults: see sabotage.py.
    """

    def __init__(
        self, job: Job, folder: Path, launcher: str = "local", faults: list[list] | None = None, restarts: int = 0
    ) -> None:
        job_file, self.output = folder / f"{job.name}.yaml", folder / f"{job.name}.log"
        save_job(job, job_file)
        words = [sys.executable]
        if launcher == "torchrun":
            words += ["-m", "torch.distributed.run", "--standalone", "--local-addr=127.0.0.1", "--monitor-interval=0.1"]
            words += [f"--nproc-per-node={job.ranks}", f"--max-restarts={restarts}"]
        words += [str(SABOTAGE), "run", str(job_file), "--launcher", launcher]
        environment = os.environ | {
            "CROSSRAY_SABOTAGE": json.dumps(faults or []),
            "CROSSRAY_CACHE": str(folder / "cache"),
            "PYTHONPATH": f"{ROOT}",
            "GLOO_SOCKET_IFNAME": "lo",
            "OMP_NUM_THREADS": "1",
            "COLUMNS": "500",
            "TORCH_DISABLE_SHARE_RDZV_TCP_STORE": "1" if restarts else "0",
        }
        for name in ("RANK", "RAY_ADDRESS"):
            environment.pop(name, None)
        with self.output.open("ab") as output:
            self.process = subprocess.Popen(
                words, cwd=ROOT, env=environment, stdout=output, stderr=subprocess.STDOUT, start_new_session=True
            )

        STARTED.append(self)

    def until(self, there: Callable[[], object]) -> None:
        """Wait until `there()` is true; the process has to live that long."""
        deadline = time.monotonic() + PATIENCE
        while not there():
            assert self.process.poll() is None, f"ended too early:\n{self.text()}"
            assert time.monotonic() < deadline, f"waited in vain:\n{self.text()}"
            time.sleep(0.02)

    def end(self) -> tuple[int, str]:
        """Wait for the end; exit status and output. Nothing of the session is left behind."""
        try:
            status = self.process.wait(PATIENCE)
        finally:
            self.kill_all()
        return status, self.text()

    def kill_all(self) -> None:
        """kill -9 whatever is left of the session."""
        with suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()

    def text(self) -> str:
        """Everything printed so far, in single-spaced words (the log wraps its lines)."""
        return " ".join(self.output.read_text().split())


def kill_everything() -> None:
    """Nothing that a test has started outlives it, however it ended."""
    while STARTED:
        STARTED.pop().kill_all()


def finish(job: Job, folder: Path, launcher: str = "local", **options: Any) -> str:
    """Run to the end; returns the output."""
    status, text = Running(job, folder, launcher, **options).end()
    assert status == 0, text
    return text


def assert_same_run(job: Job, other: Job) -> None:
    """Every step's losses on every rank, and all checkpoints of the same steps, to the bit."""
    found = compare_runs(job.run, other.run)
    assert found.same, "\n".join(f.text for f in found.findings if not f.same)
    assert len(found.findings) > job.ranks  # checkpoints were compared, too
