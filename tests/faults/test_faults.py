"""What breaks, with real processes: each run ends as one that nobody disturbed, to the bit, or stops and says why."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
from pathlib import Path

import psutil
import pytest
from real_runs import EVERY, STEPS, Running, assert_same_run, finish, kill_everything, small_job
from tiny_run import cut_tiny

from pipeline.checkpoint import committed
from pipeline.heartbeat import rank_path, read_beat
from pipeline.resume import checkpoints

pytestmark = pytest.mark.slow
LONG = pytest.mark.cluster  # what `make test` shows in another way already

DRAWS = random.Random(20261122)  # which rank, which step


@pytest.fixture(scope="module")
def cut(tmp_path_factory):
    return cut_tiny(tmp_path_factory.mktemp("faults"))


@pytest.fixture(scope="module")
def straight(cut):
    """straight(ranks): the run that nobody disturbed, by the local launcher."""
    made = {}

    def of(ranks: int):
        if ranks not in made:
            made[ranks] = small_job(cut, f"straight-{ranks}", ranks)
            finish(made[ranks], cut)
        return made[ranks]

    return of


@pytest.fixture(autouse=True)
def _nothing_is_left():
    yield
    kill_everything()


def steps_of(job) -> list[str]:
    return [path.name for path in committed(checkpoints(job))]


# Exactness


@pytest.mark.parametrize("ranks", [pytest.param(1, marks=LONG), pytest.param(2, marks=LONG), 4])
def test_stopped_and_resumed_by_another_launcher_is_the_same_to_the_bit(cut, straight, tmp_path, ranks):
    job = small_job(cut, f"stopped-{ranks}", ranks)
    go, step = tmp_path / "go", DRAWS.randrange(EVERY + 1, STEPS - 1)
    running = Running(job, tmp_path, "torchrun", faults=[["wait", 0, step, str(go)]])
    running.until((checkpoints(job) / f"step-{EVERY:08d}" / "meta.json").exists)
    running.until(lambda: (read_beat(rank_path(job.run, 0)) or {}).get("stage"))
    running.process.send_signal(signal.SIGTERM)  # the ranks hear of it in this step, which waits
    go.touch()
    _, text = running.end()
    assert "stopped; run the same command again to go on" in text
    stopped = int(steps_of(job)[-1].removeprefix("step-"))
    assert EVERY <= stopped <= step + 1
    assert f"resuming stopped-{ranks} from step {stopped}" in finish(job, tmp_path, "local")
    assert_same_run(job, straight(ranks))


# Killed


def test_a_rank_killed_by_force_is_started_again_by_torchrun(cut, straight, tmp_path):
    job, rank, step = small_job(cut, "killed"), DRAWS.randrange(2), DRAWS.randrange(EVERY + 1, STEPS)
    faults = [["kill", rank, step, str(tmp_path / "killed")]]
    text = finish(job, tmp_path, "torchrun", faults=faults, restarts=1)
    assert (tmp_path / "killed").exists()
    assert f"resuming killed from step {step // EVERY * EVERY}" in text
    assert_same_run(job, straight(2))


@LONG
def test_a_rank_killed_by_force_ends_the_local_launcher_which_goes_on_when_run_again(cut, straight, tmp_path):
    job, faults = small_job(cut, "killed-local"), [["kill", 1, EVERY + 3, str(tmp_path / "killed")]]
    status, text = Running(job, tmp_path, faults=faults).end()
    assert status == 2, text
    assert "rank 1" in text
    assert "Traceback" not in text
    finish(job, tmp_path)
    assert_same_run(job, straight(2))


@LONG
@pytest.mark.parametrize("launcher", ["local", "torchrun"])
def test_ranks_whose_launcher_was_killed_save_and_end(cut, straight, tmp_path, launcher):
    job, go = small_job(cut, f"orphans-{launcher}"), tmp_path / "go"
    running = Running(job, tmp_path, launcher, faults=[["wait", 0, EVERY + 2, str(go)]])
    running.until((checkpoints(job) / f"step-{EVERY:08d}" / "meta.json").exists)
    beats = [rank_path(job.run, rank) for rank in range(2)]
    running.until(lambda: all(read_beat(path) for path in beats))
    ranks = [psutil.Process(read_beat(path)["pid"]) for path in beats]
    running.process.kill()
    running.process.wait()
    go.touch()
    assert psutil.wait_procs(ranks, timeout=60)[1] == []
    assert EVERY < int(steps_of(job)[-1].removeprefix("step-")) <= EVERY + 3  # where they were, saved
    finish(job, tmp_path, launcher)
    assert_same_run(job, straight(2))


@LONG
def test_sigterm_to_one_rank_alone_stops_all_of_them_and_the_launcher(cut, straight, tmp_path):
    job, go = small_job(cut, "one-rank-asked"), tmp_path / "go"
    running = Running(job, tmp_path, faults=[["wait", 0, EVERY + 2, str(go)]])
    running.until(lambda: read_beat(rank_path(job.run, 1)))
    os.kill(read_beat(rank_path(job.run, 1))["pid"], signal.SIGTERM)
    go.touch()
    status, text = running.end()
    assert status == 0, text
    assert "stopped; run the same command again to go on" in text
    finish(job, tmp_path)
    assert_same_run(job, straight(2))


@LONG
def test_ranks_that_see_other_checkpoints_do_not_train_together(cut, straight, tmp_path):
    job = small_job(cut, "blind")
    Running(job, tmp_path, faults=[["kill", 1, EVERY + 3, str(tmp_path / "killed")]]).end()
    status, text = Running(job, tmp_path, faults=[["blind", 1]]).end()
    assert status == 2, text
    assert f"ranks go on from steps 0 to {EVERY}: they see other checkpoints" in text
    finish(job, tmp_path)
    assert_same_run(job, straight(2))


def test_killed_between_a_checkpoints_files_and_its_commit(cut, straight, tmp_path):
    job, marker = small_job(cut, "uncommitted", 1), tmp_path / "killed"
    running = Running(job, tmp_path, faults=[["kill-uncommitted", 2 * EVERY, str(marker)]])
    status, _ = running.end()
    assert status == -signal.SIGKILL
    half = checkpoints(job) / f"step-{2 * EVERY:08d}"
    assert sorted(p.name for p in half.iterdir()) == ["model.safetensors", "training.pt"]
    assert f"from step {EVERY}" in finish(job, tmp_path)
    assert_same_run(job, straight(1))


# Damaged


@pytest.mark.parametrize("damage", [pytest.param("truncated", marks=LONG), "flipped"])
def test_a_damaged_newest_checkpoint_is_passed_over(cut, straight, tmp_path, damage):
    job, marker = small_job(cut, damage, 1), tmp_path / "killed"
    Running(job, tmp_path, faults=[["kill", 0, 2 * EVERY + 5, str(marker)]]).end()
    path = checkpoints(job) / f"step-{2 * EVERY:08d}" / "model.safetensors"
    content = bytearray(path.read_bytes())
    if damage == "flipped":
        content[len(content) // 2] ^= 4
    path.write_bytes(content if damage == "flipped" else content[:-100])
    text = finish(job, tmp_path)
    assert "does not agree with meta.json: damaged" in text
    assert "looking at the checkpoint before it" in text
    assert f"from step {EVERY}" in text
    assert_same_run(job, straight(1))


def test_a_shard_damaged_after_it_was_cut_is_named_and_mended_by_cutting_again(tmp_path):
    folder = cut_tiny(tmp_path / "own")
    job = small_job(folder, "tiny", 1)
    shard = sorted(job.shards.glob("*.tar"))[-1]
    content = bytearray(shard.read_bytes())
    content[len(content) // 2] ^= 1
    shard.write_bytes(content)
    status, text = Running(job, tmp_path).end()
    assert status == 2, text
    assert shard.name in text
    assert "Traceback" not in text
    assert steps_of(job) == []
    content[len(content) // 2] ^= 1
    shard.write_bytes(content)
    finish(job, tmp_path)


# Full


@pytest.fixture
def small_disk(tmp_path):
    """A disk of one's own: its folder, and a function that sets its size in bytes."""
    folder = tmp_path / "disk"
    folder.mkdir()
    made = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=64m", "tmpfs", folder], capture_output=True, text=True, check=False
    )
    if made.returncode != 0:
        pytest.skip(f"a small disk cannot be mounted here: {made.stderr.strip()}")
    yield folder
    subprocess.run(["umount", "--lazy", folder], check=True)


