"""Protocols: what they are called, what they read, and that the scores are those of the pictures that are written."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
import tiny_run
import torch
from PIL import Image
from tiny_run import cut_tiny, tiny_job

from pipeline import evaluate as module
from pipeline import judge
from pipeline.checkpoint import CheckpointError
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
)
from pipeline.fit import FitRecipe, fit_code
from pipeline.judge import Judge, fit_colours
from pipeline.launch.run import claim_run
from pipeline.metrics import ssim_11, ssim_window3
from pipeline.photos import open_photos
from pipeline.protocol import parse_protocol
from pipeline.render import render_picture
from pipeline.runs import checkpoint_of, job_of, load_run
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


# Names


@pytest.mark.parametrize(
    ("name", "appearance", "ssim", "downscale", "affine"),
    [
        ("crnerf-full@R4", "whole", "window3", 4, False),
        ("crnerf-full@R2", "whole", "window3", 2, False),
        ("nerfw-half@R1", "left", "window11", 1, False),
        ("nerfw-half@R16+affine", "left", "window11", 16, True),
    ],
)
def test_a_protocol_is_named_with_its_downscale(name, appearance, ssim, downscale, affine):
    protocol, found_downscale, found_affine = parse_protocol(name)
    assert (found_downscale, found_affine) == (downscale, affine)
    assert (protocol.appearance, protocol.ssim) == (appearance, ssim)
    assert (protocol.scored, protocol.rounding, protocol.mlp_samples) == ("right", "truncate", (256, 256))


def test_cross_scores_whole_clean_pictures():
    protocol, downscale, affine = parse_protocol("cross@R1")
    assert (downscale, affine) == (1, False)
    assert (protocol.appearance, protocol.scored, protocol.truth) == ("elsewhere", "whole", "clean")
    assert (protocol.ssim, protocol.rounding, protocol.mlp_samples) == ("window11", "round", (256, 256))


def test_all_protocols_fit_codes_by_one_recipe():
    """Codes are shared between protocols: for one photo and half there is one fit."""
    first, *others = (parse_protocol(name)[0].fit for name in ("crnerf-full@R4", "nerfw-half@R1", "cross@R1"))
    assert all(fit == first for fit in others)
    assert first["mlp"] == FitRecipe(steps=1000, rays=1024, learning_rate=0.01)  # nerfbaselines' of NeRF-W


@pytest.mark.parametrize(
    "name",
    ["crnerf-full", "crnerf-full@", "crnerf-full@4", "crnerf-full@R0", "crnerf-full@R04", "crnerf-full@R4+afine", "",
     "@R4", "crnerf-full@R4 ", "crnerf-full@R4\n", "CRNERF-FULL@R4", "../protocols/crnerf-full@R4"],
)  # fmt: skip
def test_a_bare_or_misspelt_name_says_how_to_write_it(name):
    with pytest.raises(CrossrayError, match=r"crnerf-full@R4.*known: crnerf-full, cross, nerfw-half"):
        parse_protocol(name)


def test_an_unknown_protocol_names_the_known_ones():
    with pytest.raises(CrossrayError, match=r"'crnerf-ful' is not known \(known: crnerf-full, cross, nerfw-half\)"):
        parse_protocol("crnerf-ful@R4")


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
    assert result["definition"]["appearance"] == "whole"
    assert {"torch", "numpy"} <= result["versions"].keys()


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
        assert at_once.rows[name] == {index: row for part in parts for index, row in part.rows[name].items()}
        alone = score_views(split[1]._replace(protocols=(name,)))
        assert alone.rows[name][3] == at_once.rows[name][3]  # nor do other protocols change a number
    results = [{k: v for k, v in r.items() if k != "seconds"} for r in evaluation.commit(parts)]
    again = [{k: v for k, v in r.items() if k != "seconds"} for r in evaluation.commit([at_once])]
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
    return Judge(model, photos, parse_protocol(name)[0], None).render(index)[1]


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
        protocol, downscale, affine = parse_protocol(name)
        quick = {"mlp": FitRecipe(steps=7, rays=64), "hash": FitRecipe(steps=5, rays=64)}
        return protocol.model_copy(update={"fit": quick}), downscale, affine

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
        Judge(model, p, protocol, None).appearance(index)
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


@pytest.mark.real
def test_lpips_is_scored_with_the_real_weights(trained, test_data, tmp_path, monkeypatch):
    from pipeline.lpips import find_lpips

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
    from pipeline.lpips import find_lpips

    monkeypatch.setattr(judge, "find_lpips", lambda: find_lpips(test_data / "lpips" / "lpips_alex.npz"))
    assert "lpips" not in evaluate_run(run(), "crnerf-full@R2")["mean"]
    assert "photo_003.jpg" in said[0]
    assert "31" in said[0]
