"""Released checkpoints become runs of ours: whole and to the bit, or not at all, with every name that does not fit."""

from __future__ import annotations

import argparse
import hashlib
import json
import logging
import os
import sys
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from tiny_run import assert_same_bits, cut_tiny, tiny_mapping
from torch import Tensor

from model.appearance.crossray import recolour
from model.released import CRNERF, TRAINING_ONLY
from model.scene_model import SceneModel
from pipeline import cli, importing
from pipeline.checkpoint import CheckpointError, latest_checkpoint
from pipeline.config import Job, make_job, merge
from pipeline.errors import CrossrayError
from pipeline.importing import import_checkpoint, networks
from pipeline.photos import open_photos
from pipeline.render import colour_view, read_appearance, render_view
from pipeline.runs import load_run
from pipeline.train import build_model, build_optimiser, train
from pipeline.work import Context

pytestmark = pytest.mark.slow

MLP = {"width": 256, "xyz_frequencies": 15, "dir_frequencies": 4, "coarse_samples": 6, "fine_samples": 6}


@pytest.fixture(scope="module")
def cut(tmp_path_factory):
    return cut_tiny(tmp_path_factory.mktemp("importing"))


@pytest.fixture(autouse=True)
def _cache(cut, monkeypatch):
    monkeypatch.setenv("CROSSRAY_CACHE", str(cut / "cache"))


@pytest.fixture
def mapping(cut, tmp_path):
    """mapping(over): a job file whose networks have the released sizes."""

    def make(over: dict[str, Any] | None = None) -> dict[str, Any]:
        sizes = {"runs": str(tmp_path / "runs"), "name": "released", "model": {"mlp": MLP}}
        return merge(tiny_mapping(cut, "crnerf", sizes), over or {})

    return make


@pytest.fixture
def job(mapping):
    return make_job(mapping())


@pytest.fixture(scope="module")
def model(cut) -> SceneModel:
    """Networks with weights that no seed of a job gives."""
    job = make_job(tiny_mapping(cut, "crnerf", {"model": {"mlp": MLP}, "patch": {"seed": 77}}))
    return build_model(job, open_photos(job.shards, cut / "cache"), torch.device("cpu"))


@pytest.fixture
def state(model) -> dict[str, Tensor]:
    return released_state(model)


def released_state(model: SceneModel) -> dict[str, Tensor]:
    """A model's numbers under the released names and in the released shapes."""
    state: dict[str, Tensor] = OrderedDict()
    for prefix, part in networks(model).items():
        ours = part.state_dict()
        for theirs, name in CRNERF[prefix].items():
            pointwise = prefix.startswith("decoder.") and theirs.endswith("weight") and ".fc." not in theirs
            state[prefix + theirs] = ours[name][..., None, None] if pointwise else ours[name]
    state["decoder.decoder.rgb_upsample.1.f"] = torch.ones(3)
    return state


class FakeCallback:
    """Stands for a class of Lightning's that is not installed here."""


class Attack:
    """Pickles as a call of os.system."""

    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self):
        return os.system, (f"touch {self.target}",)


def write_checkpoint(path: Path, state: dict[str, Tensor], **over: Any) -> Path:
    """A checkpoint as Lightning writes it."""
    content = {
        "epoch": 19,
        "global_step": 600_000,
        "pytorch-lightning_version": "1.8.4",
        "state_dict": state,
        "loops": {"fit_loop": {"state_dict": {}, "epoch_progress": {"current": {"ready": 20}}}},
        "callbacks": {FakeCallback: {"best_model_score": np.float64(0.5), "dirpath": Path("/save")}},
        "optimizer_states": [{"state": {0: {"step": 7, "exp_avg": torch.ones(3)}}, "param_groups": [{"lr": 5e-4}]}],
        "lr_schedulers": [{"T_max": 20, "last_epoch": 19}],
        "hparams_name": "hparams",
        "hyper_parameters": argparse.Namespace(N_vocab=1500, img_wh=[320, 240], encode_a=True),
    } | over
    torch.save({key: value for key, value in content.items() if value is not None}, path)
    return path


@pytest.fixture
def checkpoint(tmp_path, state):
    """checkpoint(state, **entries): a file; without a state, the whole one."""

    def write(changed: dict[str, Tensor] | None = None, **over: Any) -> Path:
        return write_checkpoint(tmp_path / "CR-NeRF.ckpt", state if changed is None else changed, **over)

    return write


