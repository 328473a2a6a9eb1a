"""What differs between two photos of one view: the light, the sky and the camera's response.

All of it is global to a photo and smooth in its parameters. `Light` is in linear radiance (a white surface in
full noon sun is about 1); `Response` turns that into 8-bit RGB.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pipeline.landmark.tracer import Vec, dot, each, unit

RGB = tuple[float, float, float]


@dataclass(frozen=True)
class Light:
    """Sun and sky of one photo; colours are linear RGB, `towards_sun` is a unit vector in the world."""

    weather: str
    towards_sun: RGB
    sun: RGB
    ambient: RGB
    zenith: RGB
    horizon: RGB
    cloud: RGB
    cloudiness: float  # 0 clear .. 1 mostly covered
    haze: float  # how much of the horizon's colour a unit of distance adds


@dataclass(frozen=True)
class Response:
    """Camera of one photo: radiance * exposure * balance -> saturation -> shoulder -> gamma -> contrast -> 8 bits."""

    exposure: float
    balance: RGB
    gamma: float
    contrast: float  # -1 .. 1, share of an S-curve
    saturation: float
    vignette: float  # share of light lost in the corners


# weather: sun, ambient, zenith, horizon, cloud colour, cloudiness range, haze range, overall level
_WEATHERS = {
    "noon": ((1.0, 0.95, 0.86), (0.3, 0.36, 0.46), (0.1, 0.24, 0.62), (0.5, 0.64, 0.82), (0.95, 0.95, 0.97),
             (0.0, 0.7), (0.0, 0.012), 1.0),
    "golden": ((1.0, 0.58, 0.25), (0.24, 0.2, 0.25), (0.2, 0.27, 0.48), (0.95, 0.58, 0.32), (1.0, 0.66, 0.45),
               (0.1, 0.8), (0.005, 0.03), 0.9),
    "hazy": ((0.62, 0.56, 0.46), (0.44, 0.44, 0.43), (0.4, 0.5, 0.62), (0.78, 0.77, 0.72), (0.85, 0.83, 0.8),
             (0.1, 0.6), (0.015, 0.045), 0.95),
    "overcast": ((0.05, 0.05, 0.05), (0.62, 0.64, 0.67), (0.5, 0.53, 0.57), (0.72, 0.73, 0.74), (0.4, 0.42, 0.45),
                 (0.4, 1.0), (0.005, 0.03), 0.8),
    "dusk": ((0.1, 0.05, 0.06), (0.2, 0.26, 0.42), (0.06, 0.12, 0.32), (0.5, 0.36, 0.37), (0.24, 0.22, 0.33),
             (0.1, 0.8), (0.0, 0.02), 0.5),
    "storm": ((0.5, 0.42, 0.27), (0.26, 0.29, 0.35), (0.1, 0.13, 0.19), (0.3, 0.34, 0.4), (0.07, 0.08, 0.12),
              (0.5, 1.0), (0.0, 0.02), 0.8),
}  # fmt: skip
_SHARES = (("noon", 0.28), ("golden", 0.2), ("hazy", 0.1), ("overcast", 0.2), ("dusk", 0.13), ("storm", 0.09))


def draw_light(rng: np.random.Generator, which: float, towards_sun: RGB) -> Light:
    """The light of one photo; `which` in [0, 1) picks the weather."""
    weather, total = _SHARES[-1][0], 0.0
    for name, share in _SHARES:
        total += share
        if which < total:
            weather = name
            break
    sun, ambient, zenith, horizon, cloud, clouds, haze, _ = _WEATHERS[weather]

    def vary(colour: RGB, level: float, hue: float) -> RGB:
        factor = math.exp(rng.normal(0, level))
        r, g, b = (c * factor * math.exp(rng.normal(0, hue)) for c in colour)
        return r, g, b

    return Light(
        weather=weather,
        towards_sun=towards_sun,
        sun=vary(sun, 0.15, 0.04),
        ambient=vary(ambient, 0.15, 0.06),
        zenith=vary(zenith, 0.2, 0.1),
        horizon=vary(horizon, 0.1, 0.08),
        cloud=vary(cloud, 0.08, 0.03),
        cloudiness=rng.uniform(*clouds),
        haze=rng.uniform(*haze),
    )


def draw_response(rng: np.random.Generator, light: Light) -> Response:
    """A camera that meters the light roughly and errs by half to nearly double."""
    metered = sum(0.6 * s + 0.8 * a for s, a in zip(light.sun, light.ambient, strict=True)) / 3
    wanted = _WEATHERS[light.weather][-1]
    error = math.exp(float(np.clip(rng.normal(0, 0.42), math.log(0.5), math.log(1.8))))
    warmth, tint = rng.normal(0, 0.13), rng.normal(0, 0.04)
    return Response(
        exposure=0.72 * wanted / metered**0.9 * error,
        balance=(math.exp(warmth), math.exp(tint), math.exp(-warmth)),
        gamma=rng.uniform(1.5, 2.2),
        contrast=rng.uniform(0.1, 0.8),
        saturation=rng.uniform(0.7, 1.5),
        vignette=rng.uniform(0.0, 0.12),
    )


def sky(light: Light, d: Vec) -> np.ndarray:
    """Radiance (3, n) of the sky in unit directions d: gradient, glow around the sun, soft clouds that never move."""
    up = np.clip(d[2], 0, 1)
    horizon, zenith, cloud, sun = (
        np.array(c, np.float32)[:, None] for c in (light.horizon, light.zenith, light.cloud, light.sun)
    )
    colour = zenith + (horizon - zenith) * np.exp(-4.5 * up)
    glow = np.maximum(dot(d, light.towards_sun), 0) ** 6
    colour = colour + 0.25 * sun * glow
    x, y = d[0] / (up + 0.28), d[1] / (up + 0.28)
    billow = (
        np.sin(1.9 * x + 0.8 * np.sin(1.3 * y) + 0.4)
        + 0.7 * np.sin(2.7 * y - 1.2 * x + 1.1 * np.sin(2.1 * x) + 1.0)
        + 0.45 * np.sin(5.1 * x + 2.3 * y + 1.2 * np.sin(3.3 * y))
        + 0.25 * np.sin(9.7 * x - 6.1 * y + 1.4 * np.sin(5.0 * x + y))
    )
    cover = 1 / (1 + np.exp(-4.0 * (billow - 1.0 + 1.5 * light.cloudiness)))
    shade = 0.86 + 0.14 * np.tanh(billow - 0.6)
    return colour + (cloud * shade - colour) * cover * min(1.0, 0.3 + 1.4 * light.cloudiness) * np.minimum(
        1, 0.35 + 3 * up
    )


def shine(light: Light, albedo: np.ndarray, n: Vec, lit: np.ndarray, openness: np.ndarray) -> np.ndarray:
    """Radiance (3, n) of matt surfaces: sun where lit, a bright hemisphere above and a bounce from the ground below."""
    towards = unit(each(np.float32, light.towards_sun))
    direct = np.maximum(dot(n, towards), 0) * lit
    sun, ambient = (np.array(c, np.float32)[:, None] for c in (light.sun, light.ambient))
    above = 0.5 + 0.5 * n[2]
    # The square in front reflects warm light on what looks forwards or down.
    bounce = (sun * float(towards[2]) + ambient) * np.array([[0.36], [0.31], [0.25]], np.float32)
    return albedo * (sun * direct + (ambient * above + bounce * (1 - above)) * openness)


def add_haze(light: Light, colour: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Surface radiance seen through `distance` of air."""
    return colour + (np.array(light.horizon, np.float32)[:, None] - colour) * (1 - np.exp(-light.haze * distance))


def develop(response: Response, radiance: np.ndarray) -> np.ndarray:
    """Radiance (h, w, 3) -> uint8 RGB (h, w, 3)."""
    h, w, _ = radiance.shape
    y, x = (np.arange(h) + 0.5) / h * 2 - 1, (np.arange(w) + 0.5) / w * 2 - 1
    corner = ((x * x)[None, :] * w * w + (y * y)[:, None] * h * h) / (w * w + h * h)
    gain = (1 - response.vignette * corner)[..., None] * response.exposure * np.array(response.balance)
    value = radiance * gain
    luma = (value * np.array([0.25, 0.6, 0.15])).sum(2, keepdims=True)
    value = np.maximum(luma + response.saturation * (value - luma), 0)
    value = (1 - np.exp(-1.25 * value)) ** (1 / response.gamma)
    value = value + response.contrast * (value * value * (3 - 2 * value) - value)
    return np.round(np.clip(value, 0, 1) * 255).astype(np.uint8)
