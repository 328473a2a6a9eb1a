"""Every stage that writes, as real processes: stopped in the middle, on a full disk, on one that is read-only."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from real_runs import PATIENCE, ROOT
from test_faults import fill
from tiny_run import cut_tiny, tiny_job

from pipeline.config import save_job
from pipeline.train import train
from pipeline.work import Context

pytestmark = pytest.mark.slow

SMALL_TIMING = (
    "seconds=0.01",
    "width=64",
    "height=48",
    "device=cpu",
    "cost=[]",
    "inference.methods=[crossray]",
    "inference.samples=[trained]",
    "inference.images=2",
    "inference.appearances=[1]",
)


@dataclass(frozen=True)
class Stage:
    """A command that writes into the folder `out`, and where in the middle of it to stop."""

    words: tuple[str, ...]
    middle: str  # module:name of a function that it calls there
    out: str
    ray: bool = False  # its tasks are Ray's


STAGES = {
    "landmark": Stage(
        ("landmark", "out/scene", "--train", "8", "--val", "1", "--test", "1", "--size", "32"),
        "pipeline.progress:Progress.update",
        "out/scene",
        ray=True,
    ),
    "shard": Stage(("shard", "scene", "--out", "out/shards"), "pipeline.progress:Progress.update", "out/shards", True),
    "mask": Stage(
        ("mask", "out/scene", "--with", "folder:given"), "pipeline.progress:Progress.update", "out/scene/masks", True
    ),
    "evaluate": Stage(
        ("evaluate", "out/runs/tiny", "--protocol", "crnerf-full@R2"), "pipeline.judge:score", "out/runs/tiny/eval"
    ),
    "bake": Stage(
        ("bake", "out/runs/tiny", "--appearance", "photo_001.jpg"), "pipeline.bake:render_baked", "out/runs/tiny/baked"
    ),
    "render": Stage(
        ("render", "out/runs/tiny", "--out", "out/film", "--frames", "3", "--size", "24"),
        "pipeline.film:shown",
        "out/film",
    ),
    "export": Stage(
        ("export", "out/runs/tiny", "--out", "out/exported", "--points", "100"),
        "pipeline.exporting.shown:surface",
        "out/exported",
    ),
    "figure": Stage(
        ("figure", "depth", "out/runs/tiny", "--out", "out/figures"), "pipeline.figures.make:saved", "out/figures"
    ),
    "report": Stage(("report", "out/runs/tiny"), "pipeline.report.run:write_page", "out/runs/tiny/report.html"),
    "tables": Stage(("tables", "--out", "out/tables"), "pipeline.results:read_results", "out/tables"),
    "timing": Stage(
        ("timing", "inference", *(w for s in ("runs=out/runs", *SMALL_TIMING) for w in ("--set", s))),
        "pipeline.timing_measure:Meter.once",
        "out/runs/timing-inference",
    ),
}


# `landmark` and `mask` hand their tasks to Ray as `shard` does; Ray's starts are most of what they take. `timing` takes
# the longest by itself, and writes as the others do.
WITH_CLUSTERS = ("landmark", "mask", "timing")
EACH = [pytest.param(name, marks=pytest.mark.cluster if name in WITH_CLUSTERS else ()) for name in STAGES]


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A scene without masks, masks for it, and a trained run."""
    folder = cut_tiny(tmp_path_factory.mktemp("stages"))
    job = tiny_job(folder)
    save_job(job, job.run / "job.yaml")
    train(job, Context())
    (folder / "scene" / "masks").rename(folder / "given")
    return folder


@pytest.fixture
def place(made, tmp_path) -> Path:
    """A working directory: what stages read, and `out`, into which they write."""
    fill_place(made, tmp_path / "place", tmp_path / "place" / "out")
    return tmp_path / "place"


def fill_place(made: Path, place: Path, out: Path) -> None:
    for name in ("scene", "given"):
        shutil.copytree(made / name, place / name)
    shutil.copytree(made / "scene", out / "scene-for-masks")
    shutil.copytree(made / "runs", out / "runs")


def ready(stage: Stage, place: Path) -> None:
    """What the stage finds."""
    if stage.words[0] == "mask" and not (place / "out" / "scene").exists():
        (place / "out" / "scene-for-masks").rename(place / "out" / "scene")


def start(place: Path, *words: str) -> subprocess.Popen:
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "COLUMNS": "500"}
    environment["CROSSRAY_CACHE"] = str(place.parent / "cache")
    for name in ("RANK", "RAY_ADDRESS"):
        environment.pop(name, None)
    return subprocess.Popen(
        [sys.executable, *words],
        cwd=place,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )


def run(place: Path, stage: Stage) -> tuple[int, str]:
    process = start(place, "-m", "pipeline", *stage.words)
    text, _ = process.communicate(timeout=PATIENCE)
    return process.returncode, text


def content(path: Path) -> dict[str, object]:
    """What is in a folder, or a file; of records only what does not tell when and how fast."""
    files = [p for p in path.rglob("*") if p.is_file()] if path.is_dir() else [path]
    return {str(p.relative_to(path)): essence(p) for p in files if not p.name.startswith(".")}


def essence(path: Path) -> object:
    if path.suffix in (".html", ".md") or path.name == "timing.json":
        return None  # they tell the moment
    if path.name == "metrics.json":
        return [{k: row[k] for k in ("name", "psnr", "ssim")} for row in json.loads(path.read_text())["images"]]
    if path.name in ("baked.json", "export.json", "depth.json"):
        return {k: v for k, v in json.loads(path.read_text()).items() if k not in ("provenance", "digest")}
    return path.read_bytes()


@pytest.fixture(scope="module")
def undisturbed(made, tmp_path_factory):
    """undisturbed(name): what the stage gives when nothing happens."""
    known: dict[str, dict] = {}

    def of(name: str) -> dict:
        if name not in known:
            place = tmp_path_factory.mktemp("undisturbed") / "place"
            fill_place(made, place, place / "out")
            ready(STAGES[name], place)
            status, text = run(place, STAGES[name])
            assert status == 0, text
            known[name] = content(place / STAGES[name].out)
        return known[name]

    return of


@pytest.mark.parametrize("name", EACH)
def test_a_stopped_stage_says_so_and_the_next_run_goes_on(place, undisturbed, name):
    stage = STAGES[name]
    ready(stage, place)
    for target, number in (("pipeline.files:os.fsync", signal.SIGTERM), (stage.middle, signal.SIGINT)):
        here = place.parent / target
        process = start(place, str(Path(__file__).with_name("waiting.py")), str(here), target, *stage.words)
        until(here, process)
        if number == signal.SIGINT:
            os.killpg(process.pid, number)  # as from a terminal, to all that it started
        else:
            process.send_signal(number)
        text, _ = process.communicate(timeout=PATIENCE)
        assert process.returncode == 130, text
        assert text.count("stopping (") == 1, text
        assert "Traceback" not in text, text
        if not stage.ray:
            assert not list(place.rglob(".*.tmp")), text
    status, text = run(place, stage)
    assert status == 0, text
    assert content(place / stage.out) == undisturbed(name)
    assert not list(place.rglob(".*.tmp"))


def until(here: Path, process: subprocess.Popen) -> None:
    """Wait until the process waits."""
    while not here.exists():
        try:
            text, _ = process.communicate(timeout=0.05)
        except subprocess.TimeoutExpired:
            continue
        pytest.fail(f"ended too early:\n{text}")


@pytest.fixture
def small_place(made, tmp_path) -> Iterator[Path]:
    """As `place`, with `out` a disk of its own, of 8 MiB."""
    place = tmp_path / "place"
    (place / "out").mkdir(parents=True)
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", place / "out"], capture_output=True, text=True, check=False
    )
    if mounted.returncode != 0:
        pytest.skip(f"a small disk cannot be mounted here: {mounted.stderr.strip()}")
    fill_place(made, place, place / "out")
    yield place
    subprocess.run(["umount", "--lazy", place / "out"], check=True)


@pytest.mark.parametrize("name", EACH)
def test_a_disk_that_takes_nothing_is_one_message_and_loses_nothing(small_place, name):
    stage, out = STAGES[name], small_place / "out"
    ready(stage, small_place)
    before = content(out)
    for disk, words in (("read-only", "Read-only file system"), ("full", "No space left")):
        if disk == "read-only":
            subprocess.run(["mount", "-o", "remount,ro", out], check=True)
        else:
            fill(out / "filler")
        status, text = run(small_place, stage)
        assert status == 2, text
        assert "Traceback" not in text, text
        assert text.count("crossray:") == 1, text
        assert words in text, text
        assert "out" in text.partition("crossray:")[2], text
        if disk == "read-only":
            subprocess.run(["mount", "-o", "remount,rw", out], check=True)
        else:
            (out / "filler").unlink()
        assert not list(out.rglob(".*.tmp"))
        after = content(out)
        assert {k: after[k] for k in before} == before
