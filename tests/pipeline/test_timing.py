"""The timing harness: its arithmetic by hand with a clock that the test sets, its rows at tiny sizes, its job file, and
the command line. How long anything takes is not asserted anywhere."""

from __future__ import annotations

import json
import logging
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml

from model.fields.base import Codes, Rays, render_points
from model.methods import METHODS
from pipeline import cli
from pipeline.config import JobError
from pipeline.errors import CrossrayError
from pipeline.launch import submit
from pipeline.render import view_rays
from pipeline.timing import TimingRow, read_timing, write_timing
from pipeline.timing_inference import (
    Parts,
    TimedRays,
    chunk_of,
    inference_rows,
    look,
    settings,
    time_rays,
)
from pipeline.timing_job import (
    InferenceTiming,
    TimingJob,
    TrainingTiming,
    load_timing,
    make_timing,
    threads_of,
    training_job,
    with_precision,
)
from pipeline.timing_measure import Meter, PeakMemory, Seconds, counted_flops, peak_flops, resident, summarised
from pipeline.timing_scene import camera, synthetic_photos, untrained
from pipeline.timing_table import tables
from pipeline.timing_training import Steps, note_of, precisions, schedule
from pipeline.train import uses_bfloat16
from pipeline.work import Context

ROOT = Path(__file__).resolve().parents[2]
CPU = torch.device("cpu")
TINY = {
    "width": 32,
    "height": 32,
    "reference_downscale": 2,
    "seconds": 0.001,
    "threads": 1,
    "device": "cpu",
    "precision": ["float32"],
    "inference": {"downscales": [8, 4], "images": 4, "appearances": [1, 4], "pixels": [8]},
    "training": {"methods": ["crossray"], "rays": 64, "photos": 3, "cost_rays": [36], "cost_photos": [2]},
}


