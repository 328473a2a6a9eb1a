"""LPIPS from a weights file: found, refused, and equal to the public values."""

from __future__ import annotations

import json
import sys
import types
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import save_file

from pipeline.errors import CrossrayError
from pipeline.lpips import CONVOLUTIONS, LPIPS, VARIABLE, find_lpips


@pytest.fixture(scope="module")
def weights() -> dict[str, torch.Tensor]:
    """Random ones of the right shapes; heads are positive, as LPIPS's are."""
    generator = torch.Generator().manual_seed(0)
    out = {}
    for level, (index, (inputs, outputs, kernel, _, _)) in enumerate(CONVOLUTIONS.items()):
        scale = (2 / (inputs * kernel**2)) ** 0.5
        shape = (outputs, inputs, kernel, kernel)
        out[f"features.{index}.weight"] = torch.randn(shape, generator=generator) * scale
        out[f"features.{index}.bias"] = torch.randn(outputs, generator=generator) * 0.1
        out[f"lin{level}.model.1.weight"] = torch.rand(1, outputs, 1, 1, generator=generator)
    return out


@pytest.fixture
def weights_file(weights, tmp_path) -> Path:
    path = tmp_path / "weights.npz"
    np.savez(path, **{name: value.numpy() for name, value in weights.items()})
    return path


@pytest.fixture(autouse=True)
def no_variable(monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)


def picture(seed: int, size: tuple[int, int] = (40, 33)) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (*size, 3), dtype=np.uint8)


def test_distance_is_zero_to_itself_symmetric_and_grows(weights):
    lpips = LPIPS(weights, "test")
    a, b = picture(0), picture(1)
    near = (0.9 * a + 0.1 * b).astype(np.uint8)
    assert lpips.distance(a, a) == 0.0
    assert lpips.distance(a, b) == pytest.approx(lpips.distance(b, a))
    assert 0 < lpips.distance(a, near) < lpips.distance(a, b)


def test_it_is_frozen_and_learns_nothing(weights):
    assert not any(p.requires_grad for p in LPIPS(weights, "test").parameters())


def test_the_file_is_found_by_argument_and_by_variable(weights_file, weights, tmp_path, monkeypatch):
    expected = LPIPS(weights, "test").distance(picture(0), picture(1))
    found = find_lpips(weights_file)
    assert found is not None
    assert found.distance(picture(0), picture(1)) == expected

    save_file(weights, tmp_path / "weights.safetensors")
    monkeypatch.setenv(VARIABLE, str(tmp_path / "weights.safetensors"))
    found = find_lpips()
    assert found is not None
    assert found.distance(picture(0), picture(1)) == expected


def test_none_where_there_is_nothing(monkeypatch):
    monkeypatch.setitem(sys.modules, "lpips", None)  # makes the import fail
    assert find_lpips() is None


def test_the_packages_are_used_only_where_alexnet_lies_already(weights, tmp_path, monkeypatch):
    """With stand-ins for both packages, whose names of weights are the real ones."""
    slices = {f"features.{index}": f"net.slice{i + 1}.{index}" for i, index in enumerate(CONVOLUTIONS)}
    state = {}
    for name, value in weights.items():
        stem, part = name.rsplit(".", 1)
        state[f"{slices.get(stem, stem)}.{part}"] = value

    lpips = types.ModuleType("lpips")
    lpips.LPIPS = lambda net, verbose: types.SimpleNamespace(state_dict=lambda: state)  # type: ignore[attr-defined]
    torchvision = types.ModuleType("torchvision")
    url = "https://example.org/models/alexnet.pth"
    torchvision.models = types.SimpleNamespace(  # type: ignore[attr-defined]
        AlexNet_Weights=types.SimpleNamespace(IMAGENET1K_V1=types.SimpleNamespace(url=url))
    )
    monkeypatch.setitem(sys.modules, "lpips", lpips)
    monkeypatch.setitem(sys.modules, "torchvision", torchvision)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    assert find_lpips() is None

    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "alexnet.pth").touch()
    found = find_lpips()
    assert found is not None
    expected = LPIPS(weights, "test").distance(picture(0), picture(1))
    assert found.distance(picture(0), picture(1)) == expected


def test_a_missing_or_damaged_file_is_named(tmp_path):
    with pytest.raises(CrossrayError, match=r"absent\.npz"):
        find_lpips(tmp_path / "absent.npz")
    for name in ("text.npz", "text.safetensors"):
        (tmp_path / name).write_text("no weights")
        with pytest.raises(CrossrayError, match=name):
            find_lpips(tmp_path / name)
    np.save(tmp_path / "one.npy", np.zeros(3))
    with pytest.raises(CrossrayError, match=r"one\.npy"):
        find_lpips(tmp_path / "one.npy")