def test_a_full_disk_costs_no_step(cut, straight, small_disk, tmp_path):
    job, go = small_job(cut, "full", 1), tmp_path / "go"
    job = job.model_copy(update={"runs": small_disk})
    running = Running(
        job, tmp_path, faults=[["wait", 0, EVERY + 2, str(go)], ["wait", 0, 2 * EVERY + 2, str(go) + "2"]]
    )
    running.until((checkpoints(job) / f"step-{EVERY:08d}" / "meta.json").exists)
    filler = small_disk / "filler"
    fill(filler)
    go.touch()
    running.until(lambda: "cannot be saved" in running.text())
    assert "No space left on device" in running.text()
    filler.unlink()
    Path(f"{go}2").touch()
    status, text = running.end()
    assert status == 0, text
    assert "training goes on and tries again" in text
    assert steps_of(job) == [f"step-{n * EVERY:08d}" for n in (1, 3, 4)]
    assert_same_run(job, straight(1))


@LONG
def test_a_disk_full_at_the_end_is_an_error_and_loses_nothing(cut, straight, small_disk, tmp_path):
    job, go = small_job(cut, "full-at-the-end", 1), tmp_path / "go"
    job = job.model_copy(update={"runs": small_disk})
    running = Running(job, tmp_path, faults=[["wait", 0, EVERY + 2, str(go)]])
    running.until((checkpoints(job) / f"step-{EVERY:08d}" / "meta.json").exists)
    filler = small_disk / "filler"
    fill(filler)
    go.touch()
    status, text = running.end()
    assert status == 2, text
    assert f"step {STEPS} cannot be saved" in text
    assert "make room" in text.partition("crossray:")[2]  # TensorBoard's own thread prints its trouble before that
    assert "Traceback" not in text
    assert steps_of(job) == [f"step-{EVERY:08d}"]
    filler.unlink()
    finish(job, tmp_path)
    assert_same_run(job, straight(1))


