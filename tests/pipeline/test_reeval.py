"""Re-evaluation: only what is lacking, whole or not at all, once however many passes there are; and on a clock."""

from __future__ import annotations

import json
import logging
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import tiny_run
import yaml
from pydantic import ValidationError
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tiny_run import cut_tiny, tiny_job

from pipeline import cli
from pipeline import evaluate as evaluate_module
from pipeline import judge as judge_module
from pipeline import reeval as module
from pipeline.best import best_steps, write_best
from pipeline.checkpoint import committed, prune
from pipeline.config import JobError
from pipeline.errors import CrossrayError
from pipeline.evaluate import evaluate_run, lock_of, recorded
from pipeline.launch.reeval import EachCheckpoint, evaluation_tasks, keep_passing, needs_of_evaluation
from pipeline.launch.run import claim_run
from pipeline.launch.tasks import in_process, ray_session
from pipeline.reeval import ReevalJob, find_runs, interval, load_reeval, one_pass
from pipeline.runs import checkpoint_of
from pipeline.train import train
from pipeline.work import Context

ROOT = Path(__file__).resolve().parents[2]
PATIENCE = 100.0  # seconds until a test gives a process up
FULL, HALF = "crnerf-full@R2", "nerfw-half@R2"
STEPS = (2, 4, 6)
VIEWS = 3  # test photos


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run with checkpoints of STEPS, whose job asks for FULL; nothing of it is evaluated."""
    folder = tmp_path_factory.mktemp("reeval")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tiny_run, "SPLITS", ("train", "test", "train", "test", "val", "test"))
        patch.setenv("CROSSRAY_CACHE", str(folder / "cache"))
        cut_tiny(folder)
        over = {"train": {"epochs": 1, "checkpoint_every": 2}, "evaluate": {"protocols": [FULL]}}
        job = tiny_job(folder, "crossray", over)
        claim_run(job)
        train(job, Context())
    assert [p.name for p in committed(job.run / "checkpoints")] == [name_of(step) for step in STEPS]
    return folder


@pytest.fixture(autouse=True)
def _environment(trained, monkeypatch):
    for name, value in (("CROSSRAY_CACHE", str(trained / "cache")), ("OMP_NUM_THREADS", "1"), ("COLUMNS", "200")):
        monkeypatch.setenv(name, value)
    for name in ("RANK", "RAY_ADDRESS", "CROSSRAY_HOME", "CROSSRAY_LPIPS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(judge_module, "find_lpips", lambda: None)


@pytest.fixture
def run(trained, tmp_path) -> Path:
    """A run of this test's own."""
    return shutil.copytree(trained / "runs" / "tiny", tmp_path / "runs" / "tiny")


def name_of(step: int) -> str:
    return f"step-{step:08d}"


def metrics(run: Path, step: int, protocol: str = FULL) -> Path:
    return run / "eval" / protocol / name_of(step) / "metrics.json"


def pass_over(*runs: Path | str, **keys) -> module.Summary:
    """One pass in this process."""
    return one_pass(ReevalJob(runs=tuple(map(str, runs)), **keys), in_process)


def counts(summary: module.Summary) -> tuple[int, int, int, int, int]:
    return summary.evaluated, summary.there, summary.elsewhere, len(summary.skipped), len(summary.failed)


def inodes(run: Path) -> dict[str, int]:
    """Every file of the evaluations and of their curves: one that is written again is another."""
    places = (run / "eval", run / "tensorboard")
    return {str(p): p.stat().st_ino for place in places for p in place.rglob("*") if p.is_file()}


# A pass


