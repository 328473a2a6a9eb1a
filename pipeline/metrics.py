"""How close a picture is to the truth: PSNR, and SSIM in the two variants that papers of this field report.

The two SSIMs are not comparable: the 3 x 3 one of CR-NeRF's evaluation forgives more than the usual 11 x 11.
A picture is (h, w, 3), uint8 or float in [0, 1]; prediction and truth need not be of the same kind (the
released evaluation scores an 8-bit prediction against a float truth). Everything is computed in float64.
"""

from __future__ import annotations

import math
from typing import Literal, SupportsFloat

import numpy as np
from scipy import ndimage
from skimage.metrics import structural_similarity

SIGMA = 1.5
C1, C2 = 0.01**2, 0.03**2
RANGE_SLACK = 1e-3  # a rendered 1.0000001 passes, a picture in 0..255 stored as float does not


def psnr(prediction: np.ndarray, truth: np.ndarray) -> float:
    """-10 log10 of the mean squared error over pixels and channels, in dB; inf for identical pictures.

    ValueError if shapes differ, or a value is NaN or outside [0, 1].
    """
    prediction, truth = _pair(prediction, truth, window=1)
    error = np.mean((prediction - truth) ** 2)
    return float("inf") if error == 0 else float(-10 * np.log10(error))


def psnr_of(mse: SupportsFloat) -> float:
    """-10 log10 of a mean squared error, in dB; at most 100."""
    return -10 * math.log10(max(float(mse), 1e-10))


def ssim_window3(prediction: np.ndarray, truth: np.ndarray) -> float:
    """Mean SSIM of CR-NeRF's evaluation (kornia, window 3). ValueError as `psnr`, or below 3 pixels.

    Gaussian window of 3 x 3 with sigma 1.5, reflected borders, weighted (biased) variances, mean over the
    whole map.
    """
    return float(ssim_window3_map(prediction, truth).mean())


def ssim_window3_map(prediction: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """The map (h, w, 3) whose mean is `ssim_window3`."""
    x, y = _pair(prediction, truth, window=3)
    mean_x, mean_y = _blur3(x), _blur3(y)
    variance_x = _blur3(x * x) - mean_x**2
    variance_y = _blur3(y * y) - mean_y**2
    covariance = _blur3(x * y) - mean_x * mean_y
    numerator = (2 * mean_x * mean_y + C1) * (2 * covariance + C2)
    return numerator / ((mean_x**2 + mean_y**2 + C1) * (variance_x + variance_y + C2))


def ssim_11(prediction: np.ndarray, truth: np.ndarray) -> float:
    """Mean SSIM as Wang et al. 2004 define it: 11 x 11 Gaussian window with sigma 1.5, biased variances.

    Over the pixels whose window lies inside the picture. ValueError as `psnr`, or below 11 pixels.
    """
    prediction, truth = _pair(prediction, truth, window=11)
    # `win_size` only sets the border that is cropped; the window itself is truncated at 3.5 sigma, which is
    # 11 as well.
    return float(
        structural_similarity(
            prediction,
            truth,
            win_size=11,
            gaussian_weights=True,
            sigma=SIGMA,
            use_sample_covariance=False,
            data_range=1.0,
            channel_axis=-1,
        )
    )


def to_8bit(picture: np.ndarray, rounding: Literal["truncate", "round"]) -> np.ndarray:
    """A float picture, clipped to [0, 1], as uint8. The released evaluation truncates; others round.

    ValueError for NaN, another dtype, or an unknown `rounding`.
    """
    if picture.dtype.kind != "f":
        raise ValueError(f"to_8bit takes a float picture, not {picture.dtype}")
    if np.isnan(picture).any():
        raise ValueError("the picture holds NaN")
    scaled = np.clip(picture, 0, 1) * 255
    if rounding == "truncate":
        return scaled.astype(np.uint8)
    if rounding == "round":
        return np.rint(scaled).astype(np.uint8)
    raise ValueError(f'rounding must be "truncate" or "round", not {rounding!r}')


def _blur3(x: np.ndarray) -> np.ndarray:
    # scipy's "mirror" is what torch calls "reflect": the border pixel is not repeated.
    return ndimage.gaussian_filter(x, SIGMA, radius=1, mode="mirror", axes=(0, 1))


def _pair(prediction: np.ndarray, truth: np.ndarray, window: int) -> tuple[np.ndarray, np.ndarray]:
    if prediction.shape != truth.shape:
        raise ValueError(f"prediction {prediction.shape} and truth {truth.shape} differ in shape")
    if prediction.ndim != 3 or prediction.shape[2] != 3:
        raise ValueError(f"pictures are (h, w, 3), not {prediction.shape}")
    if min(prediction.shape[:2]) < window:
        raise ValueError(f"pictures {prediction.shape} are smaller than the window of {window} pixels")
    return _unit(prediction, "prediction"), _unit(truth, "truth")


def _unit(picture: np.ndarray, what: str) -> np.ndarray:
    if picture.dtype == np.uint8:
        return picture / 255.0
    if picture.dtype.kind != "f":
        raise ValueError(f"the {what} must be uint8 or float in [0, 1], not {picture.dtype}")
    if np.isnan(picture).any():
        raise ValueError(f"the {what} holds NaN")
    low, high = float(picture.min()), float(picture.max())
    if low < -RANGE_SLACK or high > 1 + RANGE_SLACK:
        raise ValueError(f"the {what} reaches from {low:g} to {high:g}; floats must lie in [0, 1]")
    return picture.astype(np.float64)