def test_a_folder_that_vanished_is_told_and_may_come_back(cut, straight, tmp_path):
    job, go = small_job(cut, "moved", 1), tmp_path / "go"
    job = job.model_copy(update={"runs": tmp_path / "runs"})
    running = Running(
        job, tmp_path, faults=[["wait", 0, EVERY + 2, str(go)], ["wait", 0, 2 * EVERY + 2, str(go) + "2"]]
    )
    running.until((checkpoints(job) / f"step-{EVERY:08d}" / "meta.json").exists)
    job.run.rename(tmp_path / "away")
    go.touch()
    running.until(lambda: "cannot be saved" in running.text())
    assert f"{job.run} has vanished" in running.text()
    assert not list(job.run.rglob("step-*"))
    shutil.rmtree(job.run, ignore_errors=True)  # signs of life go on
    (tmp_path / "away").rename(job.run)
    Path(f"{go}2").touch()
    status, text = running.end()
    assert status == 0, text
    assert "Traceback" not in text, text
    assert steps_of(job) == [f"step-{n * EVERY:08d}" for n in (1, 3, 4)]
    assert_same_run(job, straight(1))


def fill(path: Path) -> None:
    """Write until nothing more goes."""
    with path.open("wb", buffering=0) as file:
        for size in (2**20, 2**12, 1):
            try:
                while True:
                    file.write(bytes(size))
            except OSError:
                continue


# Numbers that are not finite


@pytest.mark.parametrize(
    "fault",
    [pytest.param(["nan", 1, 23], id="nan"), pytest.param(["infinite-gradient", 23], id="gradient", marks=LONG)],
)
def test_a_bad_step_is_named_and_can_be_left_out(cut, tmp_path, fault):
    skipping = small_job(cut, f"without-{fault[0]}", skip_steps=[23])
    finish(skipping, tmp_path)
    job = small_job(cut, fault[0])
    status, text = Running(job, tmp_path, faults=[fault]).end()
    assert status == 2, text
    what = (
        "the loss fine is not finite (photos of rank 1"
        if fault[0] == "nan"
        else "the gradient is not finite (photos of all"
    )
    assert f"step 23: {what} ranks in this step: photo_0".replace("rank 1 ranks", "rank 1") in text
    assert f"the last good checkpoint is {checkpoints(job)}/step-{2 * EVERY:08d}" in text
    assert "train.skip_steps=[23]" in text
    finish(small_job(cut, fault[0], skip_steps=[23]), tmp_path, faults=[fault])
    assert_same_run(job, skipping)


@LONG
def test_a_step_that_is_trained_on_cannot_be_left_out_later(cut, tmp_path, straight):
    job = small_job(cut, "late", 1)
    Running(job, tmp_path, faults=[["kill", 0, 2 * EVERY + 1, str(tmp_path / "killed")]]).end()
    status, text = Running(small_job(cut, "late", 1, skip_steps=[12]), tmp_path).end()
    assert status == 2, text
    assert "has been trained on step 12 already" in text


# Two at once, and another number of ranks


def test_a_second_run_in_the_same_folder_is_refused(cut, straight, tmp_path):
    job, go = small_job(cut, "twice", 1), tmp_path / "go"
    first = Running(job, tmp_path, faults=[["wait", 0, EVERY + 2, str(go)]])
    first.until((checkpoints(job) / f"step-{EVERY:08d}" / "meta.json").exists)
    (tmp_path / "second").mkdir()
    status, text = Running(job, tmp_path / "second", faults=[["patience", 0.5]]).end()
    assert status == 2, text
    assert f"process {first.process.pid} on {os.uname().nodename} trains this run already" in text
    go.touch()
    assert first.end()[0] == 0
    assert_same_run(job, straight(1))


def test_another_number_of_ranks_only_where_the_job_allows_it(cut, tmp_path):
    job = small_job(cut, "ranks", 1)
    Running(job, tmp_path, faults=[["kill", 0, EVERY + 1, str(tmp_path / "killed")]]).end()
    two = small_job(cut, "ranks", 2, any_ranks=True)
    text = finish(two, tmp_path)
    assert "goes on from 1 ranks with 2: from step 10 on a step averages over 4 patches instead of 2" in text
    assert steps_of(job)[-1] == f"step-{STEPS:08d}"
