"""Ray Train starts the ranks: the bits of the other launchers, and one message for whatever goes wrong."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from concurrent.futures import Future
from pathlib import Path

import numpy as np
import pytest
from tiny_run import assert_same_bits, cut_tiny, final_state, tiny_job

from pipeline.clock import Clock, Speed
from pipeline.config import Job, save_job
from pipeline.errors import CrossrayError
from pipeline.launch import ray_train
from pipeline.launch.local import run_local
from pipeline.launch.ray_train import METRICS, Said, attend, new_start, run_ray
from pipeline.launch.room import Wanted
from pipeline.launch.run import claim_run, run_job
from pipeline.launch.stop import LOOK_EVERY, StopFile, StopRequest
from pipeline.launch.tasks import ray_session
from pipeline.record import read_losses

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def cut(tmp_path_factory):
    return cut_tiny(tmp_path_factory.mktemp("ray"))


@pytest.fixture(autouse=True)
def _environment(cut, monkeypatch):
    values = {"CROSSRAY_CACHE": str(cut / "cache"), "RAY_TRAIN_HEALTH_CHECK_INTERVAL_S": "0.2"}
    for name, value in values.items():
        monkeypatch.setenv(name, value)
    for name in ("RANK", "RAY_ADDRESS", "CROSSRAY_HOME"):
        monkeypatch.delenv(name, raising=False)


def two_ranks(cut: Path, name: str, **keys) -> Job:
    train = {"epochs": 2, "steps_per_epoch": 10, "checkpoint_every": 10} | keys.pop("train", {})
    return tiny_job(cut, "crossray", {"name": name, "ranks": 2, "patch": {"size": 4}, "train": train, **keys})


# What driver and ranks say to each other


def test_a_file_that_fills_or_goes_asks_the_ranks_to_stop(tmp_path, monkeypatch):
    now = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    path = tmp_path / "stop"
    path.touch()
    asked = StopRequest(path)
    assert not asked()
    path.write_text("stop\n")
    assert not asked()  # looked at twice a second at most
    now += LOOK_EVERY
    assert asked()
    path.unlink()
    assert asked()
    assert StopRequest(path)()  # nobody is left who could ask


def test_lines_of_ranks_are_passed_on_once_and_whole(tmp_path, caplog, monkeypatch):
    monkeypatch.setattr(ray_train.log, "propagate", True)
    paths = [tmp_path / name for name in ("0.log", "1.log")]
    for path in paths:
        path.touch()
    said = Said(paths)
    paths[0].write_text("resuming tiny from step 10\ntraining ti")
    with caplog.at_level("INFO", "crossray"):
        said.pass_on()
        with paths[0].open("a") as file:
            file.write("ny: 30 %\n")
        paths[1].write_text("ä warning\n")
        said.pass_on()
        said.pass_on()
    assert caplog.messages == ["resuming tiny from step 10", "training tiny: 30 %", "ä warning"]


def waiting(tmp_path):
    """A start whose ranks do not come, and the driver's flag."""
    start = new_start(tiny_job(tmp_path, "nerf", {"ranks": 2}))
    start.make()
    return start, StopFile(start.stop)


def test_a_stop_does_not_wait_for_ranks_that_are_not_there(tmp_path):
    start, stop = waiting(tmp_path)
    stop.stop(15, None)
    assert start.stop.read_text()  # ranks that do come see it
    result = attend(start, Wanted(2, 1, 0, "PACK"), stop, Future())
    assert result == {"steps": 0, "train_seconds": 0.0, "ranks": 2, "finished": False}
    folder = start.job.run / "checkpoints" / "step-00000030"
    folder.mkdir(parents=True)
    (folder / "meta.json").write_text(json.dumps({"step": 30, "seconds": 4.5}))
    result = attend(start, Wanted(2, 1, 0, "PACK"), stop, Future())
    assert (result["steps"], result["train_seconds"], result["finished"]) == (30, 4.5, False)


def test_a_stop_waits_for_ranks_that_save(tmp_path):
    start, stop = waiting(tmp_path)
    start.running.write_text("running\n")
    stop.stop(15, None)
    saved: Future = Future()
    polls = []

    class Ranks(Said):
        def pass_on(self):
            polls.append(1)
            if len(polls) == 3:
                saved.set_result({"steps": 7, "finished": False})

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ray_train, "Said", Ranks)
        assert attend(start, Wanted(2, 1, 0, "PACK"), stop, saved) == {"steps": 7, "finished": False}