def test_a_pass_does_what_is_lacking_and_the_next_one_nothing(run):
    evaluate_run(run, FULL, step=4)
    before = inodes(run)
    assert counts(pass_over(run)) == (2, 1, 0, 0, 0)
    changed = {path for path, inode in before.items() if inodes(run)[path] != inode}
    assert {Path(path).name for path in changed} <= {"best.json"}
    for step in STEPS:
        result = json.loads(metrics(run, step).read_text())
        assert (result["step"], len(result["images"])) == (step, VIEWS)
        assert result["images"] == evaluate_run(run, FULL, step)["images"]
    after = inodes(run)
    assert counts(pass_over(run)) == (0, 3, 0, 0, 0)
    assert counts(pass_over(str(run.parent / "*"), str(run))) == (0, 3, 0, 0, 0)  # each run once
    assert inodes(run) == after
    assert not list(run.rglob("*.tmp"))


def test_wanted_protocols_come_instead_of_the_runs_own(run):
    assert counts(pass_over(run, protocols=HALF)) == (3, 0, 0, 0, 0)
    assert not (run / "eval" / FULL).exists()
    assert counts(pass_over(run, protocols=(HALF, FULL))) == (3, 3, 0, 0, 0)


def test_half_written_metrics_are_made_again(run):
    pass_over(run)
    whole = json.loads(metrics(run, 4).read_text())
    for content in (metrics(run, 4).read_bytes()[:200], b"", b"[]"):
        metrics(run, 4).write_bytes(content)
        assert counts(pass_over(run)) == (1, 2, 0, 0, 0)
        assert json.loads(metrics(run, 4).read_text())["images"] == whole["images"]


def test_what_another_process_is_evaluating_is_left_to_it(run):
    with lock_of(run, name_of(4)):
        assert counts(pass_over(run)) == (2, 0, 1, 0, 0)
        assert not metrics(run, 4).exists()
    assert counts(pass_over(run)) == (1, 2, 0, 0, 0)


def test_what_another_process_did_before_it_could_be_held_is_not_done_again(run, monkeypatch):
    """The other one ends between this pass's look at metrics.json and its lock."""
    lock = lock_of(run, name_of(2))

    def quicker(*words):
        if not metrics(run, 2).exists():
            evaluate_run(run, FULL, step=2)
        return lock

    monkeypatch.setattr(module, "lock_of", quicker)
    before = {}
    real = module.take

    def take(lacking, summary):
        mine = real(lacking, summary)
        before.setdefault("inode", metrics(run, 2).stat().st_ino)
        return mine

    monkeypatch.setattr(module, "take", take)
    assert counts(pass_over(run)) == (2, 1, 0, 0, 0)
    assert metrics(run, 2).stat().st_ino == before["inode"]


def test_what_does_not_fit_is_skipped_with_its_reason_and_the_rest_is_done(run, trained, tmp_path):
    shutil.copytree(run, run.parent / "untrained", ignore=shutil.ignore_patterns("checkpoints"))
    (run.parent / "strange").mkdir()
    (run.parent / "strange" / "job.yaml").write_text("kind: train\nname: [")
    (run / "checkpoints" / name_of(2) / "model.safetensors").write_bytes(b"half")
    path = run / "checkpoints" / name_of(4) / "meta.json"
    path.write_text(path.read_text().replace('"step"', '"stop"'))
    summary = pass_over(run.parent / "*", protocols=(FULL, "crnerf-full@R4", "cross@R2"))
    assert counts(summary)[:3] == (1, 0, 0)
    assert summary.failed == []
    text = "\n".join(summary.skipped)
    for part in (
        r"crnerf-full@R4: .*at R2",
        r"cross@R2: .*holds no truth",
        r"untrained: it has no checkpoint",
        r"strange.*job\.yaml",
        r"step-00000002: .*model\.safetensors.*damaged",
        r"step-00000004.*damaged",
    ):
        assert re.search(part, text), (part, text)
    assert metrics(run, 6).exists()


def test_a_run_without_protocols_says_so(run):
    job = yaml.safe_load((run / "job.yaml").read_text())
    job["evaluate"]["protocols"] = []
    (run / "job.yaml").write_text(yaml.safe_dump(job))
    (line,) = pass_over(run).skipped
    assert "names a protocol" in line


