"""The method as nerfbaselines calls it: its contract, and what is refused."""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("nerfbaselines.evaluation", reason="nerfbaselines is not installed: make test-nerfbaselines")

from nerfbaselines_data import only, tiny

from pipeline.checkpoint import CheckpointError
from pipeline.errors import CrossrayError
from pipeline.metrics import to_8bit
from pipeline.nerfbaselines.method import Crossray
from pipeline.published import published_tables
from pipeline.render import colour_view, read_appearance, render_view


def hashes(folder):
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.iterdir())}


def saved(method, folder):
    method.save(str(folder))
    return folder


def left(dataset):
    from nerfbaselines.datasets.phototourism import horizontal_half_dataset

    return horizontal_half_dataset(dataset)


def mean_square(a, b):
    return float(np.mean((a.astype(np.float64) - b) ** 2))


@pytest.fixture(scope="module")
def checkpoint(trained, tmp_path_factory):
    return saved(trained, tmp_path_factory.mktemp("checkpoint") / "one")


# ------------------------------------------------------------------------------------------------------ what it is


def test_it_is_what_nerfbaselines_calls_a_method(trained):
    import nerfbaselines

    assert isinstance(trained, nerfbaselines.Method)
    info = trained.get_info()
    assert (info["method_id"], info["num_iterations"], info["loaded_step"]) == ("crossray", 60, None)
    assert info["batch_size"] == 2 * 8 * 8
    assert info["hparams"]["model.channels"] == 8
    assert json.loads(json.dumps(info["hparams"])) == info["hparams"]


def test_the_papers_scores_say_their_protocol(tmp_path):
    found = asked_of_nerfbaselines("json.dumps(nerfbaselines.get_method_spec('crossray'))", tmp_path)
    spec = json.loads(found)
    assert spec["method_class"] == "pipeline.nerfbaselines.method:Crossray"
    assert spec["backends_order"] == ["python"]  # it is found by its entry point
    results = spec["metadata"]["paper_results"]
    assert sorted(results) == [f"phototourism/{s}" for s in ("brandenburg-gate", "sacre-coeur", "trevi-fountain")]
    theirs = published_tables()["comparison-R2"]["crnerf"]["trevi_fountain"]
    assert {k: v for k, v in results["phototourism/trevi-fountain"].items() if k != "note"} == theirs
    for result in results.values():
        assert "whole test photo" in result["note"]


def test_the_spec_is_read_by_its_path_and_without_torch(tmp_path):
    """NERFBASELINES_REGISTER, where no entry point is installed."""
    from pipeline.nerfbaselines import __file__ as package

    found = asked_of_nerfbaselines(
        "(nerfbaselines.get_method_spec('crossray')['id'], 'torch' in sys.modules)",
        tmp_path,
        before="import nerfbaselines._registry as r; r.entry_points = lambda group: metadata.EntryPoints()",
        NERFBASELINES_REGISTER=str(Path(package).with_name("spec.py")),
    )
    assert found == "('crossray', False)"