def test_the_user_hears_why_there_are_no_ranks(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(ray_train.log, "propagate", True)
    monkeypatch.setattr(ray_train, "PATIENCE", 0.0)
    monkeypatch.setattr(ray_train, "alive_nodes", lambda: [{"CPU": 1.0}])
    start, stop = waiting(tmp_path)
    future: Future = Future()
    monkeypatch.setattr(ray_train, "wait", lambda futures, timeout: future.set_result({}) if caplog.messages else None)
    with caplog.at_level("WARNING", "crossray"):
        attend(start, Wanted(2, 1, 0, "PACK"), stop, future)
    assert "waiting for a node: of 2 ranks of 1 CPU each, the cluster has places for 1 now" in caplog.messages


def test_only_what_earlier_drivers_left_is_removed(tmp_path):
    job = tiny_job(tmp_path, "nerf")
    start = new_start(job)
    start.make()
    folder = start.folder.parent
    (folder / "20200101-000000-killed").mkdir()
    (folder / "20990101-000000-another").mkdir()
    start.remove_earlier()
    start.remove()
    assert [path.name for path in folder.iterdir()] == ["20990101-000000-another"]


def test_every_metric_is_a_number_that_training_gives():
    speed = Speed(Clock(10, None), rays_a_step=4)
    assert {metric.key for metric in METRICS.values()} <= speed.numbers({}, {"mse": np.float32(0.1)}).keys()
    assert all(name.startswith("crossray_") and metric.meaning and metric.unit for name, metric in METRICS.items())


@pytest.mark.parametrize("launcher", ["local", "torchrun"])
def test_evaluations_beside_the_ranks_need_a_cluster(tmp_path, launcher):
    job = tiny_job(tmp_path, "nerf", {"launcher": launcher, "evaluate": {"each_checkpoint": True}})
    with pytest.raises(CrossrayError, match=rf"each_checkpoint: launcher {launcher} .* jobs/reeval\.yaml"):
        run_job(job)


# With a real Ray


@pytest.mark.slow
def test_ray_gives_the_bits_of_the_local_launcher(cut, monkeypatch):
    monkeypatch.chdir(cut)  # relative paths are meant from here in the ranks, too
    relative = {"runs": "runs", "scene": {"shards": "shards/tiny", "path": "scene"}}
    job, local = two_ranks(cut, "ray", launcher="ray", **relative), two_ranks(cut, "local")
    with ray_session(num_cpus=2):
        with pytest.raises(CrossrayError, match=r"ranks: the job wants 3 ranks .* places for 2: .*--set ranks=2"):
            run_ray(two_ranks(cut, "many", ranks=3))
        trained, evaluated = run_job(job)
    assert evaluated == []
    assert {"steps": 20, "ranks": 2, "finished": True}.items() <= trained.items()
    assert trained == json.loads((job.run / "training.json").read_text())
    assert not (job.run / "ray").exists()
    claim_run(local)
    run_local(local)
    for ours, theirs in zip(final_state(job), final_state(local), strict=True):
        assert_same_bits(dict(ours), dict(theirs))
    ours, theirs = read_losses(job.run), read_losses(local.run)
    assert set(ours) == {0, 1}
    for rank, losses in ours.items():
        assert losses.names == theirs[rank].names
        assert losses.rows.tobytes() == theirs[rank].rows.tobytes()


@pytest.mark.cluster
def test_an_error_that_the_user_has_to_put_right_is_one_message_and_no_second_try(cut, tmp_path):
    rates = dict.fromkeys(("grid", "field", "appearance", "transient"), 1e30)
    job = two_ranks(cut, "failing", launcher="ray", train={"learning_rates": rates})
    save_job(job, tmp_path / "job.yaml")
    done = subprocess.run(
        [sys.executable, "-m", "pipeline", "run", str(tmp_path / "job.yaml")],
        cwd=ROOT,
        env=os.environ | {"COLUMNS": "300"},
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
    )
    output = done.stdout + done.stderr
    assert done.returncode == 2, output
    assert len([line for line in output.splitlines() if line.startswith("crossray: ")]) == 1, output
    assert "finite" in output.splitlines()[-1], output
    assert "Traceback" not in output
    assert "start again" not in output
    assert not (job.run / "ray").exists()