def test_a_checkpoint_that_fails_ends_nothing(run, monkeypatch):
    score = judge_module.score

    def failing(*words):
        if len(done) == 1:
            raise RuntimeError("out of memory")
        return score(*words)

    done: list[Path] = []
    real = module.finish

    def finish(mine, summary):
        real(mine, summary)
        done.append(mine)

    monkeypatch.setattr(module, "finish", finish)
    monkeypatch.setattr(judge_module, "score", failing)
    summary = pass_over(run)
    assert counts(summary) == (2, 0, 0, 0, 1)
    assert re.search(r"tiny, step-00000004: RuntimeError: out of memory", summary.failed[0])
    assert [metrics(run, step).exists() for step in STEPS] == [True, False, True]
    monkeypatch.undo()


def test_shards_that_are_gone_are_a_failure(run, tmp_path):
    job = yaml.safe_load((run / "job.yaml").read_text())
    job["scene"]["shards"] = str(tmp_path / "nowhere")
    (run / "job.yaml").write_text(yaml.safe_dump(job))
    summary = pass_over(run)
    assert counts(summary) == (0, 0, 0, 0, 3)
    assert "nowhere" in summary.failed[0]


def test_a_checkpoint_that_training_removes_meanwhile_is_skipped(run, monkeypatch):
    real = module.score_views

    def removing(task):
        evaluate_module._latest.clear()
        if task.step == 4:
            shutil.rmtree(run / "checkpoints" / name_of(4), ignore_errors=True)
        return real(task)

    monkeypatch.setattr(module, "score_views", removing)
    summary = pass_over(run)
    assert counts(summary) == (2, 0, 0, 1, 0)
    assert "removed" in summary.skipped[0]


# Curves


def test_curves_and_a_picture_stand_at_the_checkpoints_own_steps(run):
    evaluate_run(run, HALF)  # `crossray evaluate` does it, too
    pass_over(run)
    board = EventAccumulator(str(run / "tensorboard" / "eval"), size_guidance={"images": 0, "scalars": 0})
    board.Reload()
    for metric in ("psnr", "ssim"):
        curve = {event.step: event.value for event in board.Scalars(f"eval/{FULL}/{metric}")}
        assert curve == {
            step: pytest.approx(json.loads(metrics(run, step).read_text())["mean"][metric], rel=1e-6) for step in STEPS
        }
    assert [event.step for event in board.Scalars(f"eval/{HALF}/psnr")] == [6]
    pictures = board.Images(f"eval/{FULL}/view")
    assert sorted(picture.step for picture in pictures) == list(STEPS)
    assert (pictures[0].width, pictures[0].height) == (24, 18)


def test_curves_come_before_metrics(run, monkeypatch):
    def full(*words):
        raise OSError("no space left on device")

    monkeypatch.setattr(evaluate_module, "write_evaluation", full)
    summary = pass_over(run)
    assert counts(summary) == (0, 0, 0, 0, 3)
    assert "no space left" in summary.failed[0]
    assert not list(run.rglob("metrics.json"))


# The best one


def best(run: Path, protocol: str = FULL) -> dict:
    return json.loads((run / "eval" / protocol / "best.json").read_text())


def test_best_is_the_highest_psnr_of_what_is_there(run):
    pass_over(run)
    scores = {step: json.loads(metrics(run, step).read_text())["mean"]["psnr"] for step in STEPS}
    highest = max(scores, key=scores.__getitem__)
    found = best(run)
    assert (found["step"], found["checkpoint"], found["psnr"], found["of"]) == (
        highest, name_of(highest), scores[highest], 3,
    )  # fmt: skip
    assert "not a fair score" in found["chosen"]
    assert best_steps(run) == {highest}
    (run / "eval" / FULL / "best.json").write_text("{")  # damaged, or left behind by a pass that was killed
    assert best_steps(run) == set()
    pass_over(run)
    assert best(run) == found
    shutil.rmtree(run / "checkpoints" / name_of(highest))
    pass_over(run)
    assert best(run)["step"] == max(set(STEPS) - {highest}, key=scores.__getitem__)


