"""Several ranks as real processes: every launcher gives the same bits, and a stopped run goes on as an undisturbed one.

One job for all of it, long enough to be interrupted; loopback only.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from tiny_run import assert_same_bits, cut_tiny, final_state, tiny_job

from pipeline import train as train_module
from pipeline.checkpoint import committed, read_checkpoint
from pipeline.config import Job, save_job
from pipeline.errors import CrossrayError
from pipeline.launch.local import run_local
from pipeline.launch.run import claim_run
from pipeline.resume import checkpoints

ROOT = Path(__file__).resolve().parents[2]
STEPS = 100
EVERY = 10  # steps between checkpoints
FIRST = Path(f"step-{EVERY:08d}") / "meta.json"  # of the first checkpoint
PATIENCE = 100.0  # seconds until a test gives a process up


@pytest.fixture(scope="module")
def cut(tmp_path_factory):
    return cut_tiny(tmp_path_factory.mktemp("launch"))


@pytest.fixture(autouse=True)
def _environment(cut, monkeypatch):
    for name, value in (("CROSSRAY_CACHE", str(cut / "cache")), ("OMP_NUM_THREADS", "1"), ("GLOO_SOCKET_IFNAME", "lo")):
        monkeypatch.setenv(name, value)
    monkeypatch.delenv("RANK", raising=False)


def two_ranks(cut: Path, name: str, **train) -> Job:
    train = {"epochs": 2, "steps_per_epoch": STEPS // 2, "checkpoint_every": EVERY} | train
    return tiny_job(cut, "crossray", {"name": name, "ranks": 2, "patch": {"size": 4}, "train": train})


@pytest.fixture(scope="module")
def straight(cut):
    """The undisturbed run, by the local launcher."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CROSSRAY_CACHE", str(cut / "cache"))
        job = two_ranks(cut, "straight")
        claim_run(job)
        result = run_local(job)
    assert {"steps": STEPS, "ranks": 2, "finished": True, "rays_a_step": 64}.items() <= result.items()
    return job


def start(job: Job, folder: Path, *words: str) -> subprocess.Popen:
    """`python -m words run job.yaml` in a session of its own, its output in folder/output."""
    save_job(job, folder / "job.yaml")
    command = [sys.executable, "-m", *words, "run", str(folder / "job.yaml")]
    if "pipeline" not in words[:1]:
        command += ["--launcher", "torchrun"]
    with (folder / "output").open("ab") as output:
        return subprocess.Popen(command, cwd=ROOT, stdout=output, stderr=subprocess.STDOUT, start_new_session=True)


def torchrun(job: Job, folder: Path) -> subprocess.Popen:
    module = ["torch.distributed.run", "--standalone", "--local-addr=127.0.0.1", "--nproc-per-node=2", "-m", "pipeline"]
    return start(job, folder, *module)


def wait(process: subprocess.Popen, folder: Path) -> tuple[int, str]:
    """Exit status and output; nothing of the process's session is left behind."""
    try:
        status = process.wait(PATIENCE)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    return status, (folder / "output").read_text()


def interrupt_once_there(process: subprocess.Popen, path: Path, ctrl_c: bool = False) -> None:
    """SIGTERM to the process as soon as `path` exists; or SIGINT to it and all its ranks, as a terminal's Ctrl-C."""
    deadline = time.monotonic() + PATIENCE
    while not path.exists():
        assert process.poll() is None, "the process ended before it could be interrupted"
        assert time.monotonic() < deadline, f"{path} never came"
        time.sleep(0.02)
    if ctrl_c:
        os.killpg(process.pid, signal.SIGINT)
    else:
        process.send_signal(signal.SIGTERM)


def assert_stopped_on_the_way(job: Job) -> int:
    """The newest checkpoint is whole, and of a step on the way, which is returned."""
    newest = read_checkpoint(committed(checkpoints(job))[-1])
    assert EVERY <= newest.step < STEPS
    assert newest.meta["finished"] is False
    assert newest.meta["world_size"] == 2
    return newest.step


def assert_same_run(job: Job, other: Job) -> None:
    for ours, theirs, what in zip(final_state(job), final_state(other), ("model", "optimiser"), strict=True):
        assert_same_bits(dict(ours), dict(theirs), what)


@pytest.mark.slow
def test_torchrun_gives_the_bits_of_the_local_launcher(cut, straight, tmp_path):
    job = two_ranks(cut, "torchrun")
    status, output = wait(torchrun(job, tmp_path), tmp_path)
    assert status == 0, output
    assert len(re.findall(rf"trained, {STEPS} steps", output)) == 1  # only rank 0 says so
    assert_same_run(job, straight)


@pytest.mark.slow
def test_sigterm_to_torchrun_leaves_a_checkpoint_and_resumes_to_the_same_bits(cut, straight, tmp_path):
    job = two_ranks(cut, "stopped")
    process = torchrun(job, tmp_path)
    interrupt_once_there(process, checkpoints(job) / FIRST)
    _, output = wait(process, tmp_path)  # the agent's own status tells of the signal
    step = assert_stopped_on_the_way(job)
    assert f"stopped; run the same command again to go on, {step} steps" in output
    assert "exitcode" not in output, output  # of a rank that failed or had to be killed
    status, output = wait(torchrun(job, tmp_path), tmp_path)
    assert status == 0, output
    assert f"resuming stopped from step {step}" in output
    assert_same_run(job, straight)


@pytest.mark.slow
@pytest.mark.parametrize("ctrl_c", [False, True], ids=["SIGTERM", "Ctrl-C"])
def test_the_local_launcher_ends_cleanly(cut, tmp_path, ctrl_c):
    job = two_ranks(cut, f"local-{ctrl_c}")
    process = start(job, tmp_path, "pipeline")
    interrupt_once_there(process, checkpoints(job) / FIRST, ctrl_c)
    _, output = wait(process, tmp_path)
    assert_stopped_on_the_way(job)
    assert "forcefully" not in output, output  # the ranks ended by themselves
    assert "Traceback" not in output, output
    assert "run the same command again to go on" in output


@pytest.mark.slow
def test_a_rank_that_fails_ends_all_and_says_why(cut):
    rates = dict.fromkeys(("grid", "field", "appearance", "transient"), 1e30)
    job = two_ranks(cut, "failing", learning_rates=rates, log_every=1)
    claim_run(job)
    with pytest.raises(CrossrayError, match=r"rank [01] failed: .*not .*finite.*photo_00"):
        run_local(job)
    assert committed(checkpoints(job)) == []


def test_sigterm_to_one_rank_stops_it_and_gives_the_signal_back(cut, monkeypatch):
    job = tiny_job(cut, "nerf", {"name": "alone", "train": {"epochs": 4}})
    step = train_module.training_step

    def interrupted(work, ddp, optimiser, number, record):
        if number == 3:
            signal.raise_signal(signal.SIGTERM)
        return step(work, ddp, optimiser, number, record)

    monkeypatch.setattr(train_module, "training_step", interrupted)
    before = signal.getsignal(signal.SIGTERM)
    result = run_local(job)
    assert signal.getsignal(signal.SIGTERM) is before
    assert (result["steps"], result["finished"]) == (4, False)
    assert [p.name for p in committed(checkpoints(job))] == ["step-00000004"]


def test_more_ranks_than_a_machine_could_run_are_refused_at_once(cut):
    job = tiny_job(cut).model_copy(update={"ranks": 100_000})
    with pytest.raises(CrossrayError, match="ranks: 100000 processes on this machine's"):
        run_local(job)