def asked_of_nerfbaselines(expression, folder, before="", **environment):
    """What a new process prints: the package's own metadata lie beside these tests, and would be read instead."""
    program = f"import json, sys, importlib.metadata as metadata, nerfbaselines\n{before}\nprint({expression})"
    done = subprocess.run(
        [sys.executable, "-c", program],
        env={"PATH": "/usr/bin:/bin", "HOME": str(folder), **environment},
        cwd=folder,
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    return done.stdout.strip()


# ------------------------------------------------------------------------------------------- training, checkpoints


def test_training_learns_and_says_so(trained, photos):
    fresh = Crossray(train_dataset=photos, config_overrides=tiny())
    first = fresh.train_iteration(0)
    assert trained.numbers["psnr"] > first["psnr"]
    assert first["loss"] == pytest.approx(sum(v for k, v in first.items() if k not in ("loss", "psnr")))
    assert fresh.train_iteration(1) == first  # the device is asked every tenth step


def test_the_same_state_is_saved_as_the_same_bytes(trained, checkpoint, tmp_path):
    assert hashes(saved(trained, tmp_path / "again")) == hashes(checkpoint)
    loaded = Crossray(checkpoint=str(checkpoint))
    assert hashes(saved(loaded, tmp_path / "loaded")) == hashes(checkpoint)
    info = loaded.get_info()
    assert (info["loaded_step"], info["loaded_checkpoint"], info["num_iterations"]) == (60, str(checkpoint), 60)


def test_a_loaded_method_renders_the_same(trained, checkpoint, views, photos):
    camera = views["cameras"][1]
    for loaded in (Crossray(checkpoint=str(checkpoint)), Crossray(checkpoint=str(checkpoint), train_dataset=photos)):
        for embedding in (None, trained.get_train_embedding(4)):
            one, other = (m.render(camera, options={"embedding": embedding}) for m in (trained, loaded))
            for name in ("color", "depth", "accumulation"):
                assert np.array_equal(one[name], other[name]), name


def test_a_training_in_bfloat16_is_rendered_in_float32_before_and_after_it_was_saved(photos, views, tmp_path):
    method = Crossray(train_dataset=photos, config_overrides=tiny(train__precision="bfloat16"))
    for step in range(3):
        method.train_iteration(step)
    before = method.render(views["cameras"][0])
    assert method.model.use_bfloat16
    after = Crossray(checkpoint=str(saved(method, tmp_path / "one"))).render(views["cameras"][0])
    assert all(np.array_equal(before[name], after[name]) for name in before)


def test_a_stopped_training_goes_on_to_the_bit(photos, tmp_path):
    overrides = tiny()
    straight, first = (Crossray(train_dataset=photos, config_overrides=overrides) for _ in range(2))
    for step in range(12):
        straight.train_iteration(step)
    for step in range(5):
        first.train_iteration(step)
    second = Crossray(checkpoint=str(saved(first, tmp_path / "five")), train_dataset=photos, config_overrides=overrides)
    assert second.get_info()["loaded_step"] == 5
    for step in range(5, 12):
        second.train_iteration(step)
    assert hashes(saved(second, tmp_path / "second")) == hashes(saved(straight, tmp_path / "straight"))


def test_nothing_is_gone_on_from_with_other_photos_or_settings(checkpoint, photos):
    changed = photos.copy()
    changed["images"] = [255 - image for image in photos["images"]]
    with pytest.raises(CrossrayError, match="step 60 was trained with other photos:"):
        Crossray(checkpoint=str(checkpoint), train_dataset=changed)
    with pytest.raises(CrossrayError, match="step 60 was trained with other settings:"):
        Crossray(checkpoint=str(checkpoint), train_dataset=photos, config_overrides={"losses.mask_end": "0.5"})
    again = Crossray(checkpoint=str(checkpoint), train_dataset=photos, config_overrides=tiny(train__steps_per_epoch=30))
    assert again.get_info()["loaded_step"] == 60


def test_a_checkpoint_without_photos_is_not_trained(checkpoint):
    with pytest.raises(CrossrayError, match="without a training data set"):
        Crossray(checkpoint=str(checkpoint)).train_iteration(60)


@pytest.mark.parametrize("name", ["checkpoint.json", "model.safetensors", "optimiser.safetensors", "scene.safetensors"])
def test_a_damaged_checkpoint_is_refused(checkpoint, tmp_path, name):
    folder = shutil.copytree(checkpoint, tmp_path / "copy")
    content = (folder / name).read_bytes()
    (folder / name).write_bytes(content[: len(content) // 2])
    with pytest.raises(CheckpointError, match="cannot be read"):
        Crossray(checkpoint=str(folder))
    (folder / name).unlink()
    with pytest.raises(CheckpointError, match=f"{name}: missing"):
        Crossray(checkpoint=str(folder))


def test_numbers_that_are_not_finite_reach_no_checkpoint(photos, tmp_path):
    method = Crossray(train_dataset=photos, config_overrides=tiny())
    with torch.no_grad():
        next(method.model.decoder.parameters()).fill_(torch.nan)
    with pytest.raises(CrossrayError, match=r"not finite|finite"):
        method.train_iteration(0)
    with pytest.raises(CrossrayError, match="not finite"):
        method.save(str(tmp_path / "bad"))
    assert not (tmp_path / "bad").exists()


# ---------------------------------------------------------------------------------------------------------- pictures


def test_a_picture_is_that_of_our_own_renderer(trained, photos, views):
    """The colour rounded to 8 bits, the depth in the data set's units; wanted outputs alone."""
    view = photos["cameras"][2]  # whose camera the training has, too
    camera = trained.work.data.photos.records[2]
    appearance = read_appearance(trained.model, trained.work.data.photos.reference(2))
    rendered = render_view(trained.model.eval(), camera)
    picture = colour_view(trained.model, rendered, appearance)
    trained.model.train()
    found = trained.render(view, options={"embedding": trained.get_train_embedding(2)})
    assert found["color"].dtype == np.uint8
    assert found["color"].shape == (*rendered.size, 3)
    assert np.abs(found["color"].astype(int) - to_8bit(picture, "round")).max() <= 1  # bounds agree to 1e-5
    depth = trained.scene.scale * rendered.depth / rendered.accumulation.clamp(min=1e-3)
    np.testing.assert_allclose(found["depth"], depth, rtol=1e-3)
    np.testing.assert_allclose(found["accumulation"], rendered.accumulation, atol=1e-3)
    assert list(trained.render(view, options={"outputs": ("depth",)})) == ["depth"]
    assert trained.model.training


def test_nerfbaselines_keeps_the_rounded_levels(trained, views):
    from nerfbaselines.utils import image_to_srgb

    color = trained.render(views["cameras"][0])["color"]
    assert np.array_equal(image_to_srgb(color, np.uint8, color_space="srgb"), color)


def test_without_an_embedding_the_mean_of_the_training_photos_is_used(trained, views):
    camera = views["cameras"][0]
    mean = np.mean([trained.get_train_embedding(i) for i in range(7)], axis=0)
    one, other = (trained.render(camera, options={"embedding": e})["color"] for e in (None, mean))
    assert np.abs(one.astype(int) - other).max() <= 1
    assert trained.mean is not None
    trained.mean = None


def test_a_camera_that_sees_no_point_has_the_widest_bounds(trained, views):
    camera = views["cameras"][0]
    pose = camera.poses.copy()
    pose[:, 1:3] *= -1  # it looks the other way
    pose[:, 3] += 1e3 * pose[:, 2]
    away = trained.camera(camera.replace(poses=pose))
    records = trained.work.data.photos.records
    assert (away.near, away.far) == (min(r.near for r in records), max(r.far for r in records))


# -------------------------------------------------------------------------------------------------------- appearance


def test_the_left_half_of_a_photo_decides_the_light(trained, views):
    """What is read is F^a of what is given, and a dark half makes another picture than a bright one."""
    half = left(only(views, 0))
    assert half["images"][0].shape[1] == 56
    found = trained.optimize_embedding(half)["embedding"]
    own = read_appearance(trained.model, np.ascontiguousarray(half["images"][0]))
    np.testing.assert_allclose(found, own.flatten(), atol=1e-6)
    pictures = []
    for value in (0, 255):
        lit = {**half, "images": [np.full_like(half["images"][0], value)]}
        options = {"embedding": trained.optimize_embedding(lit)["embedding"]}
        pictures.append(trained.render(views["cameras"][0], options=options)["color"])
    assert mean_square(*pictures) > 1


@pytest.mark.parametrize("over", [{}, {"method": "hanerf", "model.field": "hash", "patch.size": 16}])
def test_a_fit_comes_closer_to_the_half_than_what_was_read(photos, views, tmp_path, over):
    """`fit` starts from what the encoder read, and moves nothing but the appearance; a checkpoint remembers it."""
    method = Crossray(train_dataset=photos, config_overrides=tiny(**over) | {"fit": "true"})
    for step in range(12):
        method.train_iteration(step)
    half = left(only(views, 0))
    before = {k: v.clone() for k, v in method.model.state_dict().items()}
    fitted = method.optimize_embedding(half)["embedding"]
    loaded = Crossray(checkpoint=str(saved(method, tmp_path / "one")))  # goes on fitting
    assert np.array_equal(loaded.optimize_embedding(half)["embedding"], fitted)
    method.fits = False
    read = method.optimize_embedding(half)["embedding"]
    assert all(torch.equal(v, before[k]) for k, v in method.model.state_dict().items())
    errors = []
    for embedding in (read, fitted):
        color = method.render(half["cameras"][0], options={"embedding": embedding})["color"]
        errors.append(mean_square(color, half["images"][0]))
    assert errors[1] < errors[0]


def test_learned_codes_are_fitted_and_start_where_they_are_told(photos, views):
    over = {"method": "nerfw", "model.field": "hash"}
    method = Crossray(train_dataset=photos, config_overrides=tiny(**over))
    for step in range(12):
        method.train_iteration(step)
    half, mean = left(only(views, 0)), method.mean_appearance()
    found = method.optimize_embedding(half)["embedding"]
    errors = [
        mean_square(method.render(half["cameras"][0], options={"embedding": e})["color"], half["images"][0])
        for e in (mean.numpy(), found)
    ]
    assert errors[1] < errors[0]
    assert not np.array_equal(method.optimize_embedding(half, embedding=found)["embedding"], found)
    weights = method.model.embedding.weight
    assert np.array_equal(method.get_train_embedding(3), weights[3].detach().numpy())
    np.testing.assert_allclose(mean[0], weights.detach().mean(0), atol=1e-6)


def test_a_method_without_appearance_has_no_embedding(photos, views):
    method = Crossray(train_dataset=photos, config_overrides=tiny(method="nerf"))
    method.train_iteration(0)
    assert method.get_train_embedding(0) is None
    with pytest.raises(NotImplementedError, match="appearance: none"):
        method.optimize_embedding(left(only(views, 0)))
    assert method.render(views["cameras"][1])["color"].shape == views["images"][1].shape


def test_embeddings_are_kept_and_interpolated(trained, checkpoint, views):
    """Of every training photo, also without the photos; a mixture is an embedding."""
    loaded = Crossray(checkpoint=str(checkpoint))
    all_of_them = [loaded.get_train_embedding(i) for i in range(7)]
    for i, one in enumerate(all_of_them):
        assert one.dtype == np.float32
        assert np.array_equal(one, trained.get_train_embedding(i))
    weights = np.full(7, 1 / 7, np.float32)
    loaded.render(views["cameras"][0], options={"embedding": weights @ np.stack(all_of_them)})


# ----------------------------------------------------------------------------------------------------- what is refused


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"train.second": "5"}, "did you mean 'seconds'"),
        ({"train.seconds": "5"}, "nerfbaselines counts steps"),
        ({"ranks": 2}, "one process"),
        ({"method": "crnerf-a-masks"}, "reads masks from shards"),
        ({"fit": "perhaps"}, "neither true nor false"),
        ({"method": "crnerf", "scene.reference_downscale": 16}, "scene.reference_downscale: 16 makes"),
    ],
)
def test_settings_without_meaning_here_are_refused(photos, overrides, message):
    with pytest.raises(CrossrayError, match=message):
        Crossray(train_dataset=photos, config_overrides=overrides)


def test_nothing_to_train_or_render_is_refused():
    with pytest.raises(CrossrayError, match="neither a checkpoint nor"):
        Crossray()


@pytest.mark.parametrize("count", [0, 511, 8 * 64 + 1])
def test_embeddings_of_another_shape_are_refused(trained, views, count):
    with pytest.raises(CrossrayError, match=f"an embedding of {count} numbers"):
        trained.render(views["cameras"][0], options={"embedding": np.zeros(count, np.float32)})