def test_the_earliest_of_equal_ones_is_best_and_what_is_no_number_never(tmp_path):
    def result(step, psnr):
        return {"step": step, "checkpoint_sha256": "0", "mean": {"psnr": psnr}}

    write_best(tmp_path, [result(9, 20.0), result(3, 20.0), result(6, 19.0), result(1, float("nan"))])
    assert json.loads((tmp_path / "best.json").read_text())["step"] == 3
    write_best(tmp_path, [result(1, float("nan"))])
    assert not (tmp_path / "best.json").exists()


def test_prune_keeps_the_best(run):
    evaluate_run(run, FULL, step=2)
    assert best_steps(run) == {2}
    prune(run / "checkpoints", 1, best_steps(run))
    assert [p.name for p in committed(run / "checkpoints")] == [name_of(2), name_of(6)]
    prune(run / "checkpoints", 1)
    assert [p.name for p in committed(run / "checkpoints")] == [name_of(6)]


# The job file


@pytest.mark.parametrize(
    ("every", "seconds"), [(None, None), ("1s", 1), ("45s", 45), ("30m", 1800), ("2h", 7200), ("1d", 86400)]
)
def test_every(every, seconds):
    assert interval(ReevalJob(runs=("runs/*",), every=every)) == seconds


@pytest.mark.parametrize("every", ["", "30", "m", "0m", "1.5h", "30 m", "-1s", "1w", "30m\n", "1h30m", "9999999s"])
def test_what_is_no_time_is_refused(every):
    with pytest.raises(JobError, match=r"every: .*write 45s, 30m, 2h or 1d"):
        interval(ReevalJob(runs=("runs/*",), every=every))


def test_the_shipped_job_loads_and_explains_its_keys():
    text = (ROOT / "jobs" / "reeval.yaml").read_text()
    reeval = load_reeval(ROOT / "jobs" / "reeval.yaml", ["every=30m", "runs=runs/a", f"protocols={FULL}"])
    assert (reeval.runs, reeval.protocols, reeval.every) == (("runs/a",), (FULL,), "30m")
    for key in ReevalJob.model_fields:
        assert re.search(rf"^{key}:", text, re.MULTILINE), key
    with pytest.raises(ValidationError):
        ReevalJob(runs=())


def test_patterns_find_runs_of_studies_too(run, tmp_path, monkeypatch):
    deep = shutil.copytree(run, run.parent / "study" / "scene.a.seed0")
    monkeypatch.chdir(tmp_path)

    def found(*patterns, **keys):
        return [str(path) for path in find_runs(ReevalJob(runs=patterns, **keys))]

    assert found("runs/*") == ["runs/tiny"]
    assert found("runs/**") == ["runs/study/scene.a.seed0", "runs/tiny"]
    assert found("runs/study/*", "runs/tiny", "runs/**") == ["runs/study/scene.a.seed0", "runs/tiny"]
    assert found(str(tmp_path / "runs" / "*" / "*")) == [str(deep)]
    assert found("runs/none*", every="1m") == []  # one may come
    for pattern in ("runs/none*", "runs/none", "runs/study"):
        with pytest.raises(CrossrayError, match=re.escape(pattern)):
            found(pattern)
    with pytest.raises(CrossrayError, match="runs/none is not a run"):
        found("runs/none", every="1m")


@pytest.fixture
def crossray(monkeypatch, capsys):
    """crossray(*words): what the command does in this process; exit status and all of its output."""
    logger = logging.getLogger("crossray")
    before = logger.handlers[:], logger.level, logger.propagate

    def command(*words: object) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["crossray", *map(str, words)])
        status = 0
        try:
            cli.main()
        except SystemExit as end:
            status = int(end.code or 0)
        out, err = capsys.readouterr()
        return status, out + err

    yield command
    logger.handlers[:], logger.level, logger.propagate = before


