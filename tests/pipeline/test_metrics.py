"""PSNR and both SSIMs."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pipeline.metrics import psnr, ssim_11, ssim_window3, ssim_window3_map, to_8bit

SCORES = {"psnr": psnr, "ssim_window3": ssim_window3, "ssim_11": ssim_11}


def picture(seed: int, size: tuple[int, int] = (13, 17)) -> np.ndarray:
    return np.random.default_rng(seed).random((*size, 3))


def test_psnr_by_hand():
    truth = np.zeros((2, 2, 3))
    assert psnr(truth + 0.1, truth) == pytest.approx(20.0)
    assert psnr(np.full((2, 2, 3), 255, np.uint8), np.zeros((2, 2, 3), np.uint8)) == 0.0


@pytest.mark.parametrize(("name", "best"), [("psnr", math.inf), ("ssim_window3", 1.0), ("ssim_11", 1.0)])
def test_identical_pictures_score_best(name, best):
    assert SCORES[name](picture(0), picture(0)) == pytest.approx(best)


@pytest.mark.parametrize("name", SCORES)
def test_uint8_is_the_same_as_float_and_may_be_mixed(name):
    a, b = (to_8bit(picture(seed), "round") for seed in (0, 1))
    score = SCORES[name]
    assert score(a, b) == pytest.approx(score(a / 255, b / 255), abs=1e-9)
    assert score(a, b / 255) == pytest.approx(score(a, b), abs=1e-9)
    assert score(a, b) == pytest.approx(score(b, a))


def slow_ssim_map(x: np.ndarray, y: np.ndarray, window: int) -> np.ndarray:
    """Pixel by pixel, for one channel, inside a border of half the window."""
    r = window // 2
    axis = np.exp(-(np.arange(-r, r + 1) ** 2) / (2 * 1.5**2))
    kernel = np.outer(axis, axis) / axis.sum() ** 2
    out = np.empty((x.shape[0] - 2 * r, x.shape[1] - 2 * r))
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            a, b = (z[i : i + window, j : j + window] for z in (x, y))
            ma, mb = (kernel * a).sum(), (kernel * b).sum()
            va, vb = (kernel * (a - ma) ** 2).sum(), (kernel * (b - mb) ** 2).sum()
            cov = (kernel * (a - ma) * (b - mb)).sum()
            luminance = (2 * ma * mb + 1e-4) / (ma**2 + mb**2 + 1e-4)
            out[i, j] = luminance * (2 * cov + 9e-4) / (va + vb + 9e-4)
    return out


def test_ssim_11_agrees_with_the_definition():
    x, y = picture(0), np.clip(picture(0) + 0.2 * picture(1), 0, 1)
    expected = np.mean([slow_ssim_map(x[..., c], y[..., c], 11).mean() for c in range(3)])
    assert ssim_11(x, y) == pytest.approx(expected, abs=1e-9)


def test_ssim_window3_agrees_with_the_definition_and_reflects_at_the_border():
    x, y = picture(0), np.clip(picture(0) + 0.2 * picture(1), 0, 1)
    pad = [np.pad(z, ((1, 1), (1, 1), (0, 0)), mode="reflect") for z in (x, y)]
    expected = np.stack([slow_ssim_map(pad[0][..., c], pad[1][..., c], 3) for c in range(3)], axis=-1)
    np.testing.assert_allclose(ssim_window3_map(x, y), expected, atol=1e-9)
    assert ssim_window3(x, y) == pytest.approx(expected.mean(), abs=1e-9)


def test_to_8bit_truncates_or_rounds_and_clips():
    values = np.array([[[-1.0, 0.5, 0.999]], [[1.0, 2.0, 1.6 / 255]]])
    assert to_8bit(values, "truncate").tolist() == [[[0, 127, 254]], [[255, 255, 1]]]
    assert to_8bit(values, "round").tolist() == [[[0, 128, 255]], [[255, 255, 2]]]


@pytest.mark.parametrize("name", SCORES)
def test_errors_say_what_is_wrong(name):
    score, a = SCORES[name], picture(0)
    with pytest.raises(ValueError, match=r"\(13, 17, 3\).*\(12, 17, 3\)"):
        score(a, a[1:])
    with pytest.raises(ValueError, match="truth holds NaN"):
        score(a, np.where(a > 0.9, np.nan, a))
    with pytest.raises(ValueError, match=r"reaches from .* to 200"):
        score(np.where(a > 0.9, 200.0, a), a)
    with pytest.raises(ValueError, match="not int64"):
        score(a, (a * 255).astype(np.int64))
    with pytest.raises(ValueError, match=r"\(h, w, 3\), not \(13, 17\)"):
        score(a[..., 0], a[..., 0])


@pytest.mark.parametrize(("name", "window"), [("ssim_window3", 3), ("ssim_11", 11)])
def test_a_picture_must_hold_the_window(name, window):
    a = picture(0)[:, :window]
    assert SCORES[name](a, a) == pytest.approx(1.0)
    with pytest.raises(ValueError, match=f"window of {window}"):
        SCORES[name](a[:, 1:], a[:, 1:])


def test_to_8bit_refuses_what_it_would_garble():
    with pytest.raises(ValueError, match="NaN"):
        to_8bit(np.full((1, 1, 3), np.nan), "round")
    with pytest.raises(ValueError, match="uint8"):
        to_8bit(np.zeros((1, 1, 3), np.uint8), "round")
    with pytest.raises(ValueError, match="nearest"):
        to_8bit(np.zeros((1, 1, 3)), "nearest")  # type: ignore[arg-type]


@pytest.mark.real
@pytest.mark.parametrize("pair", range(5))
def test_golden_metrics(golden, pair):
    vectors = golden("metrics")

    def channels_last(name: str) -> np.ndarray:
        return vectors[f"in/pair_{pair}/{name}"].permute(1, 2, 0).numpy()

    truth, prediction = channels_last("gt"), channels_last("pred")
    stored = to_8bit(prediction, "truncate")
    assert np.array_equal(stored, channels_last("pred_8bit"))
    for kind, scored in (("float", prediction), ("8bit", stored)):
        for part, columns in (("full", slice(None)), ("right", slice(truth.shape[1] // 2, None))):
            expected = f"out/pair_{pair}/{kind}/{part}"
            a, b = scored[:, columns], truth[:, columns]
            assert psnr(a, b) == pytest.approx(vectors[f"{expected}/psnr"].item(), abs=2e-5)
            assert ssim_window3(a, b) == pytest.approx(vectors[f"{expected}/ssim_kornia3"].item(), abs=5e-5)
            assert ssim_11(a, b) == pytest.approx(vectors[f"{expected}/ssim_gauss11"].item(), abs=1e-6)
