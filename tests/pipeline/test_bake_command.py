"""`crossray bake`: what it writes, that it can be opened again and gives the model's own pictures; what it refuses."""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from tiny_run import cut_tiny, tiny_job

from model.methods import MLPSpec, ModelSpec
from model.scene_model import SceneModel
from pipeline import cli
from pipeline.appearances import find_appearance, fixed_statistics, read_picture
from pipeline.bake import (
    PREVIEW,
    RECORD,
    WEIGHTS,
    bake_run,
    load_baked,
)
from pipeline.checkpoint import MODEL
from pipeline.errors import CrossrayError
from pipeline.files import sha256_of
from pipeline.launch.run import claim_run
from pipeline.photos import open_photos
from pipeline.render import colour_view, grid_statistics, interpolated, read_appearance, render_baked, render_view
from pipeline.runs import load_run
from pipeline.train import train
from pipeline.work import Context


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Finished runs of two steps: `running`, of `crossray`, and `plain`, of `crnerf-b` on the fast field."""
    folder = cut_tiny(tmp_path_factory.mktemp("bake"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CROSSRAY_CACHE", str(folder / "cache"))
        for name, method, model in (
            ("running", "crossray", {"statistics": "running"}),
            ("plain", "crnerf-b", {"field": "hash", "channels": 8}),
        ):
            over = {"name": name, "model": model, "train": {"epochs": 1, "steps_per_epoch": 2}}
            job = tiny_job(folder, method, over)
            claim_run(job)
            train(job, Context())
    return folder


@pytest.fixture(autouse=True)
def _environment(trained, monkeypatch):
    monkeypatch.setenv("CROSSRAY_CACHE", str(trained / "cache"))


@pytest.fixture
def run(trained, tmp_path):
    """run(name, policy): a copy of a finished run, by the name or by another policy."""

    def copied(name="running", policy="running"):
        folder = shutil.copytree(trained / "runs" / name, tmp_path / "runs" / name)
        job = folder / "job.yaml"
        job.write_text(job.read_text().replace("statistics: running", f"statistics: {policy}"))
        return folder

    return copied


@pytest.fixture
def photos(trained):
    return open_photos(tiny_job(trained).shards)


@pytest.fixture
def crossray(monkeypatch, capsys):
    """crossray(*words): exit status, standard output, standard error without line breaks."""

    def call(*words: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["crossray", *map(str, words)])
        monkeypatch.setenv("COLUMNS", "400")
        status = 0
        try:
            cli.main()
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else 0
        out, err = capsys.readouterr()
        return status, out, err

    return call


def picture_file(path: Path, size: tuple[int, int] = (40, 30), mode: str = "RGB", **save) -> Path:
    pixels = np.random.default_rng(0).integers(0, 256, (size[1], size[0], 3), np.uint8)
    Image.fromarray(pixels).convert(mode).save(path, **save)
    return path


def expected_picture(folder: Path, content, appearance: torch.Tensor | None, index: int, photos) -> np.ndarray:
    """A view of the run's model, unbaked."""
    model = load_run(folder)[1]
    view = render_view(model, photos.records[index])
    with torch.no_grad():
        return model.colours(view.features[None], appearance, content)[0].view(*view.size, 3).numpy()


# What is written


def test_bake_writes_what_gives_the_model_s_own_pictures(crossray, run, photos):
    folder = run()
    status, out, _ = crossray("bake", folder, "--appearance", "photo_001.jpg")
    assert status == 0
    target = folder / "baked" / "photo_001"
    assert f"{target}: baked" in out
    assert {p.name for p in target.iterdir()} == {WEIGHTS, RECORD, PREVIEW}
    baked, record = load_baked(target)
    model, checkpoint = load_run(folder)[1:3]
    appearance = read_appearance(model, photos.reference(1))
    for index in (0, 3):
        picture = render_baked(baked, photos.records[index])[1]
        view = render_view(model, photos.records[index])
        np.testing.assert_allclose(picture, colour_view(model, view, appearance), atol=1e-5)
    assert record["appearances"] == [{"photo": "photo_001.jpg", "sha256": photos.records[1].source_sha256}]
    assert (record["format"], record["method"], record["step"], record["share"]) == (1, "crossray", 2, None)
    assert record["checkpoint_sha256"] == checkpoint.meta["sha256"][MODEL]
    assert record["statistics"] == "running averages of the training"
    assert record["spec"]["channels"] == 8
    assert record["provenance"]["hardware"]
    assert record["sha256"] == {name: sha256_of(target / name) for name in (WEIGHTS, PREVIEW)}