def job_file(folder: Path, **keys) -> Path:
    path = folder / "reeval.yaml"
    path.write_text(yaml.safe_dump({"kind": "reeval"} | keys))
    return path


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["--set", "runs=nowhere"], "runs: nowhere is not a run"),
        (["--set", "runs=nowhere/*"], "runs: nothing matches nowhere/*"),
        (["--set", "runs=[]"], "runs: "),
        (["--set", "protocols=crnerf-full"], "crnerf-full@R4"),
        (["--set", "protocols=[crnerf-ful@R2]"], "'crnerf-ful' is not known"),
        (["--set", "every=soon"], "every: 'soon' is not a time; write 45s, 30m, 2h or 1d"),
        (["--set", "every=30"], "every: "),
        (["--set", "evry=30m"], "evry: there is no such key; did you mean 'every'?"),
        (["--set", "gpus=2"], "gpus: "),
        (["--launcher", "torchrun"], "launcher: "),
    ],
)
def test_the_command_refuses_wrong_input_with_one_message(crossray, run, tmp_path, words, part):
    status, text = crossray("run", job_file(tmp_path, runs=str(run)), *words)
    assert status == 2, text
    assert part in text
    assert "Traceback" not in text
    assert not (run / "eval").exists()


def test_the_command_says_what_it_did_and_ends_with_status_1_if_something_failed(crossray, run, tmp_path):
    file = job_file(tmp_path, runs=[str(run)], launcher="local")
    status, text = crossray("run", file)
    assert status == 0, text
    assert "3 evaluated, 0 there already, 0 skipped, 0 failed" in text
    status, text = crossray("run", file, "--set", "protocols=[crnerf-full@R2, crnerf-full@R4]")
    assert status == 0, text
    assert "0 evaluated, 3 there already, 1 skipped, 0 failed" in text
    assert re.search(r"skipped: .*crnerf-full@R4", text)
    metrics(run, 2).unlink()
    job = yaml.safe_load((run / "job.yaml").read_text())
    job["scene"]["shards"] = str(tmp_path / "nowhere")
    (run / "job.yaml").write_text(yaml.safe_dump(job))
    status, text = crossray("run", file)
    assert status == 1, text
    assert re.search(r"failed: .*nowhere", text)


# Several processes, and what ends them


GATED = """
import os, pathlib, sys, time
from pipeline import cli, reeval

gate = pathlib.Path(sys.argv.pop(1))
score_views = reeval.score_views

def gated(task):
    (gate / f"{task.step}-{task.photos[0]}-{os.getpid()}-{time.monotonic_ns()}").touch()
    while not (gate / f"open-{task.step}").exists():
        time.sleep(0.02)
    return score_views(task)

reeval.score_views = gated
cli.main()
"""


class Process:
    """`crossray run reeval.yaml` as a process that scores a view of step N only once the file `open-N` is there."""

    def __init__(self, folder: Path, run: Path, *words: str) -> None:
        self.gate = folder / "gate"
        self.gate.mkdir(exist_ok=True)
        self.output = folder / f"output-{len(list(folder.glob('output-*')))}"
        command = [sys.executable, "-c", GATED, str(self.gate), "run", str(job_file(folder, runs=str(run))), *words]
        with self.output.open("wb") as output:
            self.process = subprocess.Popen(command, cwd=ROOT, stdout=output, stderr=subprocess.STDOUT)

    def open(self, *steps: int) -> None:
        for step in steps:
            (self.gate / f"open-{step}").touch()

    def work(self) -> list[tuple[int, int, int]]:
        """(step, photo, process) of every view that was begun."""
        names = sorted(path.name for path in self.gate.iterdir() if not path.name.startswith("open"))
        return [tuple(map(int, name.split("-")[:3])) for name in names]

    def text(self) -> str:
        return re.sub(r"\s+", " ", self.output.read_text())

    def until(self, condition) -> None:
        deadline = time.monotonic() + PATIENCE
        while not condition():
            assert self.process.poll() is None, f"the process has ended: {self.text()}"
            assert time.monotonic() < deadline, f"it never came: {self.text()}"
            time.sleep(0.02)

    def end(self) -> int:
        try:
            return self.process.wait(PATIENCE)
        finally:
            if self.process.poll() is None:
                self.process.kill()
                self.process.wait()


