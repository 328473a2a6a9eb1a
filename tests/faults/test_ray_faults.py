"""Ray's ranks and its driver are killed or asked to stop, and the run ends in the bits of an undisturbed one."""

from __future__ import annotations

import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest
from tiny_run import assert_same_bits, cut_tiny, final_state, tiny_job

from pipeline.checkpoint import committed, read_checkpoint
from pipeline.config import Job, save_job
from pipeline.heartbeat import rank_path, read_beat
from pipeline.launch.local import run_local
from pipeline.launch.run import claim_run
from pipeline.record import read_losses
from pipeline.resume import checkpoints

ROOT = Path(__file__).resolve().parents[2]
STEPS = 200
EVERY = 20  # steps between checkpoints
PATIENCE = 200.0  # seconds until a test gives up


@pytest.fixture(scope="module")
def cut(tmp_path_factory):
    return cut_tiny(tmp_path_factory.mktemp("ray_faults"))


@pytest.fixture(autouse=True)
def _environment(cut, monkeypatch):
    values = {"CROSSRAY_CACHE": str(cut / "cache"), "RAY_TRAIN_HEALTH_CHECK_INTERVAL_S": "0.2", "COLUMNS": "300"}
    for name, value in values.items():
        monkeypatch.setenv(name, value)
    for name in ("RANK", "RAY_ADDRESS", "CROSSRAY_HOME"):
        monkeypatch.delenv(name, raising=False)


def two_ranks(cut: Path, name: str) -> Job:
    train = {"epochs": 2, "steps_per_epoch": STEPS // 2, "checkpoint_every": EVERY}
    return tiny_job(cut, "crossray", {"name": name, "ranks": 2, "patch": {"size": 4}, "train": train})


@pytest.fixture(scope="module")
def straight(cut):
    """The undisturbed run, by the local launcher."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CROSSRAY_CACHE", str(cut / "cache"))
        job = two_ranks(cut, "straight")
        claim_run(job)
        run_local(job)
    return job


class Driver:
    """`crossray run --launcher ray` in a session of its own; nothing of it is left behind."""

    def __init__(self, job: Job, folder: Path) -> None:
        self.job, self.path = job, folder / f"output-{len(list(folder.iterdir()))}"
        save_job(job, folder / "job.yaml")
        command = [sys.executable, "-m", "pipeline", "run", str(folder / "job.yaml"), "--launcher", "ray"]
        with self.path.open("wb") as output:
            self.process = subprocess.Popen(
                command, cwd=ROOT, stdout=output, stderr=subprocess.STDOUT, start_new_session=True
            )

    def __enter__(self) -> Driver:
        return self

    def __exit__(self, *exception: object) -> None:
        if self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()

    @property
    def output(self) -> str:
        return self.path.read_text()

    @property
    def ray_folder(self) -> Path:
        """Of its private Ray, from the command lines of Ray's processes."""
        words = " ".join(word for child in psutil.Process(self.process.pid).children() for word in child.cmdline())
        found = re.search(r"/tmp/crossray-[^/ ]+", words)
        assert found, words
        return Path(found.group())

    def until(self, condition: Callable[[], object], what: str) -> None:
        """Wait while the driver runs."""
        deadline = time.monotonic() + PATIENCE
        while not condition():
            assert self.process.poll() is None, f"the driver ended before {what}: {self.output}"
            assert time.monotonic() < deadline, f"waited too long for {what}: {self.output}"
            time.sleep(0.02)

    def until_step(self, step: int) -> None:
        """Wait for the checkpoint of a step, or a later one."""
        self.until(lambda: any(p.name >= f"step-{step:08d}" for p in committed(checkpoints(self.job))), f"step {step}")

    def ends(self) -> str:
        """Its output, once it has ended with status 0."""
        assert self.process.wait(PATIENCE) == 0, self.output
        assert "Traceback" not in self.output
        return self.output


def assert_same_run(job: Job, other: Job) -> None:
    """Final weights, the optimiser's state and the losses of every step on every rank."""
    for ours, theirs, what in zip(final_state(job), final_state(other), ("model", "optimiser"), strict=True):
        assert_same_bits(dict(ours), dict(theirs), what)
    ours, theirs = read_losses(job.run), read_losses(other.run)
    assert ours.keys() == theirs.keys()
    for rank, losses in ours.items():
        assert losses.names == theirs[rank].names
        assert len(losses.rows) == STEPS
        assert losses.rows.tobytes() == theirs[rank].rows.tobytes(), f"losses of rank {rank} differ"


@pytest.mark.cluster
def test_a_killed_rank_is_started_again_and_nothing_is_lost(cut, straight, tmp_path):
    job, draw = two_ranks(cut, "killed-rank"), random.Random(4)
    rank, step = draw.randrange(2), draw.randrange(EVERY, STEPS // 2)
    with Driver(job, tmp_path) as driver:
        driver.until_step(step)
        beat = read_beat(rank_path(job.run, rank))
        assert beat is not None
        os.kill(beat["pid"], signal.SIGKILL)
        output = driver.ends()
    assert len(re.findall(r"the ranks start again \(1 of 3\)", output)) == 1, output
    assert re.search(r"resuming killed-rank from step \d+", output), output
    assert f"trained, {STEPS} steps" in output
    assert_same_run(job, straight)


@pytest.mark.cluster
@pytest.mark.parametrize("ctrl_c", [False, True], ids=["SIGTERM", "Ctrl-C"])
def test_a_stopped_driver_leaves_a_checkpoint_of_that_very_step(cut, straight, tmp_path, ctrl_c):
    job = two_ranks(cut, f"stopped-{ctrl_c}")
    with Driver(job, tmp_path) as driver:
        driver.until_step(EVERY)
        if ctrl_c:
            os.killpg(driver.process.pid, signal.SIGINT)  # as from a terminal, to all that it started as well
        else:
            driver.process.send_signal(signal.SIGTERM)
        output = driver.ends()
    newest = read_checkpoint(committed(checkpoints(job))[-1])
    assert EVERY < newest.step < STEPS
    assert newest.meta["finished"] is False
    assert f"stopped; run the same command again to go on, {newest.step} steps" in output
    with Driver(job, tmp_path) as driver:
        output = driver.ends()
    assert f"resuming {job.name} from step {newest.step}" in output
    assert_same_run(job, straight)


@pytest.mark.cluster
def test_a_killed_driver_takes_its_ranks_along_and_the_next_one_goes_on(cut, straight, tmp_path):
    job = two_ranks(cut, "killed-driver")
    with Driver(job, tmp_path) as driver:
        driver.until_step(2 * EVERY)
        folder = driver.ray_folder
        os.kill(driver.process.pid, signal.SIGKILL)
        assert driver.process.wait(PATIENCE) == -signal.SIGKILL
    assert len(list((job.run / "ray").iterdir())) == 1
    with Driver(job, tmp_path) as driver:
        output = driver.ends()
    assert re.search(r"resuming killed-driver from step \d+", output), output
    assert not (job.run / "ray").exists()
    assert_same_run(job, straight)
    shutil.rmtree(
        folder
    )  # of the killed driver's private Ray; that all of it has ended, too, the lock of the run shows
