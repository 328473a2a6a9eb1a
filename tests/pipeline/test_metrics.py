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


# Hostile pictures


def constant(value: float, size: tuple[int, int] = (12, 12)) -> np.ndarray:
    return np.full((*size, 3), value)


@pytest.mark.parametrize(("a", "b"), [(0.0, 0.0), (0.0, 1.0), (0.5, 0.5), (0.2, 0.7), (1.0, 1.0)])
def test_constant_pictures_by_hand(a, b):
    """Nothing varies, so SSIM is its luminance term alone, and PSNR that of one difference."""
    luminance = (2 * a * b + 1e-4) / (a * a + b * b + 1e-4)
    for score in (ssim_window3, ssim_11):
        assert score(constant(a), constant(b)) == pytest.approx(luminance, abs=1e-9)
    expected = math.inf if a == b else -20 * math.log10(abs(a - b))
    assert psnr(constant(a), constant(b)) == pytest.approx(expected)


@pytest.mark.parametrize("name", SCORES)
def test_a_constant_prediction_of_a_real_picture_has_a_score(name):
    """Uniform noise around its mean: a variance of 1/12, and no structure."""
    score = SCORES[name](constant(0.5, (13, 17)), picture(0))
    assert score == pytest.approx(10 * math.log10(12), abs=0.3) if name == "psnr" else 0 < score < 0.1


def test_one_level_apart_is_far_from_identical():
    """48.13 dB is as near as two 8-bit pictures come that differ everywhere."""
    a = np.full((11, 11, 3), 7, np.uint8)
    assert psnr(a, a + 1) == pytest.approx(20 * math.log10(255))


@pytest.mark.parametrize("size", [(11, 13), (15, 11), (12, 31), (11, 12)])
def test_odd_and_even_sizes_agree_with_the_definition(size):
    x, y = picture(0, size), np.clip(picture(0, size) + 0.1 * picture(1, size), 0, 1)
    expected = np.mean([slow_ssim_map(x[..., c], y[..., c], 11).mean() for c in range(3)])
    assert ssim_11(x, y) == pytest.approx(expected, abs=1e-9)
    assert ssim_window3_map(x, y).shape == (*size, 3)


def test_one_pixel_has_a_psnr_and_no_ssim():
    one = np.full((1, 1, 3), 0.5)
    assert psnr(one, one + 0.1) == pytest.approx(20.0)
    assert psnr(one, one) == math.inf
    for score, window in ((ssim_window3, 3), (ssim_11, 11)):
        with pytest.raises(ValueError, match=rf"\(1, 1, 3\) are smaller than the window of {window}"):
            score(one, one)


@pytest.mark.parametrize("name", SCORES)
@pytest.mark.parametrize("size", [(0, 0), (0, 20), (20, 0)])
def test_a_picture_without_pixels_is_refused(name, size):
    with pytest.raises(ValueError, match="smaller than the window"):
        SCORES[name](np.zeros((*size, 3)), np.zeros((*size, 3)))


@pytest.mark.parametrize("name", SCORES)
@pytest.mark.parametrize("which", ["prediction", "truth"])
@pytest.mark.parametrize(
    ("value", "message"),
    [(math.nan, "NaN"), (math.inf, "to inf"), (-math.inf, "from -inf"), (1.01, "to 1.01"), (-0.01, "from -0.01"),
     (255.0, "to 255")],
)  # fmt: skip
def test_one_bad_pixel_is_refused_wherever_it_is(name, which, value, message):
    """Also as the very last number of a picture."""
    good, bad = picture(0), picture(0)
    bad[-1, -1, -1] = value
    pair = (bad, good) if which == "prediction" else (good, bad)
    with pytest.raises(ValueError, match=message) as caught:
        SCORES[name](*pair)
    assert which in str(caught.value)


@pytest.mark.parametrize("name", SCORES)
def test_what_rendering_leaves_above_one_is_let_through(name):
    assert math.isfinite(SCORES[name](np.full((12, 12, 3), 1.0000001), picture(0, (12, 12))))


@pytest.mark.parametrize("name", SCORES)
def test_neither_picture_is_changed(name):
    a, b = picture(0), picture(1)
    before = a.copy(), b.copy()
    SCORES[name](a, b)
    np.testing.assert_array_equal(a, before[0])
    np.testing.assert_array_equal(b, before[1])


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_every_float_is_scored_in_float64(dtype):
    """A sum of a million squares in float16 would be wrong by far."""
    a = np.full((600, 600, 3), 0.5, dtype)
    b = (a + dtype(0.015625)).astype(dtype)
    assert psnr(a, b) == pytest.approx(-20 * math.log10(0.015625))


@pytest.mark.parametrize("rounding", ["truncate", "round"])
def test_8_bit_hits_both_ends_and_every_level(rounding):
    levels = np.arange(256, dtype=np.float64)[None, :, None] / 255
    assert to_8bit(levels, "round")[0, :, 0].tolist() == list(range(256))
    assert to_8bit(np.array([[[0.0, 1.0, math.inf]]]), rounding).tolist() == [[[0, 255, 255]]]
    assert to_8bit(np.array([[[-math.inf, -0.0, 1 + 1e-7]]]), rounding).tolist() == [[[0, 0, 255]]]


def test_truncation_costs_half_a_level_on_average():
    values = np.random.default_rng(0).random((100, 100, 3))
    lost = (values * 255 - to_8bit(values, "truncate")).mean()
    assert lost == pytest.approx(0.5, abs=0.01)
    assert (values * 255 - to_8bit(values, "round")).mean() == pytest.approx(0.0, abs=0.01)


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
