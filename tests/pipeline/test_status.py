"""Signs of life, and what a run's folder tells of it."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import time

import pytest

from pipeline.errors import CrossrayError
from pipeline.heartbeat import SILENCE, Heartbeat, alive, driver_path, rank_path, read_beat
from pipeline.status import duration, find_runs, status_of


@pytest.fixture
def run(tmp_path):
    (tmp_path / "runs" / "a").mkdir(parents=True)
    (tmp_path / "runs" / "a" / "job.yaml").write_text("name: a\n")
    return tmp_path / "runs" / "a"


@pytest.fixture
def dead() -> int:
    """A process number that was somebody's."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def beat(path, **facts):
    facts = {"host": socket.gethostname(), "pid": os.getpid(), "time": time.time(), "stage": "training", **facts}
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(facts))


def test_a_beat_is_read_back(run):
    heartbeat = Heartbeat(rank_path(run, 1))
    assert heartbeat.due()
    heartbeat.beat("training", step=7)
    assert not heartbeat.due()
    found = read_beat(rank_path(run, 1))
    assert (found["step"], found["stage"], found["pid"], found["host"]) == (
        7,
        "training",
        os.getpid(),
        socket.gethostname(),
    )
    assert alive(found)


def test_a_beat_that_cannot_be_written_is_said_once(run, caplog):
    (run / "ranks").write_text("a file where the folder should be")
    heartbeat = Heartbeat(rank_path(run, 0))
    with caplog.at_level("WARNING", "crossray"):
        for _ in range(3):
            heartbeat.beat("training")
    assert caplog.text.count("cannot be written") == 1


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"host": "x"}', "\x00"])
def test_what_is_no_beat_is_none(tmp_path, content):
    (tmp_path / "beat").write_text(content)
    assert read_beat(tmp_path / "beat") is None
    assert read_beat(tmp_path / "absent") is None


def test_who_is_alive(dead):
    here = {"host": socket.gethostname(), "stage": "training"}
    assert alive(here | {"pid": os.getpid(), "time": time.time()})
    assert not alive(here | {"pid": dead, "time": time.time()})
    assert not alive(here | {"pid": os.getpid(), "time": 0.0})  # the number is another process's by now
    there = {"host": "elsewhere", "stage": "training", "pid": 1}
    assert alive(there | {"time": time.time() - 0.5 * SILENCE})
    assert not alive(there | {"time": time.time() - 2 * SILENCE})
    assert alive(there | {"time": time.time() - 2 * SILENCE, "step_seconds": SILENCE})  # its steps are that slow


def test_a_run_in_training(run):
    for rank in (0, 1):
        beat(rank_path(run, rank), ranks=2, step=30, total=120, progress=0.25, seconds_left=600.0)
    found = status_of(run)
    assert (found.stage, found.step, found.total, found.ranks_alive, found.ranks) == ("training", 30, 120, 2, 2)
    assert found.seconds_left == 600
    assert (found.checkpoint, found.evaluation) == (None, None)


def test_ranks_that_are_gone(run, dead):
    for rank in (0, 1):
        beat(rank_path(run, rank), ranks=2, step=3)
    beat(rank_path(run, 1), ranks=2, step=3, pid=dead)
    assert (status_of(run).stage, status_of(run).ranks_alive) == ("losing ranks", 1)
    beat(rank_path(run, 0), ranks=2, step=3, pid=dead)
    assert (status_of(run).stage, status_of(run).ranks_alive) == ("lost", 0)
    assert status_of(run).seconds_left is None


def test_what_happens_around_the_training(run, dead):
    beat(driver_path(run), stage="making shards")
    assert status_of(run).stage == "making shards"
    beat(rank_path(run, 0), stage="trained", ranks=1)
    beat(driver_path(run), stage="evaluating")
    assert status_of(run).stage == "evaluating"
    beat(driver_path(run), stage="evaluating", pid=dead)
    assert status_of(run).stage == "trained"


def test_checkpoints_and_evaluations(run):
    for step in (5, 10):
        folder = run / "checkpoints" / f"step-{step:08d}"
        folder.mkdir(parents=True)
        if step == 5:
            (folder / "meta.json").write_text("{}")
        results = run / "eval" / "cross@R1" / f"step-{step:08d}"
        results.mkdir(parents=True)
        result = {"protocol": "cross@R1", "step": step, "mean": {"psnr": 20.0 + step}}
        (results / "metrics.json").write_text(json.dumps(result) if step == 5 else '{"half')
    found = status_of(run)
    assert found.checkpoint == 5
    assert 0 <= found.checkpoint_age < 60
    assert found.evaluation == "cross@R1 at 5: 25.00 dB"


def test_runs_are_found_below_a_folder(run):
    assert find_runs([run.parent]) == [run]
    assert find_runs([run]) == [run]
    with pytest.raises(CrossrayError, match="no run is there"):
        find_runs([run / "checkpoints"])


def test_durations():
    assert [duration(s) for s in (0, 59.6, 90, 3600, 3660.4, 90000, 1e6)] == [
        "0 s", "1 min", "1 min 30 s", "1 h", "1 h 1 min", "1 d 1 h", "11 d 13 h",
    ]  # fmt: skip
