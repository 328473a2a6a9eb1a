"""Judging against the landmark's truth: what is scored, what is seen of a test photo (nothing), and who is refused."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
import torch
from PIL import Image
from tiny_run import tiny_job
from tiny_scene import write_tiny_scene

from model.methods import ModelSpec
from pipeline import evaluate as module
from pipeline import judge as judge_module
from pipeline import truth as truth_module
from pipeline.cutting import cut_shards
from pipeline.errors import CrossrayError
from pipeline.evaluate import evaluate_run, run_protocols
from pipeline.fit import FitRecipe
from pipeline.judge import Judge
from pipeline.landmark import Landmark, write_landmark
from pipeline.launch import run as launch
from pipeline.launch.run import claim_run, run_job
from pipeline.launch.tasks import in_process
from pipeline.metrics import ssim_11
from pipeline.photos import open_photos
from pipeline.protocol import check_protocols, parse_protocol
from pipeline.render import colour_view, predicted_mask, read_appearance, render_picture, render_view
from pipeline.runs import load_run
from pipeline.train import train
from pipeline.truth import check_truth, elsewhere, mask_iou, reduced, truth_of
from pipeline.work import Context

pytestmark = pytest.mark.slow  # half a minute together: not for every commit

STEP = "step-00000002"
ROWS = ("crossray", "nerf", "nerfw")


def landmark_job(folder, method="crossray", over=None, **scene):
    """A job of a few steps on the landmark in `folder`, by the fast field."""
    scene = {"downscale": 1, "reference_downscale": 2} | scene
    train_job = {"epochs": 1, "steps_per_epoch": 2}
    return tiny_job(
        folder, method, {"name": method, "scene": scene, "model": {"field": "hash"}, "train": train_job} | (over or {})
    )


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A small landmark, its shards, and a run of two steps for each of ROWS."""
    folder = tmp_path_factory.mktemp("truth")
    write_landmark(folder / "scene", train=8, val=1, test=3, size=32, mapper=in_process)
    job = landmark_job(folder)
    cut_shards(folder / "scene", job.shards, downscale=1, reference_downscale=2, plan=job.patch, mapper=in_process)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CROSSRAY_CACHE", str(folder / "cache"))
        for method in ROWS:
            job = landmark_job(folder, method)
            claim_run(job)
            train(job, Context())
    return folder


@pytest.fixture(autouse=True)
def _environment(trained, monkeypatch):
    monkeypatch.setenv("CROSSRAY_CACHE", str(trained / "cache"))
    monkeypatch.setattr(judge_module, "find_lpips", lambda: None)
    quick = {"mlp": FitRecipe(steps=7, rays=64), "hash": FitRecipe(steps=5, rays=64)}

    def parse(name):
        protocol, downscale = parse_protocol(name)
        return protocol.model_copy(update={"fit": quick}), downscale

    monkeypatch.setattr(module, "parse_protocol", parse)


@pytest.fixture
def run(trained, tmp_path):
    """run(method): a copy of a finished run, so that each test has its own eval folder."""

    def of(method="crossray"):
        return shutil.copytree(trained / "runs" / method, tmp_path / "runs" / method)

    return of


@pytest.fixture
def photos(trained):
    return open_photos(landmark_job(trained).shards)


@pytest.fixture
def landmark(trained):
    return Landmark.read(trained / "scene")


@pytest.fixture(scope="module")
def responsive(trained):
    """The trained model, its transform pushed so far that appearance visibly acts, after two steps already."""
    _, model, _ = load_run(trained / "runs" / "crossray")
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for layer in model.transform.shift:
            if hasattr(layer, "weight"):
                layer.weight.copy_(torch.randn(layer.weight.shape, generator=generator))
    return model


def judge(model, photos, landmark, name="cross@R1"):
    return Judge(model, photos, parse_protocol(name)[0], landmark)


# What is scored


def stored_clean(landmark, name):
    """The truth of a photo's own view and light, as it was written with the scene."""
    return np.asarray(Image.open(landmark.root / "truth" / name.replace(".png", ".clean.png")))


def test_cross_scores_whole_pictures_against_the_clean_truth(run, photos, landmark):
    folder = run()
    result = evaluate_run(folder, "cross@R1")
    out = folder / "eval" / "cross@R1" / STEP
    assert json.loads((out / "metrics.json").read_text()) == result
    assert (result["definition"]["scored"], result["definition"]["truth"]) == ("whole", "clean")
    assert len(result["images"]) == 3
    crowded = 0
    for row, index in zip(result["images"], photos.indices("test"), strict=True):
        prediction = np.asarray(Image.open(out / f"{row['key']}.png"))
        clean = stored_clean(landmark, photos.records[index].name)
        assert row["name"] == photos.records[index].name
        squared = (prediction / 255 - clean / 255) ** 2
        assert row["psnr"] == pytest.approx(-10 * np.log10(squared.mean()), abs=1e-9)
        assert row["ssim"] == pytest.approx(ssim_11(prediction, clean), abs=1e-9)
        crowded += (clean != photos.image(index)).any()
    assert crowded > 0  # else the photos would have done
    for metric in ("psnr", "ssim"):
        assert result["mean"][metric] == pytest.approx(np.mean([row[metric] for row in result["images"]]))