@pytest.fixture
def crossray(monkeypatch, capsys):
    """crossray(*words): exit status, standard output, standard error."""
    logger = logging.getLogger("crossray")
    before = logger.handlers[:], logger.level, logger.propagate
    monkeypatch.setenv("COLUMNS", "200")

    def run(*words: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["crossray", *map(str, words)])
        try:
            cli.main()
            status = 0
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else int(end.code is not None)
        out, err = capsys.readouterr()
        return status, out, err

    yield run
    logger.handlers[:], logger.level, logger.propagate = before


def nothing_is_left(job: Job) -> bool:
    return not job.runs.exists() or not list(job.runs.iterdir())


# A whole checkpoint


def test_a_checkpoint_becomes_a_run(job, checkpoint, model):
    file = checkpoint()
    assert import_checkpoint(file, job) == job.run
    loaded_job, loaded, found = load_run(job.run)
    assert loaded_job.model == job.model
    for prefix, part in networks(loaded).items():
        assert_same_bits(dict(part.state_dict()), dict(networks(model)[prefix].state_dict()), prefix)
    assert found.step == 600_000
    assert found.folder.name == "step-00600000"
    assert (found.meta["finished"], found.meta["seconds"], found.meta["world_size"]) == (True, 0.0, 1)
    fresh = build_optimiser(build_model(job, open_photos(job.shards), torch.device("cpu")), job.train)
    assert_same_bits(found.optimiser(), fresh.state_dict())
    assert sorted(path.name for path in job.run.iterdir()) == ["checkpoints", "imported.json", "job.yaml"]
    assert [path.name for path in job.runs.iterdir()] == ["released"]


def test_the_record_says_where_it_comes_from_and_what_was_not_used(job, checkpoint):
    file = checkpoint()
    import_checkpoint(file, job)
    record = json.loads((job.run / "imported.json").read_text())
    assert record == {
        "source": "CR-NeRF.ckpt",
        "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
        "global_step": 600_000,
        "epoch": 19,
        "entries_not_used": [
            "callbacks",
            "hparams_name",
            "hyper_parameters",
            "loops",
            "lr_schedulers",
            "optimizer_states",
            "pytorch-lightning_version",
        ],
        "networks_not_used": [],
        "networks_not_in_the_file": [],
        "objects_not_made": record["objects_not_made"],
    }
    assert "argparse.Namespace" in record["objects_not_made"]
    assert any(name.endswith(".FakeCallback") for name in record["objects_not_made"])


def test_a_run_that_was_imported_can_be_trained_further(mapping, checkpoint, monkeypatch):
    """Its record is what training writes: the same job goes on from it."""
    job = make_job(mapping({"train": {"epochs": 3, "steps_per_epoch": 1}, "patch": {"photos": 1}}))
    import_checkpoint(checkpoint(global_step=2), job)
    result = train(job, Context())
    assert (result["steps"], result["finished"]) == (3, True)
    found = latest_checkpoint(job.run / "checkpoints")
    assert found is not None
    assert found.step == 3


def test_the_record_of_the_checkpoint_has_what_training_writes(mapping, checkpoint):
    job = make_job(mapping({"train": {"epochs": 1, "steps_per_epoch": 1}, "patch": {"photos": 1}}))
    train(job, Context())
    trained = latest_checkpoint(job.run / "checkpoints")
    imported = make_job(mapping({"name": "b", "train": {"epochs": 1, "steps_per_epoch": 1}, "patch": {"photos": 1}}))
    import_checkpoint(checkpoint(), imported)
    found = latest_checkpoint(imported.run / "checkpoints")
    assert trained is not None
    assert found is not None
    assert found.meta.keys() == trained.meta.keys()
    for key in found.meta.keys() - {"step", "seconds", "sha256", "digest"}:
        assert found.meta[key] == trained.meta[key], key
    assert_same_bits({k: v.shape for k, v in found.model.items()}, {k: v.shape for k, v in trained.model.items()})