class Hours:
    """A clock that stands still until somebody works; device work that ends at once."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now

    def meter(self, seconds: float, **others) -> Meter:
        return Meter(CPU, seconds, clock=self, **others)

    def work(self, *seconds: float):
        """An action that takes these seconds, one after the other, the last one from then on."""
        left = list(seconds)

        def action() -> None:
            self.now += left.pop(0) if len(left) > 1 else left[0]

        return action


@pytest.fixture(autouse=True)
def _small_peak(monkeypatch):
    monkeypatch.setitem(sys.modules["pipeline.timing_measure"].PRODUCT, "cpu", 32)


def tiny(**over) -> TimingJob:
    return make_timing({**TINY, **over})


def rays_of(count: int) -> Rays:
    return Rays(*(torch.zeros(count, 3) for _ in range(2)), *(torch.zeros(count) for _ in range(2)))


# Arithmetic


def test_median_and_quartiles():
    assert summarised([4.0, 1.0, 3.0, 2.0, 5.0], None) == Seconds(3.0, 2.0, 4.0, 5, None)
    assert summarised([7.0], 2.5) == Seconds(7.0, 7.0, 7.0, 1, 2.5)


def test_times_and_plus():
    once, each = Seconds(10.0, 8.0, 13.0, 5, 100.0), Seconds(0.5, 0.4, 0.6, 9, 30.0)
    assert each.times(4) == Seconds(2.0, 1.6, 2.4, 9, 30.0)
    assert once.plus(each) == Seconds(10.5, 8.4, 13.6, 5, 100.0)
    assert Seconds(1, 1, 1, 3, None).plus(each).memory == 30.0


@pytest.mark.parametrize(("count", "seconds"), [(1, 10.5), (2, 5.5), (64, (10 + 32) / 64)])
def test_an_image_of_many_is_the_view_once_and_each_look(count, seconds):
    parts = Parts(Seconds(10, 10, 10, 3), Seconds(0.5, 0.5, 0.5, 3), "recoloured", None, 1.0, None, None)
    assert parts.image(count).median == pytest.approx(seconds)


def test_the_first_go_does_not_count():
    hours = Hours()
    found = hours.meter(12).measure(hours.work(100.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0))
    assert found.repeats == 6  # 12 s are enough for 6 goes of the 2 s that the first warm one took
    assert (found.median, found.low, found.high) == (4.5, 3.25, 5.75)


def test_three_repeats_however_long_they_take():
    hours = Hours()
    assert hours.meter(1).measure(hours.work(50.0))[:4] == (50, 50, 50, 3)
    assert hours.now == 200


def test_a_clock_that_does_not_move_ends():
    assert Hours().meter(1).measure(lambda: None).repeats == 1000


def test_ranks_take_as_many_repeats_as_they_agree_on():
    hours = Hours()
    assert hours.meter(100, agree=lambda repeats: repeats // 10).measure(hours.work(1.0)).repeats == 10


class TestRays:
    """10 rays a chunk, a second a ray."""

    def timed(self, seconds: float, rays: int, chunk: int = 10) -> tuple[TimedRays, list[int]]:
        hours, seen = Hours(), []

        def work(some: Rays) -> None:
            seen.append(len(some.near))
            hours.now += len(some.near)

        return time_rays(hours.meter(seconds), rays_of(rays), chunk, work), seen

    def test_a_view_that_fits_is_measured_whole(self):
        found, seen = self.timed(seconds=1000, rays=35)
        assert (found.rays, found.seconds.median) == (35, 35)
        assert seen[:2] == [10, 10]
        assert set(seen[2:]) == {35}
        assert found.sentence(35) is None

    def test_of_a_longer_one_whole_chunks_are(self):
        found, seen = self.timed(seconds=80, rays=1234)  # three goes of 20 rays take 60 s, of 30 rays 90 s
        assert found.rays == 20
        assert seen == [10, 10, 20, 20, 20, 20]
        assert found.of(1234).median == 1234
        assert found.sentence(1234) == "from 20 of its 1,234 rays"

    def test_one_chunk_in_any_case(self):
        found, seen = self.timed(seconds=0.001, rays=1234)
        assert seen == [10, 10, 10, 10]  # warm, and three that count
        assert (found.rays, found.seconds.repeats) == (10, 3)

    def test_a_view_smaller_than_a_chunk(self):
        found, seen = self.timed(seconds=0.001, rays=7)
        assert (found.rays, set(seen)) == (7, {7})


def test_minutes_of_the_schedule():
    job = training_job(make_timing({}), "crnerf")
    found = schedule(job, Seconds(0.3, 0.2, 0.4, 7), block=10)
    assert found["minutes"] == pytest.approx(20 * 17200 * 0.3 / 60)  # 1720
    assert found["extrapolated"] == "20 x 17,200 steps, from the median of 70 measured ones"


def test_share_of_the_peak():
    values = row().model_dump() | {"seconds": 2.0, "flops": 6e9, "peak_flops": 1e10}
    assert TimingRow(**values).of_peak == pytest.approx(0.3)
    assert row().of_peak is None


def test_operations_are_counted_and_the_peak_is_measured():
    a, b = torch.zeros(3, 5), torch.zeros(5, 7)
    assert counted_flops(lambda: a @ b) == 2 * 3 * 5 * 7
    hours = Hours()
    ticking = Meter(CPU, 1.0, clock=lambda: hours.work(0.25)() or hours.now)  # 0.25 s from look to look
    assert peak_flops(ticking, "float32", side=8) == 2 * 8**3 / 0.25


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="only Linux tells a process its peak")
def test_peak_memory_is_what_the_process_grew_by():
    small = [torch.ones(2**12) for _ in range(2**12)]  # 64 MiB in blocks that the allocator keeps when they are freed
    del small
    memory = PeakMemory(CPU)
    if memory.before is None:
        pytest.skip("this system does not forget a peak")
    small = [torch.ones(2**12) for _ in range(2**12)]
    del small
    peak = memory.peak()
    assert peak is not None
    assert 60 < peak < 200
    assert resident("VmHWM") >= resident("VmRSS")


# The synthetic scene


def test_photos_have_the_sizes_of_the_paper():
    timing = make_timing({})
    assert timing.size(2) == (372, 496)
    assert timing.size(4) == (186, 248)
    assert pytest.approx(17200 * 8 * 1024 / 763, rel=1e-3) == 496 * 372
    photos = synthetic_photos(timing, 70)
    assert len(photos.indices("train")) == 70
    assert photos.image(0).shape == (372, 496, 3)
    assert photos.reference(69).shape == (93, 124, 3)
    assert (photos.image(0) == photos.image(64)).all()
    assert (photos.image(0) != photos.image(1)).any()


def test_what_is_rendered_in_two_parts_is_what_is_rendered_at_once():
    """`placed once` is timed as placing and looking: together they give the picture of `SceneModel.render`."""
    setting = next(settings(tiny(inference={"methods": ["hanerf"]}), "hanerf", CPU))
    model, code = setting.model, torch.randn(1, 48)
    rays = view_rays(camera(0, 4, 4), 0.0, CPU)
    with torch.no_grad():
        seen = look(model, model.field.place(rays, samples=(8, 8)), code)
        whole = model.render(rays, samples=(8, 8), code=code).features
    assert seen.dtype == torch.uint8
    assert (seen - whole.clamp(0, 1).mul(255)).abs().max() <= 0.5 + 1e-3


def test_chunks_are_those_of_rendering():
    timing = tiny()
    for setting in settings(timing, "crnerf", CPU):
        assert chunk_of(setting) == render_points(torch.device("cpu")) // sum(setting.samples)
    assert [s.samples for s in settings(timing, "crnerf", CPU)] == [(64, 64), (256, 256)]
    assert [s.samples for s in settings(timing, "crossray", CPU)] == [(32, 16)]  # it has its own, and only those


def test_the_field_reads_codes_where_it_is_timed_with_them():
    for name in METHODS:
        model = untrained(training_job(make_timing({}), name), CPU, False)
        assert model.coded == (METHODS[name].appearance in ("embedding", "code"))
        assert not any(p.requires_grad for p in model.parameters())
        if model.coded:
            with pytest.raises((ValueError, RuntimeError, AssertionError)):
                model.field.march(view_rays(camera(0, 2, 2), 0.0, CPU), codes=Codes())


# Rows


@pytest.fixture(scope="module")
def images() -> list[TimingRow]:
    timing = tiny(inference=TINY["inference"] | {"methods": ["hanerf", "crossray"], "samples": ["trained"]})
    return inference_rows(timing, Meter(CPU, timing.seconds), lambda precision: 1e9)


def cell(rows: list[TimingRow], method: str, count: int) -> TimingRow:
    """Of the paper's table, at R/8."""
    return next(r for r in rows if (r.table, r.method, r.appearances, r.downscale) == ("inference", method, count, 8))


