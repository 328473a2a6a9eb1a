"""The commands of nerfbaselines, as a user types them: train, render, evaluate, test-method."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tarfile

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("nerfbaselines.evaluation", reason="nerfbaselines is not installed: make test-nerfbaselines")

from nerfbaselines_data import tiny, write_lpips, write_torchvision

from pipeline.judge import score
from pipeline.lpips import read_lpips
from pipeline.protocol import parse_protocol

STEPS = 12


@pytest.fixture(scope="module")
def nerfbaselines(tmp_path_factory):
    """Runs one of its commands; returns what it printed."""
    folder = tmp_path_factory.mktemp("commands")
    environment = os.environ | {
        "PYTHONPATH": str(write_torchvision(folder / "modules")),
        "NERFBASELINES_PREFIX": str(folder / "prefix"),
        "NERFBASELINES_NO_UPDATE_CHECK": "1",
        "HOME": str(folder),
    }

    def run(*arguments, status=0):
        command = [sys.executable, "-m", "nerfbaselines", *(str(a) for a in arguments)]
        done = subprocess.run(command, env=environment, cwd=folder, capture_output=True, text=True, timeout=300)
        assert done.returncode == status, done.stdout[-3000:] + done.stderr[-3000:]
        return done.stdout + done.stderr

    return run


def settings(**over):
    return [part for key, value in tiny(**over).items() for part in ("--set", f"{key}={value}")]


@pytest.fixture(scope="module")
def output(nerfbaselines, scene, tmp_path_factory):
    """What `nerfbaselines train` leaves behind."""
    folder = tmp_path_factory.mktemp("output")
    nerfbaselines(
        *("train", "--method", "crossray", "--backend", "python", "--data", scene, "--output", folder),
        *("--eval-few-iters", 6, "--save-iters", 6, *settings()),
    )
    return folder


@pytest.fixture(scope="module")
def predictions(output, tmp_path_factory):
    """Its predictions, unpacked."""
    folder = tmp_path_factory.mktemp("predictions")
    with tarfile.open(output / f"predictions-{STEPS}.tar.gz") as tar:
        tar.extractall(folder, filter="data")
    return folder


def pictures(folder):
    return {path.name: np.asarray(Image.open(path)) for path in sorted(folder.iterdir())}


def test_training_evaluates_under_nerfw(output):
    results = json.loads((output / f"results-{STEPS}.json").read_text())
    information = results["nb_info"]
    assert information["method"] == "crossray"
    assert information["evaluation_protocol"] == results["evaluation_protocol"] == "nerfw"
    assert information["num_iterations"] == STEPS
    assert information["hparams"]["train.steps_per_epoch"] == 6
    assert {"psnr", "ssim", "lpips"} <= results["metrics"].keys()
    assert (output / f"checkpoint-{STEPS}" / "nb-info.json").is_file()


def test_its_scores_are_those_of_our_protocol(output, predictions, tmp_path):
    """nerfw-half on the same pictures: all metrics to 1e-4, and SSIM's and LPIPS's networks are the same."""
    results = json.loads((output / f"results-{STEPS}.json").read_text())
    protocol, lpips = parse_protocol("nerfw-half@R1")[0], read_lpips(write_lpips(tmp_path / "lpips.safetensors"))
    rendered, truth = pictures(predictions / "color"), pictures(predictions / "gt-color")
    assert len(rendered) == 2
    ours = [score(rendered[name], truth[name], protocol, lpips, name) for name in rendered]
    for metric in ("psnr", "ssim", "lpips"):
        mean = float(np.mean([one[metric] for one in ours]))
        assert results["metrics"][metric] == pytest.approx(mean, abs=1e-4), metric
    assert ours[0] != ours[1]


def test_a_checkpoint_renders_and_evaluates_to_the_same_scores(nerfbaselines, output, predictions, scene, tmp_path):
    checkpoint = output / f"checkpoint-{STEPS}"
    nerfbaselines(
        "render", "--checkpoint", checkpoint, "--backend", "python", "--data", scene, "--output", tmp_path / "p"
    )
    again, before = pictures(tmp_path / "p" / "color"), pictures(predictions / "color")
    assert again.keys() == before.keys()
    assert all(np.array_equal(again[name], before[name]) for name in before)
    nerfbaselines("evaluate", tmp_path / "p", "--output", tmp_path / "results.json")
    first, second = (
        json.loads(path.read_text()) for path in (output / f"results-{STEPS}.json", tmp_path / "results.json")
    )
    assert second["metrics"] == {name: first["metrics"][name] for name in second["metrics"]}
    assert second["nb_info"]["checkpoint_sha256"] == first["nb_info"]["checkpoint_sha256"]


def test_a_training_goes_on_from_a_checkpoint(nerfbaselines, output, scene, tmp_path):
    """Its settings come from the checkpoint, and it ends with the same bytes."""
    nerfbaselines(
        *("train", "--method", "crossray", "--backend", "python", "--data", scene, "--output", tmp_path),
        *("--checkpoint", output / "checkpoint-6", "--eval-all-iters", STEPS + 1),
    )
    ours = "job.yaml", "model.safetensors", "optimiser.safetensors", "scene.safetensors", "checkpoint.json"
    one, other = (folder / f"checkpoint-{STEPS}" for folder in (output, tmp_path))
    assert all((one / name).read_bytes() == (other / name).read_bytes() for name in ours)


def test_a_camera_path_fades_from_one_appearance_to_another(nerfbaselines, output, photos, tmp_path):
    """render-trajectory: embeddings of training photos come from the checkpoint alone, and are mixed."""
    from nerfbaselines.io import save_trajectory

    camera = photos["cameras"][0]
    frames = [
        {"pose": camera.poses, "intrinsics": camera.intrinsics, "appearance_weights": np.array(w, np.float32)}
        for w in ([1, 0], [0.5, 0.5], [0, 1])
    ]
    trajectory = {
        "camera_model": "pinhole",
        "image_size": tuple(int(n) for n in camera.image_sizes),
        "frames": frames,
        "appearances": [{"embedding_train_index": 0}, {"embedding_train_index": 3}],
        "fps": 2.0,
        "source": None,
    }
    with (tmp_path / "path.json").open("w") as file:
        save_trajectory(trajectory, file)
    nerfbaselines(
        *("render-trajectory", "--checkpoint", output / f"checkpoint-{STEPS}", "--backend", "python"),
        *("--trajectory", tmp_path / "path.json", "--output", tmp_path / "frames"),
        *("--output-names", "color,depth,accumulation"),
    )
    assert sorted(path.name for path in (tmp_path / "frames").iterdir()) == ["accumulation", "color", "depth"]
    assert len(pictures(tmp_path / "frames" / "color")) == 3


def test_nerfbaselines_own_test_of_a_method_passes(nerfbaselines, scene):
    """Saving, loading, rendering the same, a whole training, and evaluation of what it left."""
    printed = nerfbaselines(
        *("test-method", "--method", "crossray", "--backend", "python", "--data", scene, "--steps", STEPS),
        *settings(),
    )
    assert "All tests passed" in printed
    for line in ("Resaving method yields same checkpoint", "Checkpoint reproduces results"):
        assert line in printed


def test_a_wrong_setting_ends_with_its_message(nerfbaselines, scene, tmp_path):
    printed = nerfbaselines(
        *("train", "--method", "crossray", "--backend", "python", "--data", scene, "--output", tmp_path),
        *("--set", "train.epoch=1"),
        status=1,
    )
    assert "train.epoch: there is no such key; did you mean 'epochs'?" in printed