def test_the_preview_shows_the_first_test_view_first(run, photos):
    target = bake_run(run(), "photo_001.jpg")
    with Image.open(target / PREVIEW) as image:
        preview = np.asarray(image)
    assert preview.shape == (18, 4 * 24, 3)
    first = render_baked(load_baked(target).model, photos.records[photos.indices("test")[0]])[1]
    assert np.abs(preview[:, :24] / 255 - first).max() < 0.51 / 255


@pytest.mark.parametrize("policy", ["view", "patch"])
def test_statistics_of_a_view_are_averaged_over_training_views(run, photos, policy):
    folder = run(policy=policy)
    target = bake_run(folder, "photo_001.jpg")
    model = load_run(folder)[1]
    found = [grid_statistics(model, photos.records[i]) for i in photos.indices("train")]
    content, words = fixed_statistics(model, photos)
    torch.testing.assert_close(content.mean, sum(f.mean for f in found) / 4)
    torch.testing.assert_close(content.gram, sum(f.gram for f in found) / 4)
    assert words == f"{policy}: average over 4 training views"
    baked, record = load_baked(target)
    assert record["statistics"] == words
    expected = expected_picture(folder, content, read_appearance(model, photos.reference(1)), 3, photos)
    np.testing.assert_allclose(render_baked(baked, photos.records[3])[1], expected, atol=1e-5)


def test_an_appearance_between_two(crossray, run, photos):
    folder = run()
    words = ("--appearance", "photo_001.jpg", "--towards", "photo_002.jpg", "--share", 0.3)
    assert crossray("bake", folder, *words)[0] == 0
    baked, record = load_baked(folder / "baked" / "photo_001-photo_002-0.3")
    assert (record["share"], len(record["appearances"])) == (0.3, 2)
    model = load_run(folder)[1]
    a, b = (read_appearance(model, photos.reference(i)) for i in (1, 2))
    expected = colour_view(model, render_view(model, photos.records[3]), interpolated(a, b, 0.3))
    np.testing.assert_allclose(render_baked(baked, photos.records[3])[1], expected, atol=1e-5)


def test_a_decoder_without_an_appearance(run, photos):
    folder = run("plain")
    baked, record = load_baked(bake_run(folder, "photo_001.jpg"))
    expected = expected_picture(folder, None, None, 3, photos)
    np.testing.assert_allclose(render_baked(baked, photos.records[3])[1], expected, atol=1e-5)
    assert record["statistics"].startswith("none")


def test_out_names_the_folder_and_step_the_checkpoint(crossray, run, tmp_path):
    folder = run()
    target = tmp_path / "elsewhere" / "here"
    words = ("bake", folder, "--appearance", "photo_001.jpg", "--out", target)
    assert crossray(*words, "--step", 2)[0] == 0
    assert load_baked(target).record["step"] == 2
    assert crossray(*words)[0] == 0  # again: written anew
    status, _, err = crossray(*words, "--step", 7)
    assert status == 2
    assert "no checkpoint of step 7; there are 2" in err


# Image files


@pytest.mark.parametrize(("mode", "suffix"), [("RGB", "png"), ("L", "png"), ("RGBA", "png"), ("CMYK", "jpg"),
                                              ("P", "png"), ("1", "png"), ("I;16", "png")])  # fmt: skip
def test_an_image_file_of_any_kind(run, tmp_path, mode, suffix):
    path = tmp_path / f"outside.{suffix}"
    if mode == "I;16":
        Image.fromarray(np.arange(1200, dtype=np.uint16).reshape(30, 40) * 50).save(path)
    else:
        picture_file(path, mode=mode)
    pixels = read_picture(path)
    assert (pixels.shape, pixels.dtype) == ((30, 40, 3), np.uint8)
    with Image.open(path) as image:
        if mode != "I;16":
            assert np.array_equal(pixels, np.asarray(image.convert("RGB")))
    if mode in ("L", "CMYK"):
        record = load_baked(bake_run(run(), str(path))).record
        assert record["appearances"] == [{"photo": path.name, "sha256": sha256_of(path)}]