@pytest.mark.parametrize("key", ["features.6.bias", "lin3.model.1.weight"])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda value: None, "lacks"),
        (lambda value: value[:, :0], "shape"),
        (lambda value: value * np.nan, "finite"),
    ],
)
def test_a_wrong_weight_is_named(weights_file, key, change, message):
    with np.load(weights_file) as arrays:
        content = dict(arrays)
    value = content.pop(key)
    changed = change(value if value.ndim > 1 else value[:, None])
    if changed is not None:
        content[key] = changed if changed.size == 0 else changed.reshape(value.shape)
    np.savez(weights_file, **content)
    with pytest.raises(CrossrayError, match=message) as caught:
        find_lpips(weights_file)
    assert key in str(caught.value)
    assert str(weights_file) in str(caught.value)


def test_pictures_that_do_not_fit_are_refused(weights):
    lpips = LPIPS(weights, "test")
    with pytest.raises(ValueError, match=r"\(40, 33, 3\).*\(39, 33, 3\)"):
        lpips.distance(picture(0), picture(0)[1:])
    with pytest.raises(ValueError, match="float64"):
        lpips.distance(picture(0) / 255, picture(0) / 255)
    with pytest.raises(ValueError, match="31"):
        lpips.distance(picture(0)[:30], picture(1)[:30])
    assert lpips.distance(picture(0)[:31, :31], picture(1)[:31, :31]) > 0


@pytest.mark.parametrize("size", [(31, 31), (33, 47), (64, 31), (40, 33)])
def test_odd_and_least_sizes_have_a_distance(weights, size):
    distance = LPIPS(weights, "test").distance(picture(0, size), picture(1, size))
    assert np.isfinite(distance)
    assert distance > 0


@pytest.mark.parametrize("value", [0, 128, 255])
def test_constant_pictures_have_a_distance(weights, value):
    lpips, flat = LPIPS(weights, "test"), np.full((40, 33, 3), value, np.uint8)
    assert lpips.distance(flat, flat) == 0.0
    assert 0 < lpips.distance(flat, picture(0)) < np.inf


def test_one_pixel_and_none_are_refused(weights):
    lpips = LPIPS(weights, "test")
    for size in ((1, 1), (0, 0), (30, 100), (100, 30)):
        with pytest.raises(ValueError, match="31"):
            lpips.distance(picture(0, size), picture(0, size))


def test_a_named_file_that_is_absent_is_never_left_out_quietly(tmp_path, monkeypatch):
    monkeypatch.setenv(VARIABLE, str(tmp_path / "gone.npz"))
    with pytest.raises(CrossrayError, match=rf"gone\.npz.*unset {VARIABLE}"):
        find_lpips()


@pytest.mark.parametrize("suffix", ["npz", "compressed.npz", "safetensors"])
def test_a_damaged_file_is_refused_wherever_it_is_damaged(weights, tmp_path, suffix):
    """Cut anywhere, or with bytes changed in its tables: one clear error, or it reads as if nothing had happened."""
    small = {name: value[:1, :1].contiguous() for name, value in weights.items() if value.ndim > 1}
    path = tmp_path / f"weights.{suffix}"
    if suffix == "safetensors":
        save_file(small, path)
    else:
        save = np.savez_compressed if suffix.startswith("compressed") else np.savez
        save(path, **{name: value.numpy() for name, value in small.items()})
    whole, generator = path.read_bytes(), np.random.default_rng(0)
    damaged = [whole[:cut] for cut in np.linspace(0, len(whole) - 1, 40, dtype=int)]
    for _ in range(100):
        content = bytearray(whole)
        content[generator.integers(len(content))] = generator.integers(256)
        damaged.append(bytes(content))
    for content in damaged:
        path.write_bytes(content)
        with pytest.raises(CrossrayError) as caught:  # it lacks most weights, so whole files are refused as well
            find_lpips(path)
        assert str(path) in str(caught.value)


@pytest.mark.real
def test_golden_lpips(test_data):
    folder = test_data / "lpips"
    lpips = find_lpips(folder / "lpips_alex.npz")
    assert lpips is not None
    reference = np.array(Image.open(folder / "ex_ref.png").convert("RGB"))
    for name, expected in json.loads((folder / "golden.json").read_text())["computed"]["alex"].items():
        if name.startswith("ex_"):
            other = np.array(Image.open(folder / f"{name}.png").convert("RGB"))
            assert lpips.distance(reference, other) == pytest.approx(expected, abs=1e-4)