# What is seen of a test photo


class Doctored:
    """Photos of which the `changed` ones, and their references, are negatives."""

    def __init__(self, photos, changed):
        self.photos, self.changed = photos, changed

    def __getattr__(self, name):
        return getattr(self.photos, name)

    def image(self, i):
        return 255 - self.photos.image(i) if i in self.changed else self.photos.image(i)

    def reference(self, i):
        return 255 - self.photos.reference(i) if i in self.changed else self.photos.reference(i)


def test_the_appearance_comes_from_the_next_view_in_the_same_light(responsive, photos, landmark):
    test = photos.indices("test")
    pictures = []
    for index, following in zip(test, (*test[1:], test[0]), strict=True):
        seen, light = (photos.records[i] for i in (following, index))
        lent = Image.fromarray(landmark.truth(seen.name, light.name))
        half = lent.resize((seen.width // 2, seen.height // 2), Image.Resampling.LANCZOS)
        appearance = read_appearance(responsive, np.asarray(half))
        expected = render_picture(responsive, light, appearance)[1]
        picture = judge(responsive, photos, landmark).render(index).picture
        np.testing.assert_array_equal(picture, expected)
        own = render_picture(responsive, light, read_appearance(responsive, photos.reference(index)))[1]
        pictures.append(np.abs(picture - own).max())
    assert max(pictures) > 1e-3  # it does matter where the light is read


@pytest.mark.parametrize("method", ["crossray", "nerfw"])
def test_no_pixel_of_a_test_photo_is_seen_or_scored(trained, responsive, photos, landmark, method):
    model = responsive if method == "crossray" else load_run(trained / "runs" / method)[1]
    name = "cross@R1"
    plain, other = (
        Judge(model, p, module.parse_protocol(name)[0], landmark)
        for p in (photos, Doctored(photos, photos.indices("test")))
    )
    for index in photos.indices("test"):
        before, after = (j.render(index).picture for j in (plain, other))
        np.testing.assert_array_equal(before, after)
        rounded = (255 * before).round().astype(np.uint8)
        assert plain.score(rounded, index, None) == other.score(rounded, index, None)
    seen = Judge(model, Doctored(photos, photos.indices("test")), module.parse_protocol("crnerf-full@R1")[0], None)
    usual = Judge(model, photos, module.parse_protocol("crnerf-full@R1")[0], None)
    (index, *_) = photos.indices("test")
    assert (seen.render(index).picture != usual.render(index).picture).any()  # the paper's protocol does see them


def test_elsewhere_is_the_next_test_photo_and_the_first_after_the_last():
    class Three:
        def indices(self, split):
            return {"test": (3, 7, 9)}[split]

    assert [elsewhere(Three(), i) for i in (3, 7, 9)] == [7, 9, 3]


def test_one_test_photo_alone_cannot_be_judged_by_cross(trained, tmp_path):
    write_landmark(tmp_path / "scene", train=8, val=1, test=1, size=16)
    job = landmark_job(trained)
    alone = job.model_copy(update={"scene": job.scene.model_copy(update={"path": tmp_path / "scene"})})
    with pytest.raises(CrossrayError, match="one test photo"):
        check_truth(alone)


def test_the_affine_control_of_cross_is_refused(run):
    with pytest.raises(CrossrayError, match="affine"):
        evaluate_run(run("nerf"), "cross@R1+affine")


@pytest.mark.parametrize("factor", [1, 2, 5])
def test_a_lent_picture_is_reduced_as_the_shards_reduce_theirs(trained, tmp_path, factor):
    shards = tmp_path / "shards"
    job = landmark_job(trained)
    cut_shards(trained / "scene", shards, downscale=1, reference_downscale=factor, plan=job.patch, mapper=in_process)
    cut = open_photos(shards, tmp_path / "cache")
    for index in cut.indices("test"):
        np.testing.assert_array_equal(reduced(cut.image(index), factor), cut.reference(index))
    assert reduced(np.zeros((3, 40, 3), np.uint8), 8).shape == (1, 5, 3)


def test_under_cross_fit_moves_the_appearance_to_the_whole_other_view(responsive, photos, landmark, monkeypatch):
    """Nothing of the scored photo is seen, so nothing need be left out."""
    calls, fit_map = [], judge_module.fit_map
    monkeypatch.setattr(judge_module, "fit_map", lambda *a, **k: calls.append(a) or fit_map(*a, **k))
    test, name = photos.indices("test"), "cross@R1+fit"
    for index, following in zip(test, (*test[1:], test[0]), strict=True):
        picture = judge(responsive, photos, landmark, name).render(index).picture
        np.testing.assert_array_equal(
            judge(responsive, Doctored(photos, test), landmark, name).render(index).picture, picture
        )
        _, view, image, columns, _, start = calls[-1]
        seen, light = (photos.records[i] for i in (following, index))
        np.testing.assert_array_equal(image, landmark.truth(seen.name, light.name))
        assert columns == seen.width
        own = render_view(responsive, seen)
        torch.testing.assert_close(view.features, own.features)
        before = colour_view(responsive, own, start)
        after = colour_view(responsive, own, fit_map(*calls[-1]))
        assert np.square(after - image / 255).mean() < np.square(before - image / 255).mean()


# Learned codes


@pytest.fixture
def fitted(monkeypatch):
    """What every fit was asked for: (image, camera's name, columns, recipe)."""
    calls = []
    fit_code = judge_module.fit_code

    def spy(model, image, camera, columns, recipe, **kwargs):
        calls.append((image, camera.name, columns, recipe))
        return fit_code(model, image, camera, columns, recipe, **kwargs)

    monkeypatch.setattr(judge_module, "fit_code", spy)
    return calls


def test_under_cross_a_code_is_fitted_to_the_whole_other_view_in_the_same_light(run, photos, landmark, fitted):
    result = evaluate_run(run("nerfw"), "cross@R1")
    assert result["appearance_from"] == "elsewhere"
    names = [photos.records[i].name for i in photos.indices("test")]
    assert [camera for _, camera, _, _ in fitted] == [*names[1:], names[0]]
    for (image, camera, columns, recipe), light in zip(fitted, names, strict=True):
        np.testing.assert_array_equal(image, landmark.truth(camera, light))
        assert columns == image.shape[1]
        assert recipe == FitRecipe(steps=5, rays=64)  # the protocol's for this field


def test_protocols_of_one_run_share_the_codes_that_they_can(run, photos, fitted):
    folder = run("nerfw")
    protocols = ("crnerf-full@R1", "nerfw-half@R1", "cross@R1")
    job = load_run(folder)[0]
    job = job.model_copy(update={"evaluate": job.evaluate.model_copy(update={"protocols": protocols})})
    results = run_protocols(job)
    assert [r["appearance_from"] for r in results] == ["left", "left", "elsewhere"]
    records = [photos.records[i] for i in photos.indices("test")]
    left = [(camera, columns) for image, camera, columns, _ in fitted if columns < image.shape[1]]
    assert left == [(record.name, -(-record.width // 2)) for record in records]
    assert len(fitted) == 3 + 3  # left halves once for two protocols, other views once
    for protocol, result in zip(protocols, results, strict=True):  # and nothing is another than by itself
        assert evaluate_run(folder, protocol)["images"] == result["images"]
    assert len(fitted) == 6 + 9


def test_what_is_scored_already_is_not_fitted_again(run, fitted):
    folder = run("nerfw")
    evaluate_run(folder, "nerfw-half@R1")
    job = load_run(folder)[0]
    job = job.model_copy(update={"evaluate": job.evaluate.model_copy(update={"protocols": ("nerfw-half@R1",)})})
    fitted.clear()
    run_protocols(job)
    assert fitted == []


# Masks


class Masked:
    """Two photos of four and of two pixels, and the truth about them."""

    TRUE = ([[True, True, False, False]], [[False, True]])
    PREDICTED = ([[0.9, 0.5, 0.2, 0.6]], [[0.1, 0.7]])

    class Record:
        def __init__(self, name):
            self.name = name

    records = (Record("0"), Record("1"))

    def mask(self, name):
        return np.array(self.TRUE[int(name)])


def test_mask_iou_by_hand(monkeypatch):
    """Found {0, 3} of {0, 1}, then {1} of {1}: pooled, 2 of 4 pixels; 0.5 is not over the threshold."""
    scene = Masked()
    monkeypatch.setattr(truth_module, "predicted_mask", lambda model, photos, i: np.array(scene.PREDICTED[i]))
    assert mask_iou(None, scene, scene, (0, 1)) == pytest.approx(2 / 4)
    assert mask_iou(None, scene, scene, (0,)) == pytest.approx(1 / 3)
    assert mask_iou(None, scene, scene, (1,)) == 1.0
    monkeypatch.setattr(truth_module, "predicted_mask", lambda model, photos, i: None)
    assert mask_iou(None, scene, scene, (0, 1)) is None


class Masking:
    """All that a judge of masks asks a model."""

    def __init__(self, transient):
        self.spec = ModelSpec(transient=transient)


@pytest.mark.parametrize(("count", "step"), [(1, 1), (8, 1), (32, 1), (33, 2), (64, 2), (65, 3)])
def test_masks_are_compared_on_up_to_32_training_photos(monkeypatch, count, step):
    class Many:
        def indices(self, split):
            return {"train": tuple(range(100, 100 + count))}[split]

    asked = []
    monkeypatch.setattr(
        judge_module, "mask_iou", lambda model, photos, landmark, indices: asked.append(indices) or 0.25
    )
    assert judge(Masking("segmenter"), Many(), landmark=object()).masks() == {"mask_iou": 0.25}
    assert asked == [tuple(range(100, 100 + count, step))]
    assert judge(Masking("segmenter"), Many(), landmark=None).masks() == {}
    assert judge(Masking("fixed"), Many(), landmark=object()).masks() == {}  # its masks were given to it


@pytest.mark.parametrize("method", ROWS)
def test_cross_tells_how_well_masks_agree(run, photos, landmark, method):
    folder = run(method)
    result = evaluate_run(folder, "cross@R1")
    if method == "nerf":
        assert "mask_iou" not in result["mean"]
        return
    model = load_run(folder)[1]
    train = photos.indices("train")
    found = np.concatenate([(predicted_mask(model, photos, i) > 0.5).ravel() for i in train])
    true = np.concatenate([landmark.mask(photos.records[i].name).ravel() for i in train])
    assert result["mean"]["mask_iou"] == pytest.approx((found & true).sum() / max(1, (found | true).sum()))
    assert all("mask_iou" not in row for row in result["images"])
    assert "mask_iou" not in evaluate_run(folder, "crnerf-full@R1")["mean"]  # there the truth is not known


# Who is refused, and when


@pytest.fixture
def nothing_starts(monkeypatch):
    """Neither shards nor training are begun."""

    def started(*_):
        raise AssertionError("began before the protocols were checked")

    for name in ("ensure_shards", "claim_run", "run_local"):
        monkeypatch.setattr(launch, name, started)


def test_a_scene_without_truth_is_refused_before_training(tmp_path, nothing_starts):
    write_tiny_scene(tmp_path / "scene")
    job = landmark_job(tmp_path, over={"evaluate": {"protocols": ["crnerf-full@R1", "cross@R1"]}})
    with pytest.raises(CrossrayError, match=r"scene\.path: .* holds no truth; only the built-in landmark"):
        run_job(job)
    assert not (tmp_path / "runs").exists()


def test_photos_of_another_size_than_the_truth_are_refused_before_training(trained, nothing_starts, tmp_path):
    runs = str(tmp_path / "runs")
    job = landmark_job(trained, over={"runs": runs, "evaluate": {"protocols": ["cross@R2"]}}, downscale=2)
    with pytest.raises(CrossrayError, match=r"scene\.downscale: .* at R2; train with --set scene\.downscale=1"):
        run_job(job)
    job = landmark_job(trained, over={"runs": runs, "evaluate": {"protocols": ["cross@R2"]}})
    with pytest.raises(CrossrayError, match=r"cross@R2.*at R1"):
        run_job(job)
    assert not (tmp_path / "runs").exists()


def test_the_landmark_is_accepted(trained):
    job = landmark_job(trained, over={"evaluate": {"protocols": ["cross@R1", "crnerf-full@R1"]}})
    check_protocols(job)
    check_truth(job)


def test_other_protocols_need_no_truth(tmp_path):
    write_tiny_scene(tmp_path / "scene")
    check_protocols(
        landmark_job(tmp_path, over={"evaluate": {"protocols": ["nerfw-half@R2", "crnerf-full@R2"]}}, downscale=2)
    )


def test_truth_of_other_photos_is_refused(trained, tmp_path, photos):
    write_landmark(tmp_path / "scene", train=8, val=1, test=3, size=16, mapper=in_process)
    job = landmark_job(tmp_path)
    with pytest.raises(CrossrayError, match=r"the truth of 00009\.png is 16 x 9 pixels, its photo 32 x 18"):
        truth_of(job, photos)
    assert truth_of(landmark_job(trained), photos).names("test") == ["00009.png", "00010.png", "00011.png"]


def test_an_evaluation_without_truth_says_so_too(run, trained):
    folder = run()
    path = folder / "job.yaml"
    path.write_text(path.read_text().replace(str(trained / "scene"), str(folder / "nowhere")))
    with pytest.raises(CrossrayError, match=r"nowhere is not there.*`crossray landmark"):
        evaluate_run(folder, "cross@R1")
    assert not (folder / "eval").exists()