def test_a_checkpoint_that_is_plain_data_and_one_without_a_step_are_read(job, checkpoint):
    import_checkpoint(checkpoint(callbacks=None, hyper_parameters=None, global_step=None, epoch=None), job)
    record = json.loads((job.run / "imported.json").read_text())
    assert (record["global_step"], record["epoch"], record["objects_not_made"]) == (0, None, [])
    assert load_run(job.run)[2].step == 0


def test_names_of_data_parallel_and_of_an_unwrapped_decoder_are_understood(job, checkpoint, state, model):
    for prefix in ("decoder.multi_net.", "decoder.decoder."):
        state = {name.replace(prefix, "decoder.", 1): value for name, value in state.items()}
    import_checkpoint(checkpoint({f"module.{name}": value for name, value in state.items()}), job)
    loaded = load_run(job.run)[1]
    assert torch.equal(loaded.transform.content.read_off.weight, model.transform.content.read_off.weight)
    assert torch.equal(loaded.decoder.linear.weight, model.decoder.linear.weight)


def test_what_serves_training_only_may_be_absent(job, checkpoint, state, caplog):
    state = {name: value for name, value in state.items() if not name.startswith(TRAINING_ONLY)}
    with caplog.at_level(logging.INFO, "crossray"):
        import_checkpoint(checkpoint(state), job)
    assert "enc_cont, implicit_mask. They serve training only and keep their initial weights" in caplog.text
    initial = build_model(job, open_photos(job.shards), torch.device("cpu"))
    loaded = load_run(job.run)[1]
    assert torch.equal(loaded.content_encoder.layers[1].weight, initial.content_encoder.layers[1].weight)
    assert torch.equal(loaded.segmenter.classifier.weight, initial.segmenter.classifier.weight)
    assert not torch.equal(loaded.encoder.layers[1].weight, initial.encoder.layers[1].weight)
    record = json.loads((job.run / "imported.json").read_text())
    assert record["networks_not_in_the_file"] == ["enc_cont", "implicit_mask"]


def test_a_job_without_a_segmenter_leaves_it_out(mapping, checkpoint):
    job = make_job(mapping({"method": "crnerf-a"}))
    import_checkpoint(checkpoint(), job)
    assert load_run(job.run)[1].segmenter is None
    assert json.loads((job.run / "imported.json").read_text())["networks_not_used"] == ["implicit_mask"]


# Refusals


def test_every_name_that_does_not_fit_is_named_and_nothing_is_written(job, checkpoint, state):
    del state["nerf_fine.static_sigma.0.bias"]
    del state["implicit_mask.classifier.0.conv.weight"]
    state["enc_a.conv1.weight"] = torch.zeros(3, 3, 3, 3)
    state["decoder.multi_net.cnet.fc.bias"] = torch.zeros(7)
    state["enc_a.conv9.weight"] = torch.zeros(1)
    state["embedding_view.weight"] = torch.zeros(1500, 128)
    with pytest.raises(CheckpointError) as caught:
        import_checkpoint(checkpoint(state), job)
    message = str(caught.value)
    assert "CR-NeRF.ckpt: this is no released CR-NeRF" in message
    assert "unknown: embedding_view.weight" in message
    assert "unknown: enc_a.conv9.weight" in message
    assert "missing: nerf_fine.static_sigma.0.bias" in message
    assert "missing: implicit_mask.classifier.0.conv.weight" in message
    assert "enc_a.conv1.weight has shape (3, 3, 3, 3), layers.0.weight needs (3, 3, 1, 1)" in message
    assert "decoder.multi_net.cnet.fc.bias has shape (7,)" in message
    assert nothing_is_left(job)


@pytest.mark.parametrize("prefix", [prefix for prefix in CRNERF if prefix not in TRAINING_ONLY])
def test_no_network_that_a_picture_needs_may_be_absent(prefix, job, checkpoint, state):
    state = {name: value for name, value in state.items() if not name.startswith(prefix)}
    with pytest.raises(CheckpointError) as caught:
        import_checkpoint(checkpoint(state), job)
    assert all(prefix + name in str(caught.value) for name in CRNERF[prefix])
    assert nothing_is_left(job)


def test_a_name_in_two_places_is_unknown(job, checkpoint, state):
    state["decoder.compress.bias"] = state["decoder.multi_net.compress.bias"]
    with pytest.raises(CheckpointError, match=r"unknown: decoder\.compress\.bias$"):
        import_checkpoint(checkpoint(state), job)


