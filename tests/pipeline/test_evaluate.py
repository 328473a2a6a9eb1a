"""Evaluations: what a protocol lets a model see, and that the scores are those of the pictures that are written."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import tiny_run
import torch
from PIL import Image
from tiny_run import cut_tiny, tiny_job

from model.methods import METHODS, HashSpec, ModelSpec
from model.scene_model import SceneModel
from pipeline import evaluate as module
from pipeline import judge
from pipeline.bootstrap import interval
from pipeline.checkpoint import CheckpointError
from pipeline.cli import print_scores
from pipeline.errors import CrossrayError
from pipeline.evaluate import (
    CheckpointGone,
    evaluate_protocols,
    evaluate_run,
    lock_of,
    prepare,
    recorded,
    run_protocols,
    score_views,
    update_best,
)
from pipeline.fit import FitRecipe, fit_code
from pipeline.judge import Judge, fit_colours, score
from pipeline.launch.run import claim_run
from pipeline.launch.tasks import in_process
from pipeline.lpips import find_lpips
from pipeline.metrics import ssim_11, ssim_window3
from pipeline.photos import open_photos
from pipeline.protocol import parse_protocol
from pipeline.reeval import ReevalJob, one_pass
from pipeline.render import render_picture
from pipeline.runs import checkpoint_of, job_of, load_run
from pipeline.status import last_evaluation
from pipeline.train import train
from pipeline.work import Context

STEP = "step-00000006"


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Finished runs on photos of 49 x 36 at R/2: `crossray`, `nerf` and `nerfw`, six steps each."""
    folder = cut_tiny(tmp_path_factory.mktemp("evaluate"), size=(98, 72))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CROSSRAY_CACHE", str(folder / "cache"))
        for method in ("crossray", "nerf", "nerfw"):
            over = {"name": method, "train": {"epochs": 1, "checkpoint_every": 3}}
            if method == "nerfw":
                over["model"] = {"field": "hash"}  # quick to fit codes of
            job = tiny_job(folder, method, over)
            claim_run(job)
            train(job, Context())
    return folder


@pytest.fixture(autouse=True)
def _environment(trained, monkeypatch):
    monkeypatch.setenv("CROSSRAY_CACHE", str(trained / "cache"))
    monkeypatch.setattr(judge, "find_lpips", lambda: None)
    monkeypatch.delenv("CROSSRAY_LPIPS", raising=False)


@pytest.fixture
def run(trained, tmp_path):
    """run(method): a copy of a finished run, so that each test has its own eval folder."""

    def of(method="crossray"):
        return shutil.copytree(trained / "runs" / method, tmp_path / "runs" / method)

    return of


@pytest.fixture
def photos(trained):
    return open_photos(tiny_job(trained).shards)


# Scores


def by_hand(folder, photos, index, start):
    """Prediction and truth of the scored columns, from the PNG that was written."""
    prediction = np.asarray(Image.open(folder / f"{photos.records[index].key}.png"))
    truth = photos.image(index)
    assert prediction.dtype == np.uint8
    assert prediction.shape == truth.shape
    return prediction[:, start:], truth[:, start:]