def test_exif_orientation_is_ignored(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6  # lies on its side
    path = picture_file(tmp_path / "turned.jpg", exif=exif)
    assert read_picture(path).shape == (30, 40, 3)


def test_a_file_is_reduced_as_references_are(run, tmp_path, photos, monkeypatch):
    seen = []
    monkeypatch.setattr("pipeline.appearances.read_appearance", lambda model, picture: seen.append(picture.shape))
    model = load_run(run())[1]
    path = picture_file(tmp_path / "outside.png", (43, 31))
    find_appearance(model, photos, str(path))
    monkeypatch.setattr(photos, "manifest", photos.manifest.model_copy(update={"reference_downscale": 4}))
    find_appearance(model, photos, str(path))
    assert seen == [(31, 43, 3), (7, 10, 3)]


# What is refused


def test_wrong_input_is_one_message(crossray, run, tmp_path):
    folder = run()
    text = tmp_path / "text.png"
    text.write_text("not a picture")
    for words, part in (
        (("photo_01.jpg",), "photo_01.jpg: neither an image file nor the name of a photo of the scene; did you mean"),
        ((tmp_path,), "neither an image file"),
        ((text,), "text.png: cannot be read as an image"),
        (("photo_001.jpg", "--towards", "photo_002.jpg", "--share", "1.5"), "share 1.5: it must lie within 0"),
        (("photo_001.jpg", "--towards", "photo_002.jpg", "--share", "nan"), "share nan"),
        (("photo_001.jpg", "--towards", "none.jpg"), "none.jpg: neither"),
        (("photo_001.jpg", "--share", "0.3"), "--share 0.3: how far to go to a second photo; --towards names it"),
    ):
        status, out, err = crossray("bake", folder, "--appearance", *words)
        assert (status, "Traceback" in out + err) == (2, False)
        assert part in err, err
    assert not (folder / "baked").exists()
    status, _, err = crossray("bake", tmp_path, "--appearance", "photo_001.jpg")
    assert status == 2
    assert "is not a run" in err


def test_a_photo_that_the_encoder_cannot_read_is_refused(photos, tmp_path):
    model = SceneModel(ModelSpec(mlp=MLPSpec(width=8)), torch.zeros(2, 3))
    with pytest.raises(CrossrayError, match=r"small.png: 7 x 40 pixels of it are read for its appearance"):
        find_appearance(model, photos, str(picture_file(tmp_path / "small.png", (7, 40))))


def test_a_method_that_cannot_be_baked_is_refused_with_the_reason(crossray, run, monkeypatch):
    folder = run()
    job, model, checkpoint = load_run(folder)
    coded = job.model_copy(update={"model": replace(job.model, appearance="code", fused="point"), "method": "hanerf"})
    monkeypatch.setattr("pipeline.bake.load_run", lambda run, step: (coded, model, checkpoint))
    status, _, err = crossray("bake", folder, "--appearance", "photo_001.jpg")
    assert status == 2
    assert "method hanerf: model.appearance: code cannot be baked: its code is an input of the network" in err


def test_a_folder_that_holds_something_else_is_left_alone(run, tmp_path):
    folder, target = run(), tmp_path / "target"
    target.mkdir()
    (target / "diary.txt").write_text("mine")
    with pytest.raises(CrossrayError, match=r"holds diary.txt, which is no baked appearance"):
        bake_run(folder, "photo_001.jpg", out=target)
    (target / "diary.txt").unlink()
    bake_run(folder, "photo_001.jpg", out=target)
    with pytest.raises(CrossrayError, match="holds another baked appearance"):
        bake_run(folder, "photo_002.jpg", out=target)
    (target / RECORD).unlink()  # not completed: anybody's
    bake_run(folder, "photo_002.jpg", out=target)


@pytest.mark.parametrize("damage", ["flip", "cut", "no weights", "no record", "edited", "not json", "format"])
def test_a_damaged_folder_is_a_clear_error(run, damage):
    target = bake_run(run(), "photo_001.jpg")
    weights, record = target / WEIGHTS, target / RECORD
    content, said = bytearray(weights.read_bytes()), json.loads(record.read_text())
    part = WEIGHTS
    if damage == "flip":
        content[-5] ^= 1
        weights.write_bytes(content)
    elif damage == "cut":
        weights.write_bytes(content[:100])
    elif damage == "no weights":
        weights.unlink()
    else:
        part = RECORD if damage != "not json" else str(target)
        if damage == "no record":
            record.unlink()
        elif damage == "edited":
            record.write_text(json.dumps(said | {"step": 4}))
        elif damage == "format":
            record.write_text(json.dumps(said | {"format": 9}))
        else:
            record.write_text("{")
    with pytest.raises(CrossrayError, match=part):
        load_baked(target)