@pytest.fixture
def process(tmp_path, run):
    """process(*words): started, and ended with the test."""
    started = []

    def start(*words: str) -> Process:
        started.append(Process(tmp_path, run, *words))
        return started[-1]

    yield start
    for one in started:
        if one.process.poll() is None:
            one.process.kill()
            one.process.wait()


@pytest.mark.slow
def test_two_passes_at_once_do_nothing_twice(run, process):
    passes = [process(), process()]
    passes[0].until(lambda: len({pid for _, _, pid in passes[0].work()}) == 2)  # both are at a checkpoint
    assert len({step for step, _, _ in passes[0].work()}) == 2  # each at its own
    passes[0].open(*STEPS)
    assert [one.end() for one in passes] == [0, 0], [one.text() for one in passes]
    assert sorted((step, photo) for step, photo, _ in passes[0].work()) == [(s, p) for s in STEPS for p in (1, 3, 5)]
    counted = [tuple(map(int, re.findall(r"(\d+) (?:evaluated|there|under way)", one.text()))) for one in passes]
    assert sum(numbers[0] for numbers in counted) == 3
    assert all(sum(numbers) == 3 for numbers in counted), counted
    assert len(list((run / "tensorboard" / "eval").iterdir())) == 3
    assert counts(pass_over(run)) == (0, 3, 0, 0, 0)


@pytest.mark.slow
def test_after_kill_9_in_the_middle_the_next_pass_goes_on(run, process):
    one = process()
    one.open(2)
    one.until(lambda: any(step == 4 for step, _, _ in one.work()))
    one.process.kill()
    assert one.end() == -signal.SIGKILL
    assert [metrics(run, step).exists() for step in STEPS] == [True, False, False]
    done = metrics(run, 2).stat().st_ino
    stray = metrics(run, 4).parent / ".photo.png.123.tmp"
    stray.parent.mkdir(parents=True, exist_ok=True)
    stray.write_bytes(b"half")
    assert counts(pass_over(run)) == (2, 1, 0, 0, 0)
    assert metrics(run, 2).stat().st_ino == done
    assert not stray.exists()


@pytest.mark.slow
def test_a_schedule_finds_what_comes_later_and_stops_cleanly_in_the_middle_of_a_pass(run, process, tmp_path):
    later = {step: shutil.move(run / "checkpoints" / name_of(step), tmp_path / name_of(step)) for step in (4, 6)}
    one = process("--set", "every=1s")
    one.open(2, 4)
    one.until(metrics(run, 2).exists)
    one.until(lambda: "0 evaluated, 1 there already" in one.text())
    shutil.move(later[4], run / "checkpoints")
    one.until(metrics(run, 4).exists)
    written = {step: metrics(run, step).stat().st_ino for step in (2, 4)}
    shutil.move(later[6], run / "checkpoints")
    one.until(lambda: any(step == 6 for step, _, _ in one.work()))
    with pytest.raises(module.Timeout):
        lock_of(run, name_of(6)).acquire(blocking=False)
    one.process.terminate()
    assert one.end() == 0, one.text()
    assert "Traceback" not in one.text()
    assert "stopped; nothing is half-written" in one.text()
    assert not metrics(run, 6).exists()
    assert not list(run.rglob("*.tmp"))
    with lock_of(run, name_of(6)).acquire(blocking=False):
        pass
    assert {step: metrics(run, step).stat().st_ino for step in (2, 4)} == written


@pytest.mark.slow
def test_a_schedule_that_waits_stops_at_once_and_a_single_pass_that_is_stopped_is_not_called_done(run, process):
    one = process("--set", "every=1d")
    one.open(*STEPS)
    one.until(lambda: "the next pass comes 1d after" in one.text())
    one.process.send_signal(signal.SIGINT)
    assert one.end() == 0, one.text()
    metrics(run, 4).unlink()
    (one.gate / "open-4").unlink()
    begun = len(one.work())
    two = process()
    two.until(lambda: len(two.work()) > begun)
    two.process.terminate()
    assert two.end() == 130, two.text()
    assert "Traceback" not in two.text()