@pytest.mark.slow
class TestRows:
    def test_every_cell_of_the_papers_table(self, images):
        cells = {(r.method, r.appearances, r.downscale) for r in images if r.table == "inference"}
        assert cells == {(m, n, d) for m in ("hanerf", "crossray") for n in (1, 4) for d in (8, 4)}

    def test_a_row_says_what_it_depends_on(self, images):
        row = next(
            r for r in images if (r.table, r.method, r.appearances, r.downscale) == ("inference", "hanerf", 4, 8)
        )
        assert (row.width, row.height, row.unit, row.how) == (4, 4, "image", "placed once")
        assert (row.samples, row.samples_as, row.field) == ((64, 64), "trained", "mlp")
        assert (row.precision, row.threads, row.ranks, row.memory_of) == ("float32", 1, 1, "host")
        assert row.low <= row.seconds <= row.high
        assert row.repeats >= 3
        assert min(row.once_seconds, row.each_seconds, row.encode_seconds) > 0
        assert row.seconds == pytest.approx((row.once_seconds + 4 * row.each_seconds) / 4)
        assert row.extrapolated == "2 of the 4 images were made"
        assert cell(images, "hanerf", 1).extrapolated is None

    def test_what_was_seen_of_one_chunk_alone_is_said(self):
        one = TimedRays(Seconds(1.0, 1.0, 1.0, 3), 10, 40)
        parts = Parts(one.of(40), one.of(40), "placed once", None, 0.0, None, one.sentence(40))
        assert parts.extrapolated(1) == "an image more from 10 of its 40 rays"
        assert parts.image(1).median == 8

    def test_a_single_image_has_its_operations(self, images):
        row = cell(images, "hanerf", 1)
        layers = 93 * 256 + 3 * 256 * 256 + (256 + 93) * 256 + 3 * 256 * 256 + 256 * 257
        point = layers + 256 * 128 + 128 * 3
        seen = 27 * 128 + (27 + 48) * 128  # direction and code, once a ray for each network
        composited = 128 * 3
        assert row.flops == 2 * 16 * ((64 + 128) * point + seen + composited)
        assert row.how == "rendered"
        assert row.peak_flops == 1e9

    def test_images_a_second(self, images):
        rows = [r for r in images if r.table == "appearances" and r.method == "crossray"]
        assert [(r.appearances, r.how, r.downscale) for r in rows] == [(1, "rendered", 8), (4, "recoloured", 8)]

    def test_cost_of_pixels(self, images):
        rows = [r for r in images if r.table == "cost"]
        assert [(r.method, r.varied, r.width, r.height) for r in rows] == [("crossray", "pixels", 4, 4)]

    def test_tables_print(self, images):
        from rich.console import Console

        console = Console(width=300, record=True, file=open(os.devnull, "w"))  # noqa: PTH123, SIM115
        for table in tables([*images, row(), row(table="cost", varied="rays", minutes=None, extrapolated=None)]):
            console.print(table)
        text = console.export_text()
        for words in ("a single image, R/8", "4 images, R/4", "Images a second", "~1,720", "against", "placed once"):
            assert words in text