def test_numbers_that_are_not_finite_are_refused(job, checkpoint, state):
    state["enc_a.conv1.bias"] = torch.tensor([0.0, float("nan"), 1.0])
    with pytest.raises(CheckpointError, match=r"not finite .*encoder\.layers\.0\.bias"):
        import_checkpoint(checkpoint(state), job)


@pytest.mark.parametrize("step", [-1, 10**8, 2**70, 1.5, "7", True, torch.tensor(3)])
def test_a_step_that_is_none_is_refused(step, job, checkpoint):
    with pytest.raises(CheckpointError, match="global_step"):
        import_checkpoint(checkpoint(global_step=step), job)
    assert nothing_is_left(job)


@pytest.mark.parametrize(
    ("content", "match"),
    [
        ([1, 2], "has no state_dict"),
        ({"model": {}, "iter\x1b[2J": 3}, r"has no state_dict \(it has: model, 'iter"),
        ({"state_dict": {}}, "has no state_dict"),
        ({"state_dict": [torch.ones(1)]}, "has no state_dict"),
        ({"state_dict": {"a": torch.ones(1), "b": 3, 7: torch.ones(1), "c\n": torch.ones(1)}}, "are no tensors"),
    ],
)
def test_what_is_no_lightning_checkpoint_is_refused(content, match, job, tmp_path):
    torch.save(content, tmp_path / "a.ckpt")
    with pytest.raises(CheckpointError, match=match) as caught:
        import_checkpoint(tmp_path / "a.ckpt", job)
    assert "\x1b" not in str(caught.value)
    assert nothing_is_left(job)


def test_an_attack_is_neither_run_nor_hidden(job, checkpoint, tmp_path, state):
    import_checkpoint(checkpoint(callbacks={"a": Attack(tmp_path / "proof")}), job)
    assert not (tmp_path / "proof").exists()
    assert f"{os.system.__module__}.system" in json.loads((job.run / "imported.json").read_text())["objects_not_made"]

    other = job.model_copy(update={"name": "other"})
    with pytest.raises(CheckpointError, match=r"are no tensors with a name: enc_a\.conv1\.bias$"):
        import_checkpoint(checkpoint(state | {"enc_a.conv1.bias": Attack(tmp_path / "proof")}), other)
    assert not (tmp_path / "proof").exists()
    assert not other.run.exists()


@pytest.mark.parametrize(
    ("over", "keys"),
    [
        ({"model": {"mlp": {"width": 128, "xyz_frequencies": 10}}}, ["mlp.width: 128", "mlp.xyz_frequencies: 10"]),
        ({"model": {"transform": "mean_only"}}, ["transform: mean_only"]),
        ({"model": {"encoder": "compact", "channels": 32}}, ["encoder: compact", "channels: 32"]),
        ({"model": {"segmenter": "unet"}}, ["segmenter: unet"]),
        ({"model": {"pixel_center": 0.5}}, ["pixel_center: 0.5"]),
        ({"method": "crossray"}, ["field: hash", "encoder: compact", "pixel_center: 0.5"]),
        ({"method": "nerf"}, ["colour: head", "appearance: none", "fused: none"]),
        ({"method": "crnerf-r"}, ["fused: point"]),
        ({"method": "crnerf-u"}, ["transient: uncertainty"]),
    ],
)
def test_a_job_of_other_networks_is_refused_with_its_keys(over, keys, mapping, checkpoint):
    job = make_job(mapping(over))
    with pytest.raises(CrossrayError) as caught:
        import_checkpoint(checkpoint(), job)
    assert all(f"model.{key}, but the released networks have" in str(caught.value) for key in keys), caught.value
    assert nothing_is_left(job)


def test_a_run_that_is_there_is_left_alone(job, checkpoint):
    file = checkpoint()
    import_checkpoint(file, job)
    before = {path: path.stat().st_mtime_ns for path in job.run.rglob("*")}
    with pytest.raises(CrossrayError, match="holds a run already"):
        import_checkpoint(file, job)
    assert before == {path: path.stat().st_mtime_ns for path in job.run.rglob("*")}