def test_an_error_ends_a_pass_and_not_the_schedule_and_a_long_pass_is_followed_at_once(monkeypatch, caplog):
    from pipeline.launch import reeval as launch

    slept, passes = [], []

    def sleep(seconds):
        slept.append(seconds)
        if len(slept) == 3:
            raise KeyboardInterrupt

    clock = iter([0.0, 1.0, 10.0, 25.0, 25.0, 26.0])  # a second, fifteen, and another one
    monkeypatch.setattr(launch.time, "monotonic", lambda: next(clock))
    monkeypatch.setattr(launch.time, "sleep", sleep)

    def fails_first(reeval, mapper):
        passes.append(reeval)
        if len(passes) == 1:
            raise OSError("the disk is away")
        return module.Summary(skipped=["runs/a: no checkpoint"])

    monkeypatch.setattr(launch, "one_pass", fails_first)
    monkeypatch.setattr(logging.getLogger("crossray"), "propagate", True)
    with caplog.at_level(logging.INFO, logger="crossray"), pytest.raises(KeyboardInterrupt):
        keep_passing(ReevalJob(runs=("runs/*",), every="10s"), in_process, 10.0)
    assert slept == [9.0, 0.0, 9.0]
    assert "the disk is away" in caplog.text
    assert caplog.text.count("runs/a: no checkpoint") == 1  # said once


# Ray


def test_what_an_evaluation_asks_ray_for(trained):
    job = tiny_job(trained, over={"device": "auto", "threads": 2, "evaluate": {"gpus": 0.5}})
    assert needs_of_evaluation(job, None, 4) == {"num_cpus": 0, "num_gpus": 0.5}
    assert needs_of_evaluation(job, 0.1, 1) == {"num_cpus": 0, "num_gpus": 0.1}
    assert needs_of_evaluation(job, None, 0) == {"num_cpus": 2}
    assert needs_of_evaluation(job.model_copy(update={"device": "cpu"}), None, 4) == {"num_cpus": 2}


def hold(seconds):
    time.sleep(seconds)


@pytest.mark.slow
def test_on_ray_the_numbers_are_the_same_and_training_may_have_its_checkpoints_evaluated(run, tmp_path, monkeypatch):
    import ray

    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))  # workers import this module by name
    expected = {step: evaluate_run(run, HALF, step)["images"] for step in STEPS}
    shutil.rmtree(run / "eval")
    away = shutil.move(run / "checkpoints" / name_of(6), tmp_path / name_of(6))
    job = evaluate_module.job_of(run)
    with ray_session(num_cpus=2):
        beside = EachCheckpoint(job)
        beside.start()
        deadline = time.monotonic() + PATIENCE
        while not metrics(run, 4).exists():
            assert time.monotonic() < deadline
            assert beside.is_alive()
            time.sleep(0.1)
        shutil.move(away, run / "checkpoints")
        while not metrics(run, 6).exists():
            assert time.monotonic() < deadline
            time.sleep(0.1)
        beside.stop()
        assert not beside.is_alive()
        shutil.rmtree(run / "eval")
        held = ray.remote(num_cpus=2)(hold).remote(PATIENCE)  # the ranks leave nothing free
        waiting = EachCheckpoint(job)
        waiting.start()
        while not waiting.tried:
            assert time.monotonic() < deadline
            time.sleep(0.1)
        waiting.stop()
        assert not waiting.is_alive()
        ray.cancel(held, force=True)
        assert not list(run.rglob("metrics.json"))
        with evaluation_tasks(died=module.lost) as mapper:
            reeval = ReevalJob(runs=(str(run),), protocols=(FULL, HALF))
            assert counts(one_pass(reeval, mapper)) == (6, 0, 0, 0, 0)
    for step in STEPS:
        result = recorded(run, HALF, checkpoint_of(run, step))
        assert result is not None
        assert result["images"] == expected[step]