@pytest.mark.slow
def test_a_smaller_view_is_not_timed_again_where_less_of_the_larger_was(monkeypatch):
    calls = []
    inference = sys.modules["pipeline.timing_inference"]

    def timed(meter, setting, rays, reference):
        calls.append(len(rays.near))
        return inference.Timed(TimedRays(Seconds(1.0, 1.0, 1.0, 3), 10, len(rays.near)), None, 0.0, None)

    monkeypatch.setattr(inference, "time_features", timed)
    timing = tiny()
    setting = next(settings(timing, "crossray", CPU))
    found = dict(inference.views(timing, Meter(CPU, 0.001), setting, (8, 4)))
    assert calls == [64]
    assert found[4].extrapolated(1) == "the view from 10 of its 64 rays"
    assert found[8].extrapolated(1) == "the view from 10 rays of a larger view"
    assert found[8].extrapolated(64) == "the view from 10 rays of a larger view; 2 of the 64 images were made"
    assert found[4].flops == 0
    calls.clear()
    dict(inference.views(timing, Meter(CPU, 0.001), setting, (16, 8)))
    assert calls == [16, 4]  # 10 rays are more than the smaller view has


@pytest.mark.slow
def test_a_method_of_one_appearance_has_a_single_image():
    timing = tiny(inference={"methods": ["nerf"], "images": 1, "appearances": [1], "downscales": [16], "pixels": []})
    rows = inference_rows(timing, Meter(CPU, 0.001), lambda precision: 1.0)
    assert {(r.table, r.appearances, r.each_seconds, r.encode_seconds) for r in rows} >= {("inference", 1, None, None)}


def test_steps_learn_as_the_training_does():
    job = with_precision(training_job(tiny(), "crossray"), "float32")
    steps = Steps(job, synthetic_photos(tiny(), 3), Context())
    before = {name: p.clone() for name, p in steps.model.named_parameters()}
    assert steps.flops() > 0
    assert all(torch.equal(before[name], p) for name, p in steps.model.named_parameters())
    steps.run(2)
    assert steps.clock.step == 2
    assert [len(rows) for rows in (steps.record.seen, steps.record.fresh)] == [2, 0]
    assert any(not torch.equal(before[name], p) for name, p in steps.model.named_parameters())


def test_the_note_says_what_is_not_the_papers():
    assert note_of(training_job(make_timing({}), "crnerf")) is None
    note = note_of(training_job(make_timing({}), "crossray"))
    assert note is not None
    assert note.startswith("4 patches of 16 x 16 rays a step")


def test_precisions():
    timing = make_timing({})
    for name in ("crnerf", "crossray"):
        pays = uses_bfloat16(with_precision(training_job(timing, name), "auto"), CPU)
        expected = ("float32", "bfloat16") if pays else ("float32",)
        assert precisions(timing, training_job(timing, name), CPU) == expected
    assert precisions(tiny(precision=["bfloat16"]), training_job(timing, "crossray"), CPU) == ("bfloat16",)


# timing.json