def test_an_import_that_fails_midway_leaves_nothing_and_can_be_repeated(job, checkpoint, monkeypatch):
    file = checkpoint()

    def full(*args: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(importing, "save_checkpoint", full)
        with pytest.raises(OSError, match="No space"):
            import_checkpoint(file, job)
    assert nothing_is_left(job)
    import_checkpoint(file, job)
    assert load_run(job.run)[2].step == 600_000


def test_shards_that_are_absent_or_of_another_size_are_refused_with_what_to_do(mapping, checkpoint, tmp_path):
    file = checkpoint()
    job = make_job(mapping({"scene": {"shards": str(tmp_path / "none")}}))
    with pytest.raises(CrossrayError, match=rf"crossray shard \S+scene --out {tmp_path / 'none'} --downscale 2"):
        import_checkpoint(file, job)
    job = make_job(mapping({"scene": {"downscale": 4}}))
    with pytest.raises(CrossrayError, match=r"scene\.downscale: the job says 4, but .* were cut with 2"):
        import_checkpoint(file, job)


def test_the_command_says_what_is_wrong(mapping, tmp_path, crossray):
    path = tmp_path / "job.yaml"
    path.write_text(yaml.safe_dump(mapping()))
    (tmp_path / "a.ckpt").write_bytes(b"<html>")
    for words, match in (
        ((tmp_path / "none.ckpt", path), "there is no such file"),
        ((tmp_path / "a.ckpt", path), "not a file of torch.save"),
        ((tmp_path / "a.ckpt", path, "--set", "model.fused=point"), "model.fused: point"),
    ):
        status, out, err = crossray("import-checkpoint", *words)
        assert (status, "Traceback" in out + err) == (2, False)
        assert match in err


# The released numbers


def golden_state(golden) -> dict[str, Tensor]:
    """A whole state dict, put together from the golden files of its networks."""
    sources = {
        "nerf_coarse.": ("nerf_mlp", "param/"),
        "nerf_fine.": ("nerf_mlp", "param/"),
        "enc_a.": ("appearance_encoder", "param/"),
        "enc_cont.": ("appearance_encoder", "param/"),
        "decoder.": ("transform", "param/"),
        "implicit_mask.": ("segmenter", "param/"),
    }
    state: dict[str, Tensor] = OrderedDict()
    for prefix, (file, below) in sources.items():
        for name, value in golden(file).items():
            if name.startswith(below):
                state[prefix + name.removeprefix(below)] = value
    return state


@pytest.mark.real
def test_golden_networks_come_through_the_command_line(golden, mapping, tmp_path, crossray):
    path = tmp_path / "job.yaml"
    path.write_text(yaml.safe_dump(mapping()))
    file = write_checkpoint(tmp_path / "CR-NeRF.ckpt", golden_state(golden))
    run = tmp_path / "runs" / "released"
    status, out, err = crossray("import-checkpoint", file, path)
    assert status == 0, err
    assert "crossray evaluate" in out.replace("\n", " ")
    assert "argparse.Namespace" in out + err

    job, model, _ = load_run(run)
    with torch.no_grad():
        mlp = golden("nerf_mlp")
        for network in (model.field.coarse, model.field.fine):
            density, features = network(mlp["in/xyz"], mlp["in/dir"])
            close(density, mlp["out/sigma"].flatten(), 2e-5)
            close(features, mlp["out/feature"], 2e-5)
        encoder = golden("appearance_encoder")
        for network in (model.encoder, model.content_encoder):
            close(network(encoder["in/image_a"]), encoder["out/embedding_a"], 2e-5)
        transform = golden("transform")
        F = transform["in/F_cr"].flatten(2).mT
        A, b = model.colour_map(model.transform.content_statistics(F), transform["in/F_a"])
        close(recolour(F, A, b), transform["out/rgb"].flatten(2).mT, 1e-5)
        segmenter = golden("segmenter")
        close(model.segmenter(segmenter["in/image"]), segmenter["out/eval/logit_eighth"], 3e-5)

    photos = open_photos(job.shards)
    view = render_view(model, photos.records[0], stride=3)
    picture = colour_view(model, view, read_appearance(model, photos.reference(0)))
    assert picture.shape == (*view.size, 3)
    assert np.isfinite(picture).all()
    assert picture.std() > 0


def close(found: Tensor, expected: Tensor, tolerance: float) -> None:
    torch.testing.assert_close(found, expected, atol=tolerance, rtol=0)