@pytest.mark.parametrize(("name", "ssim"), [("crnerf-full@R2", ssim_window3), ("nerfw-half@R2", ssim_11)])
@pytest.mark.parametrize("method", ["crossray", "nerf"])
def test_scores_are_those_of_the_written_pictures(run, photos, name, ssim, method):
    folder = run(method)
    result = evaluate_run(folder, name)
    out = folder / "eval" / name / STEP
    assert json.loads((out / "metrics.json").read_text()) == result
    (index,) = photos.indices("test")
    record = photos.records[index]
    prediction, truth = by_hand(out, photos, index, record.width // 2)
    squared = (prediction / 255 - truth / 255) ** 2
    (row,) = result["images"]
    assert (row["name"], row["key"]) == (record.name, record.key)
    assert row["psnr"] == pytest.approx(-10 * np.log10(squared.mean()), abs=1e-9)
    assert row["ssim"] == pytest.approx(ssim(prediction, truth), abs=1e-9)
    assert result["mean"] == {"psnr": row["psnr"], "ssim": row["ssim"]}
    # The released evaluation samples the MLP field more densely than training does.
    assert result["samples"] == ([256, 256] if method == "nerf" else "as in training")
    written = {f"{record.key}.png", f"{record.key}.depth.png", "metrics.json"}
    assert {p.name for p in out.iterdir()} == written


def test_metrics_say_what_was_evaluated_and_how(run):
    folder = run()
    result = evaluate_run(folder, "crnerf-full@R2")
    meta = json.loads((folder / "checkpoints" / STEP / "meta.json").read_text())
    assert result["checkpoint_sha256"] == meta["sha256"]["model.safetensors"]
    assert (result["protocol"], result["step"], result["method"]) == ("crnerf-full@R2", 6, "crossray")
    assert result["definition"] == parse_protocol("crnerf-full@R2")[0].model_dump(mode="json")
    assert result["statistics"] == job_of(folder).model.statistics
    assert result["versions"] == result["provenance"]["versions"]
    assert result["provenance"].keys() == {"command", "commit", "date", "hardware", "versions", "python"}
    assert result["interval"] == {"psnr": None, "ssim": None}  # one photo


def test_intervals_are_those_of_the_photos(several, monkeypatch):
    monkeypatch.setenv("CROSSRAY_CACHE", str(several / "cache"))
    result = evaluate_run(several / "runs" / "crossray", "crnerf-full@R2")
    for metric in ("psnr", "ssim"):
        values = [row[metric] for row in result["images"]]
        assert tuple(result["interval"][metric]) == interval(values)
        assert min(values) <= result["interval"][metric][0] < result["mean"][metric] < result["interval"][metric][1]


def test_means_are_printed_with_their_intervals(capsys):
    result = {"protocol": "cross@R1", "step": 6, "images": [{}, {}], "mean": {"psnr": 23.119, "mask_iou": 0.5}}
    print_scores(result | {"interval": {"psnr": [21.909, 24.21], "mask_iou": None}})
    assert capsys.readouterr().out == "cross@R1 (step 6, 2 photos): PSNR 23.12 [21.91, 24.21]  MASK_IOU 0.5\n"
    print_scores(result)  # as it was recorded before there were intervals
    assert capsys.readouterr().out == "cross@R1 (step 6, 2 photos): PSNR 23.12  MASK_IOU 0.5\n"


class FakeTime:
    """A clock that only rendering, reading and fitting move."""

    def __init__(self):
        self.seconds = 0.0

    def perf_counter(self):
        return self.seconds

    def taking(self, seconds, function):
        def timed(*args, **kwargs):
            self.seconds += seconds
            return function(*args, **kwargs)

        return timed


def test_each_protocol_has_its_own_times_whoever_did_the_work(run, monkeypatch):
    """A view is rendered once for all of them, and each says what it took."""
    clock = FakeTime()
    monkeypatch.setattr(judge, "time", clock)
    for name, seconds in (("render_view", 5.0), ("read_appearance", 2.0), ("fit_map", 30.0), ("fit_colours", 0.5)):
        monkeypatch.setattr(judge, name, clock.taking(seconds, getattr(judge, name)))
    names = ["crnerf-full@R2", "nerfw-half@R2", "nerfw-half@R2+fit", "nerfw-half@R2+affine"]
    results = evaluate_protocols(run(), names)
    assert [r["appearance_seconds"] for r in results] == [2.0, 2.0, 32.0, 2.5]
    assert [r["render_seconds"] for r in results] == [5.0] * 4


def test_fitting_learned_codes_has_its_own_time(run, quick, monkeypatch):
    clock = FakeTime()
    monkeypatch.setattr(judge, "time", clock)
    for name, seconds in (("render_view", 5.0), ("fit_code", 40.0)):
        monkeypatch.setattr(judge, name, clock.taking(seconds, getattr(judge, name)))
    results = evaluate_protocols(run("nerfw"), ["crnerf-full@R2", "nerfw-half@R2"])  # one fit
    assert [r["appearance_seconds"] for r in results] == [40.0, 40.0]
    assert [r["render_seconds"] for r in results] == [5.0, 5.0]
    assert results[0]["statistics"] == "none"


def test_without_an_appearance_none_takes_time(trained, photos, monkeypatch):
    clock = FakeTime()
    monkeypatch.setattr(judge, "time", clock)
    monkeypatch.setattr(judge, "render_view", clock.taking(5.0, judge.render_view))
    quick = parse_protocol("crnerf-full@R2")[0].model_copy(update={"mlp_samples": (4, 4)})
    judged = Judge(load_run(trained / "runs" / "nerf")[1], photos, quick, None).render(3)
    assert (judged.appearance_seconds, judged.render_seconds) == (0.0, 5.0)


def test_an_evaluation_of_before_is_read_where_it_can_be_and_made_again(run, capsys):
    """One without the keys that came later, under a definition with fewer keys."""
    folder = run()
    whole = evaluate_run(folder, "crnerf-full@R2")
    path = folder / "eval" / "crnerf-full@R2" / STEP / "metrics.json"
    later = ("interval", "statistics", "appearance_seconds", "render_seconds", "provenance")
    old = {key: value for key, value in whole.items() if key not in later}
    path.write_text(json.dumps(old))
    assert recorded(folder, "crnerf-full@R2", checkpoint_of(folder)) == old  # what was scored is the same
    job = job_of(folder)
    job = job.model_copy(update={"evaluate": job.evaluate.model_copy(update={"protocols": ("crnerf-full@R2",)})})
    print_scores(run_protocols(job)[0])
    assert "PSNR" in capsys.readouterr().out

    old["definition"] = {
        k: v for k, v in old["definition"].items() if k not in ("resize", "lpips", "fit_read", "suffix")
    }
    path.write_text(json.dumps(old))
    assert recorded(folder, "crnerf-full@R2", checkpoint_of(folder)) is None
    assert last_evaluation(folder) == f"crnerf-full@R2 at 6: {whole['mean']['psnr']:.2f} dB"
    update_best(folder, "crnerf-full@R2")
    assert not (folder / "eval" / "crnerf-full@R2" / "best.json").exists()
    summary = one_pass(ReevalJob(runs=(str(folder),), protocols=("crnerf-full@R2",)), in_process)
    assert (summary.evaluated, summary.skipped, summary.failed) == (2, [], [])  # of both checkpoints
    assert json.loads(path.read_text())["images"] == whole["images"]
    assert json.loads((folder / "eval" / "crnerf-full@R2" / "best.json").read_text())["of"] == 2


@pytest.mark.parametrize("infinite", [1, 3])
def test_perfect_pictures_are_recorded_and_read_again(several, tmp_path, monkeypatch, capsys, infinite):
    """PSNR inf: the mean is inf, no interval, and nobody who reads it stumbles."""
    monkeypatch.setenv("CROSSRAY_CACHE", str(several / "cache"))
    folder = shutil.copytree(several / "runs" / "crossray", tmp_path / "runs" / "crossray")
    shutil.rmtree(folder / "eval", ignore_errors=True)
    real, perfect = judge.score, [f"photo_{i:03d}.jpg" for i in (1, 3, 5)][:infinite]
    monkeypatch.setattr(judge, "score", lambda p, t, *w: real(t if w[-1] in perfect else p, t, *w))
    result = evaluate_run(folder, "crnerf-full@R2")
    assert [row["psnr"] for row in result["images"]].count(math.inf) == infinite
    assert result["mean"]["psnr"] == math.inf
    assert result["interval"]["psnr"] is None
    assert result["interval"]["ssim"] is not None
    assert recorded(folder, "crnerf-full@R2", checkpoint_of(folder)) == result
    assert json.loads((folder / "eval" / "crnerf-full@R2" / "best.json").read_text())["psnr"] == math.inf
    assert last_evaluation(folder) == "crnerf-full@R2 at 2: inf dB"
    print_scores(result)
    assert "PSNR inf  SSIM" in capsys.readouterr().out


def test_an_older_step_may_be_asked_for(run):
    folder = run()
    result = evaluate_run(folder, "crnerf-full@R2", step=3)
    assert result["step"] == 3
    assert (folder / "eval" / "crnerf-full@R2" / "step-00000003" / "metrics.json").is_file()
    with pytest.raises(CheckpointError, match="no checkpoint of step 4; there are 3, 6"):
        evaluate_run(folder, "crnerf-full@R2", step=4)


def test_metrics_come_last(run, monkeypatch):
    """A folder without metrics.json is an evaluation that was interrupted."""
    folder = run()
    monkeypatch.setattr(judge, "score", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        evaluate_run(folder, "crnerf-full@R2")
    assert not list(folder.rglob("metrics.json"))


def test_results_of_another_checkpoint_go_before_its_pictures_do(run, monkeypatch):
    folder = run()
    evaluate_run(folder, "crnerf-full@R2")
    path = folder / "eval" / "crnerf-full@R2" / STEP / "metrics.json"
    whole = path.read_text()
    monkeypatch.setattr(judge, "score", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        evaluate_run(folder, "crnerf-full@R2")
    assert path.read_text() == whole  # of this very checkpoint: its pictures are the same
    path.write_text(json.dumps(json.loads(whole) | {"checkpoint_sha256": "0" * 64}))
    with pytest.raises(KeyboardInterrupt):
        evaluate_run(folder, "crnerf-full@R2")
    assert not path.exists()


@pytest.mark.parametrize("text", ["", "{", "[]", "null", '{"definition": {}}', "\x00", "whole"])
def test_what_cannot_be_read_was_not_recorded(run, text):
    folder = run()
    evaluate_run(folder, "crnerf-full@R2")
    path = folder / "eval" / "crnerf-full@R2" / STEP / "metrics.json"
    if text == "whole":
        assert recorded(folder, "crnerf-full@R2", checkpoint_of(folder)) == json.loads(path.read_text())
        text = path.read_text()[:-9]
    path.write_text(text)
    assert recorded(folder, "crnerf-full@R2", checkpoint_of(folder)) is None


def test_twice_is_the_same(run):
    folder = run()
    first, again = (evaluate_run(folder, "crnerf-full@R2") for _ in range(2))
    assert first["images"] == again["images"]


# Tasks


@pytest.fixture(scope="module")
def several(tmp_path_factory):
    """Runs of three test photos: `crossray`, whose views protocols share, and `nerfw`, whose codes they share."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tiny_run, "SPLITS", ("train", "test", "train", "test", "val", "test"))
        folder = cut_tiny(tmp_path_factory.mktemp("several"))
        patch.setenv("CROSSRAY_CACHE", str(folder / "cache"))
        for method in ("crossray", "nerfw"):
            over = {"name": method, "train": {"epochs": 1, "steps_per_epoch": 2}, "model": {"field": "hash"}}
            job = tiny_job(folder, method, over)
            claim_run(job)
            train(job, Context())
    return folder


def metrics_of(part, name):
    return {index: row.metrics for index, row in part.rows[name].items()}


def without_times(results):
    times = ("seconds", "appearance_seconds", "render_seconds", "provenance")
    return [{k: v for k, v in result.items() if k not in times} for result in results]


@pytest.mark.parametrize("method", ["crossray", "nerfw"])
def test_the_numbers_are_the_same_however_views_are_split(several, quick, method, monkeypatch):
    monkeypatch.setenv("CROSSRAY_CACHE", str(several / "cache"))
    run = several / "runs" / method
    names = ["crnerf-full@R2", "crnerf-full@R2+affine", "nerfw-half@R2"]
    evaluation = prepare(job_of(run), checkpoint_of(run), names)
    split = evaluation.begin()
    assert [task.photos for task in split] == [(1,), (3,), (5,)]
    at_once = score_views(split[0]._replace(photos=(1, 3, 5)))
    parts = [score_views(task) for task in reversed(split)]
    for name in names:
        assert metrics_of(at_once, name) == {k: v for part in parts for k, v in metrics_of(part, name).items()}
        alone = score_views(split[1]._replace(protocols=(name,)))
        assert metrics_of(alone, name)[3] == metrics_of(at_once, name)[3]  # nor do other protocols change a number
    results, again = (without_times(evaluation.commit(p)) for p in (parts, [at_once]))
    assert results == again
    assert [row["name"] for row in results[0]["images"]] == ["photo_001.jpg", "photo_003.jpg", "photo_005.jpg"]


def test_the_mapper_runs_the_tasks_and_a_task_reads_the_model_once(several, monkeypatch):
    monkeypatch.setenv("CROSSRAY_CACHE", str(several / "cache"))
    run, read, ran = several / "runs" / "crossray", [], []
    model_of = module.model_of
    monkeypatch.setattr(module, "model_of", lambda *words: read.append(1) or model_of(*words))
    module._latest.clear()

    def mapper(fn, specs):
        for spec in reversed(list(specs)):
            ran.append(spec.photos)
            yield fn(spec)

    (result,) = evaluate_protocols(run, ["crnerf-full@R2"], mapper=mapper)
    assert ran == [(5,), (3,), (1,)]
    assert len(read) == 1
    assert result["images"] == evaluate_run(run, "crnerf-full@R2")["images"]


def test_a_view_is_rendered_once_for_all_protocols(several, monkeypatch):
    monkeypatch.setenv("CROSSRAY_CACHE", str(several / "cache"))
    rendered, render_view = [], judge.render_view
    monkeypatch.setattr(judge, "render_view", lambda *a, **k: rendered.append(1) or render_view(*a, **k))
    evaluate_protocols(several / "runs" / "crossray", ["crnerf-full@R2", "nerfw-half@R2", "nerfw-half@R2+affine"])
    assert len(rendered) == 3


def test_a_checkpoint_that_was_removed_or_written_anew_is_told_apart(run):
    folder = run()
    (task,) = prepare(job_of(folder), checkpoint_of(folder), ["crnerf-full@R2"]).begin()
    module._latest.clear()
    with pytest.raises(CheckpointGone, match="written anew"):
        score_views(task._replace(checkpoint="0" * 64))
    (folder / "checkpoints" / STEP / "model.safetensors").write_bytes(b"damaged")
    with pytest.raises(CheckpointError, match="damaged") as error:
        score_views(task)
    assert not isinstance(error.value, CheckpointGone)
    shutil.rmtree(folder / "checkpoints" / STEP)
    with pytest.raises(CheckpointGone, match="removed"):
        score_views(task)


@pytest.mark.slow
def test_evaluations_after_training_wait_for_the_process_that_is_at_it(run, monkeypatch):
    """And then find that there is nothing to do."""
    folder = run()
    result = evaluate_run(folder, "crnerf-full@R2")
    path = folder / "eval" / "crnerf-full@R2" / STEP / "metrics.json"
    text = path.read_text()
    path.unlink()
    job = job_of(folder)
    job = job.model_copy(update={"evaluate": job.evaluate.model_copy(update={"protocols": ("crnerf-full@R2",)})})
    said, lock = [], lock_of(folder, STEP)

    def other(*words):  # ends as soon as somebody waits for it
        said.append(words[0])
        path.write_text(text)
        lock.release()

    monkeypatch.setattr(module.log, "info", other)
    lock.acquire()
    monkeypatch.setattr(module, "score_views", None)
    assert run_protocols(job) == [result]
    assert "another process" in said[0]


def test_a_moved_run_finds_its_own_checkpoints_and_shards(run, trained):
    assert load_run(run())[0].shards == trained / "shards" / "tiny"


def test_shards_are_found_from_another_folder_than_the_one_where_a_run_was_started(tmp_path, monkeypatch):
    start, elsewhere = tmp_path / "start", tmp_path / "elsewhere"
    run = start / "out" / "runs" / "a"
    for folder in (run, elsewhere, start / "out" / "shards"):
        folder.mkdir(parents=True)
    text = "kind: train\nname: a\nmethod: nerf\nscene: {path: s, shards: out/shards}\nruns: out/runs\n"
    (run / "job.yaml").write_text(text)
    monkeypatch.chdir(start)
    assert job_of(Path("out/runs/a")).shards == Path("out/shards")
    monkeypatch.chdir(elsewhere)
    assert job_of(Path("../start/out/runs/a")).shards.resolve() == start / "out" / "shards"
    (elsewhere / "out" / "shards").mkdir(parents=True)  # another project's
    assert job_of(run).shards.resolve() == start / "out" / "shards"
    (start / "out" / "shards").rmdir()
    assert job_of(run).shards == Path("out/shards")  # as seen from here
    run.rename(elsewhere / "a")
    assert job_of(elsewhere / "a").shards == Path("out/shards")


def test_another_downscale_is_refused(run):
    with pytest.raises(CrossrayError, match=r"crnerf-full@R4.*at R2.*crnerf-full@R2"):
        evaluate_run(run(), "crnerf-full@R4")


def test_a_folder_that_is_no_run_is_refused(tmp_path):
    with pytest.raises(CrossrayError, match=r"is not a run: it has no job\.yaml"):
        evaluate_run(tmp_path, "crnerf-full@R2")


def test_a_run_without_a_checkpoint_is_refused(run):
    folder = run()
    shutil.rmtree(folder / "checkpoints")
    with pytest.raises(CheckpointError, match="no committed checkpoint"):
        evaluate_run(folder, "crnerf-full@R2")


# What a protocol lets the model see


class Doctored:
    """Photos with another reference for one of them."""

    def __init__(self, photos, index, reference):
        self.records, self.index, self.doctored, self.image = photos.records, index, reference, photos.image
        self.original = photos.reference

    def reference(self, i):
        return self.doctored if i == self.index else self.original(i)


@pytest.fixture(scope="module")
def responsive(trained):
    """The trained model, its transform pushed so far that appearance visibly acts, after six steps already."""
    _, model, _ = load_run(trained / "runs" / "crossray")
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for layer in model.transform.shift:
            if hasattr(layer, "weight"):
                layer.weight.copy_(torch.randn(layer.weight.shape, generator=generator))
    return model


def predict(model, photos, index, name):
    return Judge(model, photos, parse_protocol(name)[0], None).render(index).picture


def test_the_left_half_protocol_does_not_see_the_right_half(responsive, photos):
    (index,) = photos.indices("test")
    reference = photos.reference(index)
    half = reference.shape[1] - reference.shape[1] // 2
    doctored = reference.copy()
    doctored[:, half:] = 255 - doctored[:, half:]
    other = Doctored(photos, index, doctored)
    before, after = (predict(responsive, p, index, "nerfw-half@R2") for p in (photos, other))
    np.testing.assert_array_equal(before, after)
    before, after = (predict(responsive, p, index, "crnerf-full@R2") for p in (photos, other))
    assert np.abs(before - after).max() > 1e-3  # the paper's protocol does see it


def test_the_left_half_protocol_does_see_the_left_half(responsive, photos):
    (index,) = photos.indices("test")
    doctored = photos.reference(index).copy()
    doctored[:, : doctored.shape[1] // 2] = 0
    before, after = (
        predict(responsive, p, index, "nerfw-half@R2") for p in (photos, Doctored(photos, index, doctored))
    )
    assert np.abs(before - after).max() > 1e-3


# Learned codes


@pytest.fixture
def quick(monkeypatch):
    """Protocols whose codes are fitted in a few steps, and what each fit was asked for: (image, camera, columns)."""
    calls = []

    def parse(name):
        protocol, downscale = parse_protocol(name)
        quick = {"mlp": FitRecipe(steps=7, rays=64), "hash": FitRecipe(steps=5, rays=64)}
        return protocol.model_copy(update={"fit": quick}), downscale

    def spy(model, image, camera, columns, recipe, **kwargs):
        assert recipe.steps == 5  # that of the model's field
        calls.append((image, camera, columns))
        return fit_code(model, image, camera, columns, recipe, **kwargs)

    monkeypatch.setattr(module, "parse_protocol", parse)
    monkeypatch.setattr(judge, "fit_code", spy)
    return calls


@pytest.mark.parametrize("name", ["crnerf-full@R2", "nerfw-half@R2"])
def test_a_learned_code_is_fitted_to_the_left_half_and_metrics_say_so(run, photos, quick, name):
    """Also where others read the whole photo: fitting to what is scored would be training on it."""
    folder = run("nerfw")
    result = evaluate_run(folder, name)
    assert result["appearance_from"] == "left"
    assert json.loads((folder / "eval" / name / STEP / "metrics.json").read_text())["appearance_from"] == "left"
    (index,) = photos.indices("test")
    ((image, camera, columns),) = quick
    np.testing.assert_array_equal(image, photos.image(index))
    assert camera == photos.records[index]
    assert columns == 25  # of 49: the middle one is in both halves, as in nerfbaselines


@pytest.mark.slow
def test_what_others_read_from_is_said_too(run, quick):
    for method, name, expected in (
        ("crossray", "crnerf-full@R2", "whole"),
        ("crossray", "nerfw-half@R2", "left"),
        ("nerf", "crnerf-full@R2", "nothing"),
        ("nerf", "nerfw-half@R2", "nothing"),
    ):
        folder = run(method)
        assert evaluate_run(folder, name)["appearance_from"] == expected
        shutil.rmtree(folder)
    assert quick == []


class DoctoredImage:
    """Photos of which one has other pixels and another reference from a column on."""

    def __init__(self, photos, index, column):
        self.photos, self.index, self.column = photos, index, column

    def __getattr__(self, name):
        return getattr(self.photos, name)

    def image(self, i):
        image = self.photos.image(i).copy()
        if i == self.index:
            image[:, self.column :] = 255 - image[:, self.column :]
        return image

    def reference(self, i):
        return 255 - self.photos.reference(i) if i == self.index else self.photos.reference(i)


@pytest.mark.parametrize("name", ["crnerf-full@R2", "nerfw-half@R2"])
def test_a_fitted_code_knows_nothing_of_the_right_half(trained, photos, quick, name):
    _, model, _ = load_run(trained / "runs" / "nerfw")
    (index,) = photos.indices("test")
    protocol = module.parse_protocol(name)[0]
    code, same, other = (
        Judge(model, p, protocol, None).appearance(index)[0]
        for p in (photos, DoctoredImage(photos, index, 25), DoctoredImage(photos, index, 23))
    )
    assert torch.equal(code, same)
    assert not torch.equal(code, other)


def test_a_code_is_fitted_once_a_photo_and_checkpoint(run, quick):
    folder = run("nerfw")
    first, shared = evaluate_protocols(folder, ["crnerf-full@R2", "nerfw-half@R2"])
    assert len(quick) == 1
    assert evaluate_run(folder, "nerfw-half@R2")["images"] == shared["images"]  # fitted anew
    assert len(quick) == 2
    assert first["images"][0]["psnr"] == pytest.approx(shared["images"][0]["psnr"], abs=1e-9)  # one picture, two SSIMs


def test_a_fitted_picture_is_what_is_scored(run, photos, quick):
    folder = run("nerfw")
    (row,) = evaluate_run(folder, "crnerf-full@R2")["images"]
    _, model, _ = load_run(folder)
    (index,) = photos.indices("test")
    code = fit_code(model, photos.image(index), photos.records[index], 25, FitRecipe(steps=5, rays=64), seed=index)
    picture = render_picture(model, photos.records[index], code)[1]
    prediction, truth = by_hand(folder / "eval" / "crnerf-full@R2" / STEP, photos, index, 49 // 2)
    np.testing.assert_array_equal(prediction, (255 * picture).astype(np.uint8)[:, 49 // 2 :])
    assert row["psnr"] == pytest.approx(-10 * np.log10(np.square(prediction / 255 - truth / 255).mean()), abs=1e-9)


# Test-time fitting of what is read from a photo


def test_fit_starts_from_the_encoder_and_comes_closer_to_the_left_half(responsive, photos):
    (index,) = photos.indices("test")
    left, photo = slice(25), photos.image(index) / 255
    plain, fitted = (predict(responsive, photos, index, n) for n in ("nerfw-half@R2", "nerfw-half@R2+fit"))
    before, after = (np.square(p[:, left] - photo[:, left]).mean() for p in (plain, fitted))
    assert after < 0.99 * before
    of = Judge(responsive, photos, parse_protocol("nerfw-half@R2")[0], None)
    further = Judge(responsive, photos, parse_protocol("nerfw-half@R2+fit")[0], None)
    start, end = of.appearance(index)[0], further.appearance(index, further.view(index)[0])[0]
    recipe = further.protocol.fit_read["hash"]
    assert 0 < (end - start).abs().max() < 1.5 * recipe.steps * recipe.learning_rate  # a step is about the rate


@pytest.mark.parametrize("name", ["nerfw-half@R2+fit", "crnerf-full@R2+fit"])
def test_fit_knows_nothing_of_the_right_half_but_what_the_encoder_reads(responsive, photos, name):
    """Also under the protocol whose encoder reads the whole photo. Of 49 columns the middle one counts as left."""

    class SameReference(DoctoredImage):
        def reference(self, i):
            return self.photos.reference(i)

    (index,) = photos.indices("test")
    picture, same, other = (
        predict(responsive, p, index, name)
        for p in (photos, SameReference(photos, index, 25), SameReference(photos, index, 23))
    )
    np.testing.assert_array_equal(picture, same)
    assert np.abs(picture - other).max() > 1e-4


def test_fit_of_the_left_half_sees_nothing_of_the_right_one_at_all(responsive, photos):
    class Negative(DoctoredImage):
        def reference(self, i):
            reference = self.photos.reference(i).copy()
            reference[:, reference.shape[1] - reference.shape[1] // 2 :] = 0
            return reference

    (index,) = photos.indices("test")
    picture, same = (predict(responsive, p, index, "nerfw-half@R2+fit") for p in (photos, Negative(photos, index, 25)))
    np.testing.assert_array_equal(picture, same)


def test_fit_of_a_code_that_is_read_starts_from_it(photos, monkeypatch):
    spec = ModelSpec(
        **METHODS["hanerf"].axes() | {"field": "hash", "transient": "none"},
        encoder="compact",
        hash=HashSpec(**tiny_run.HASH),
    )
    torch.manual_seed(0)
    model = SceneModel(spec, torch.tensor([[-1.0, -1, -1], [1, 1, 1]])).eval().requires_grad_(False)
    calls = []
    monkeypatch.setattr(judge, "fit_code", lambda *a, **k: calls.append((a, k)) or k["start"] + 1)
    (index,) = photos.indices("test")
    read = Judge(model, photos, parse_protocol("nerfw-half@R2")[0], None).appearance(index)[0]
    assert calls == []
    fitted = Judge(model, photos, parse_protocol("nerfw-half@R2+fit")[0], None)
    torch.testing.assert_close(fitted.appearance(index)[0], read + 1)
    (((_, image, camera, columns, recipe), words),) = calls
    np.testing.assert_array_equal(image, photos.image(index))
    assert (camera, columns) == (photos.records[index], 25)
    assert recipe == fitted.protocol.fit_read["hash"]
    torch.testing.assert_close(words["start"], read)


def test_fit_is_recorded_as_what_it_is_and_refused_where_it_is_nothing(run):
    folder = run()
    plain, fitted = evaluate_protocols(folder, ["nerfw-half@R2", "nerfw-half@R2+fit"])
    assert (plain["definition"]["suffix"], fitted["definition"]["suffix"]) == (None, "fit")
    assert plain["definition"] | {"suffix": "fit"} == fitted["definition"]
    assert fitted["appearance_from"] == "left"
    assert (folder / "eval" / "nerfw-half@R2+fit" / STEP / "metrics.json").is_file()
    for method, reason in (("nerf", "no appearance to fit"), ("nerfw", "always fitted")):
        with pytest.raises(CrossrayError, match=reason):
            evaluate_run(run(method), "nerfw-half@R2+fit")


# What no picture can be scored of


def spoilt(march):
    """With one feature that is no number."""
    level = march.levels[-1]
    level.features[0, 0, 0] = math.nan
    return march


@pytest.mark.parametrize(
    ("part", "what"),
    [
        ("field", "its rendered view"),
        ("encoder", "the appearance that is read"),
        ("transform", "its picture"),
        ("decoder", "its picture"),
    ],
)
@pytest.mark.parametrize("name", ["crnerf-full@R2", "crnerf-full@R2+affine", "nerfw-half@R2+fit"])
def test_a_model_that_gives_nan_is_refused_with_the_photo(trained, photos, part, what, name, monkeypatch):
    _, model, _ = load_run(trained / "runs" / "crossray")
    if part == "field":  # of finite weights: what they give may overflow
        level = model.field.look
        monkeypatch.setattr(model.field, "look", lambda *a, **k: spoilt(level(*a, **k)))
    else:
        for parameter in getattr(model, part).parameters():
            parameter.fill_(math.nan)
    (index,) = photos.indices("test")
    if name.endswith("+fit") and what == "its picture":
        what = "the appearance that is fitted"
    with pytest.raises(CrossrayError, match=rf"photo_003\.jpg: \d+ of \d+ numbers of {what}.* are NaN.*--step"):
        Judge(model, photos, parse_protocol(name)[0], None).render(index)


@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize(("method", "part"), [("crossray", "field"), ("nerf", "field"), ("nerfw", "embedding")])
def test_weights_that_are_no_numbers_are_named_before_anything_is_rendered(run, method, part, value, monkeypatch):
    folder, model_of = run(method), module.model_of

    def broken(*words):
        model = model_of(*words)
        list(getattr(model, part).parameters())[-1].view(-1)[-1] = value
        return model

    monkeypatch.setattr(module, "model_of", broken)
    module._latest.clear()
    with pytest.raises(CrossrayError, match=rf"step-00000006: {part}\..* not finite.*--step"):
        evaluate_run(folder, "nerfw-half@R2")
    assert not [*folder.rglob("metrics.json"), *folder.rglob("*.png")]
    assert not module._latest


@pytest.mark.parametrize(("name", "window"), [("crnerf-full@R1", 3), ("nerfw-half@R1", 11)])
@pytest.mark.parametrize("size", [(1, 1), (40, 3), (2, 40), (1, 40)])
def test_a_photo_too_small_for_ssim_is_named(name, window, size):
    picture = np.zeros((*size, 3), np.uint8)
    scored = size[1] - size[1] // 2
    with pytest.raises(CrossrayError, match=rf"x\.jpg: its scored part is {scored} x {size[0]} .* window of {window}"):
        score(picture, picture, parse_protocol(name)[0], None, "x.jpg")


@pytest.mark.parametrize("width", [40, 41])
def test_the_middle_column_of_an_odd_width_is_read_and_scored(width):
    picture = np.zeros((12, width, 3), np.uint8)
    assert judge.left_half(picture).shape[1] == (20 if width == 40 else 21)
    truth = picture.copy()
    truth[:, width // 2 - 1] = 9  # the last column that is not scored
    protocol = parse_protocol("nerfw-half@R1")[0]
    assert score(picture, truth, protocol, None, "x")["psnr"] == math.inf
    truth[:, width // 2] = 9
    expected = -10 * math.log10((9 / 255) ** 2 / (width - width // 2))
    assert score(picture, truth, protocol, None, "x")["psnr"] == pytest.approx(expected)


def test_pictures_of_other_sizes_are_never_scored():
    with pytest.raises(ValueError, match="differ in shape"):
        score(
            np.zeros((20, 40, 3), np.uint8), np.zeros((20, 41, 3), np.uint8), parse_protocol("cross@R1")[0], None, "x"
        )


# The affine control


def smooth(shape, seed):
    return np.random.default_rng(seed).uniform(0.2, 0.6, shape)


@pytest.mark.parametrize("width", [40, 41])
def test_a_known_affine_map_is_recovered(width):
    picture = smooth((20, width, 3), 0)
    matrix = np.array([[0.9, 0.1, 0.0], [0.05, 0.7, 0.1], [0.0, 0.2, 1.1]])
    photo = np.rint(255 * (picture @ matrix + [0.05, 0.1, -0.02])).astype(np.uint8)
    np.testing.assert_allclose(fit_colours(picture, photo), photo / 255, atol=0.003)  # the photo's rounding


@pytest.mark.parametrize("width", [40, 41])
def test_the_fit_never_looks_at_the_right_half(width):
    picture, photo = smooth((20, width, 3), 1), np.random.default_rng(2).integers(0, 256, (20, width, 3), np.uint8)
    changed = photo.copy()
    changed[:, width - width // 2 :] = 255 - changed[:, width - width // 2 :]
    np.testing.assert_array_equal(fit_colours(picture, photo), fit_colours(picture, changed))
    changed = photo.copy()
    changed[:, : width // 2] = 255 - changed[:, : width // 2]
    assert np.abs(fit_colours(picture, photo) - fit_colours(picture, changed)).max() > 0.01


def test_the_fit_is_the_least_squares_one():
    picture, photo = smooth((12, 16, 3), 3), np.random.default_rng(4).integers(0, 256, (12, 16, 3), np.uint8)
    left = slice(None, 8)
    target = photo[:, left] / 255
    best = np.square(fit_colours(picture, photo)[:, left] - target).mean()
    ones = np.ones((12, 8, 1))
    design = np.concatenate([picture[:, left], ones], axis=-1).reshape(-1, 4)
    # Normal equations: slow, and obviously right.
    solution = np.linalg.solve(design.T @ design, design.T @ target.reshape(-1, 3))
    assert best == pytest.approx(np.square(design @ solution - target.reshape(-1, 3)).mean(), rel=1e-9)


def test_the_affine_control_scores_the_fitted_picture(run, photos):
    folder = run()
    plain, fitted = (evaluate_run(folder, name) for name in ("nerfw-half@R2", "nerfw-half@R2+affine"))
    assert fitted["protocol"] == "nerfw-half@R2+affine"
    assert (folder / "eval" / "nerfw-half@R2+affine" / STEP / "metrics.json").is_file()
    assert fitted["mean"]["psnr"] > plain["mean"]["psnr"]  # after six steps, any fit is better
    (index,) = photos.indices("test")
    prediction, truth = by_hand(folder / "eval" / "nerfw-half@R2+affine" / STEP, photos, index, 49 // 2)
    assert fitted["mean"]["psnr"] == pytest.approx(-10 * np.log10(np.square(prediction / 255 - truth / 255).mean()))


# LPIPS


@pytest.fixture
def said(monkeypatch):
    """What evaluation warns of."""
    warned: list[str] = []
    judge.warn_once.cache_clear()
    monkeypatch.setattr(judge.log, "warning", warned.append)
    return warned


def test_lpips_is_left_out_with_one_warning_where_there_are_no_weights(run, said):
    folder = run()
    for protocol in ("crnerf-full@R2", "nerfw-half@R2"):
        assert "lpips" not in evaluate_run(folder, protocol)["mean"]
    assert len(said) == 1
    assert "CROSSRAY_LPIPS" in said[0]


@pytest.mark.parametrize(("width", "usable"), [(62, True), (61, True), (60, False), (1, False)])
def test_lpips_takes_what_is_scored_of_an_odd_width(photos, monkeypatch, said, width, usable):
    """Of 61 columns 31 are scored, which is enough."""
    monkeypatch.setattr(judge, "find_lpips", lambda: object())
    (index,) = photos.indices("test")
    record = photos.records[index].model_copy(update={"width": width, "height": 40})
    one = SimpleNamespace(records={index: record})
    assert judge.lpips_usable(one, (index,), parse_protocol("nerfw-half@R1")[0]) is usable
    assert len(said) == (0 if usable else 1)


@pytest.mark.parametrize("damage", ["absent", "damaged", "of another network"])
def test_weights_that_are_named_and_cannot_be_used_end_the_evaluation(run, tmp_path, monkeypatch, damage):
    """Before anything is rendered: a column that was asked for is not left out quietly."""
    path = tmp_path / "weights.npz"
    if damage == "damaged":
        path.write_bytes(b"PK\x03\x04 no weights")
    elif damage == "of another network":
        np.savez(path, **{"features.0.weight": np.zeros((64, 3, 3, 3), np.float32)})
    monkeypatch.setenv("CROSSRAY_LPIPS", str(path))
    monkeypatch.setattr(judge, "find_lpips", find_lpips)
    monkeypatch.setattr(module, "score_views", None)
    folder = run()
    with pytest.raises(CrossrayError, match=r"weights\.npz"):
        evaluate_run(folder, "crnerf-full@R2")
    assert not list(folder.rglob("*.png"))


@pytest.mark.real
def test_lpips_is_scored_with_the_real_weights(trained, test_data, tmp_path, monkeypatch):
    weights = test_data / "lpips" / "lpips_alex.npz"
    monkeypatch.setattr(judge, "find_lpips", lambda: find_lpips(weights))
    folder = cut_tiny(tmp_path, size=(140, 80))
    job = tiny_job(folder, "crossray", {"train": {"epochs": 1, "steps_per_epoch": 1}})
    claim_run(job)
    train(job, Context())
    result = evaluate_run(job.run, "crnerf-full@R2")
    photos = open_photos(job.shards)
    (index,) = photos.indices("test")
    prediction, truth = by_hand(job.run / "eval" / "crnerf-full@R2" / "step-00000001", photos, index, 35)
    lpips = find_lpips(weights)
    assert lpips is not None
    expected = lpips.distance(np.ascontiguousarray(prediction), np.ascontiguousarray(truth))
    assert result["mean"]["lpips"] == pytest.approx(expected, rel=1e-6)
    assert 0 < result["mean"]["lpips"] < 2


@pytest.mark.real
def test_lpips_is_left_out_where_pictures_are_too_small(run, test_data, monkeypatch, said):
    """The scored half of the tiny photo is 25 pixels wide; AlexNet needs 31."""
    monkeypatch.setattr(judge, "find_lpips", lambda: find_lpips(test_data / "lpips" / "lpips_alex.npz"))
    assert "lpips" not in evaluate_run(run(), "crnerf-full@R2")["mean"]
    assert "photo_003.jpg" in said[0]
    assert "31" in said[0]