def row(**over) -> TimingRow:
    return TimingRow(
        **{
            "table": "training",
            "method": "crnerf",
            "field": "mlp",
            "how": "trained",
            "samples": (64, 64),
            "samples_as": "trained",
            "unit": "step",
            "seconds": 0.3,
            "low": 0.2,
            "high": 0.4,
            "repeats": 5,
            "minutes": 1720.0,
            "extrapolated": "20 x 17,200 steps, from the median of 5 measured ones",
            "peak_memory_MiB": None,
            "memory_of": "host",
            "rays": 1024,
            "threads": 1,
            "precision": "float32",
            "device": "a processor",
        }
        | over
    )


def test_what_is_written_is_read(tmp_path):
    path = write_timing(tmp_path / "timing", [row()], {"name": "timing"}, {"command": "x"})
    found = read_timing(path)
    assert found.rows == (row(),)
    assert json.loads(path.read_text())["format"] == 1
    assert (found.job, found.provenance) == ({"name": "timing"}, {"command": "x"})


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "is not a timing"),
        ('{"format": 2, "rows": [], "provenance": {}}', "format"),
        ('{"rows": [{"table": "speed"}], "provenance": {}}', "rows.0.table"),
        ('{"rows": []}', "provenance"),
    ],
)
def test_a_damaged_record_is_refused(tmp_path, text, words):
    (tmp_path / "timing.json").write_text(text)
    with pytest.raises(CrossrayError, match=words):
        read_timing(tmp_path / "timing.json")
    with pytest.raises(CrossrayError, match="cannot be read"):
        read_timing(tmp_path / "absent.json")


# The job


def test_the_job_file_holds_the_defaults():
    path = ROOT / "jobs" / "timing.yaml"
    assert load_timing(path) == make_timing({})
    text = path.read_text()
    described = (set(section.model_fields) for section in (TimingJob, InferenceTiming, TrainingTiming))
    for key in set().union(*described) - {"runs"}:
        assert re.search(rf"^ *{key}:", text, re.MULTILINE), key


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("secons=1", "secons: there is no such key; did you mean 'seconds'?"),
        ("inference.apearances=[1]", "inference.apearances: there is no such key; did you mean 'appearances'?"),
        ("training.rnaks=2", "training.rnaks: there is no such key; did you mean 'ranks'?"),
        ("inference.methods=[hanref]", "inference.methods: 'hanref' is not known; did you mean 'hanerf'?"),
        ("training.methods=[crnref]", "training.methods: 'crnref' is not known; did you mean 'crnerf'?"),
        ("cost=[fast]", "cost: 'fast' is not known"),
        ("inference.methods=[nerf]", "inference.methods: nerf has one appearance, so there are no 64 images"),
        (
            "training.rays=1000",
            "training.rays: 1000 rays are not one square patch, which the recipe of nerfw takes; 1024 are",
        ),
        ("training.cost_rays=[402]", "training.cost_rays: 402 rays are not 4 square patches"),
        ("training.rays=64", "training.rays: 64 rays of hanerf: "),
        ("reference_downscale=100", "reference_downscale: 100 makes photos of 992 x 744 9 x 7 pixels"),
        ("inference.downscales=[1000]", "inference.downscales: 1000 leaves nothing of 992 x 744 pixels"),
        ("what=[inferense]", "what.0"),
        ("precision=float16", "precision"),
        ("seconds=0", "seconds: "),
        ("kind=timings", "kind: 'timings' is not known (valid: train, study, reeval, timing)"),
        ("name=../up", "name: "),
    ],
)
def test_wrong_keys_and_values_are_refused(setting, message):
    with pytest.raises(JobError) as refusal:
        load_timing(ROOT / "jobs" / "timing.yaml", [setting])
    assert message in str(refusal.value)


def test_only_what_is_timed_is_checked():
    assert make_timing({"what": ["inference"], "training": {"rays": 1000}}).training.rays == 1000


def test_cores_are_shared_by_the_ranks():
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    assert threads_of(make_timing({})) == cores
    assert threads_of(make_timing({}), ranks=10_000) == 1
    assert threads_of(make_timing({"threads": 3}), ranks=2) == 3


def test_what_a_cluster_is_told_of_it():
    about = submit.describe(ROOT / "jobs" / "timing.yaml", ["name=quick"])
    assert (about["kind"], about["name"]) == ("timing", "quick")
    assert set(about["method"].split()) == {"nerfw", "hanerf", "crnerf", "crossray"}


# The command line


@pytest.fixture
def crossray(monkeypatch, capsys):
    """crossray(*words): what the command does in this process; exit status, standard output, standard error."""
    logger = logging.getLogger("crossray")
    before = logger.handlers[:], logger.level, logger.propagate
    monkeypatch.delenv("RANK", raising=False)

    def run(*words: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["crossray", *map(str, words)])
        try:
            cli.main()
            status = 0
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else int(end.code is not None)
        return status, *capsys.readouterr()

    yield run
    logger.handlers[:], logger.level, logger.propagate = before


def refused(result: tuple[int, str, str], *parts: str) -> None:
    status, out, err = result
    assert status == 2, (out, err)
    assert "Traceback" not in out + err
    assert all(part in err for part in parts), err


def tiny_file(folder: Path) -> Path:
    mapping = TINY | {"kind": "timing", "runs": str(folder / "runs")}
    mapping["inference"] = TINY["inference"] | {"methods": ["crossray"], "downscales": [8]}
    (folder / "timing.yaml").write_text(yaml.safe_dump(mapping))
    return folder / "timing.yaml"


@pytest.mark.slow
def test_a_timing_is_run_like_any_job(crossray, tmp_path):
    status, out, _ = crossray("run", tiny_file(tmp_path), "--set", "name=t")
    assert status == 0
    found = read_timing(tmp_path / "runs" / "t" / "timing.json")
    assert {r.table for r in found.rows} == {"inference", "appearances", "training", "cost"}
    assert {r.varied for r in found.rows if r.table == "cost"} == {"pixels", "rays", "photos"}
    (step,) = (r for r in found.rows if r.table == "training")
    assert (step.rays, step.photos, step.ranks, step.how, step.width) == (64, 3, 1, "trained", None)
    assert step.minutes == pytest.approx(20 * 17200 * step.seconds / 60)
    assert found.provenance.keys() >= {"command", "commit", "date", "hardware"}
    assert make_timing(found.job).name == "t"
    assert "Inference: seconds an image" in out
    assert "timing.json" in out


def test_a_launcher_is_refused(crossray, tmp_path):
    refused(crossray("run", tiny_file(tmp_path), "--launcher", "ray"), "--launcher", "is a timing")


def test_the_command_times_one_of_the_two(crossray, tmp_path):
    refused(crossray("timing", "inferense"), "did you mean 'inference'?")
    refused(
        crossray("timing", "training", "--set", "secons=1"), "secons: there is no such key; did you mean 'seconds'?"
    )
    refused(crossray("timing", "inference", "--set", "inference.methods=[nerf]"), "nerf has one appearance")


@pytest.mark.skipif(torch.cuda.is_available(), reason="is about machines without a GPU")
def test_a_gpu_that_is_not_there(crossray, tmp_path):
    refused(crossray("run", tiny_file(tmp_path), "--set", "device=cuda"), "device: cuda")


@pytest.mark.slow
def test_it_needs_neither_ray_nor_pycolmap(tmp_path):
    """On a machine that has neither, in two ranks."""
    code = (
        "import sys; sys.modules['ray'] = sys.modules['pycolmap'] = None\n"
        f"sys.argv = ['crossray', 'run', {str(tiny_file(tmp_path))!r}]\n"
        "from pipeline.cli import main\nmain()\n"
    )
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    ended = subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=environment, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    assert (tmp_path / "runs" / "timing" / "timing.json").is_file()


@pytest.mark.slow
def test_ranks_on_this_machine(tmp_path):
    words = ["--set", "training.ranks=2", "--set", "what=[training]", "--set", "training.cost_rays=[]"]
    command = [sys.executable, "-m", "pipeline", "run", str(tiny_file(tmp_path)), *words]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=240)
    assert ended.returncode == 0, ended.stderr
    rows = read_timing(tmp_path / "runs" / "timing" / "timing.json").rows
    assert [(r.table, r.ranks, r.rays) for r in rows] == [("training", 2, 64), ("cost", 2, 64)]
