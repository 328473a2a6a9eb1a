"""One photo of the landmark: geometry, light and camera response put together, with and without the tourists."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.landmark.crowd import Tourist, contacts, crowd_solids
from pipeline.landmark.light import Light, Response, add_haze, develop, shine, sky
from pipeline.landmark.scene import openness, shade_of, solids, surfaces
from pipeline.landmark.tracer import Hits, Pinhole, Solid, Vec, add_solids, dot, each, sunlit, take, trace_grid, unit

SAMPLES = 2  # a side of a pixel; the mean of the 2 x 2 radiances is the area filter


def photograph(
    camera: Pinhole, light: Light, response: Response, crowd: Sequence[Tourist] = ()
) -> tuple[np.ndarray, np.ndarray]:
    """(clean, photo): uint8 RGB (h, w, 3) without and with the crowd, otherwise the same."""
    still = list(solids())
    hits = trace_grid(camera, still, SAMPLES)
    seen = np.flatnonzero(hits.which >= 0)
    points, normals, albedo = surfaces(hits, seen, still)
    lit = _lit(points, normals, still, light)
    share = openness(points, normals)
    radiance = sky(light, unit(each(np.ravel, hits.rays)))
    radiance[:, seen] = _shaded(light, hits, seen, albedo, normals, lit, share)
    clean = develop(response, _pixels(radiance, camera))
    if not crowd:
        return clean, clean

    people = crowd_solids(crowd)
    low = np.flatnonzero(points[2] < 1.0)
    lit[low] &= sunlit(_lift(take(points, low), take(normals, low)), people, light.towards_sun)
    for sphere in contacts(crowd):
        close = np.flatnonzero(_within(points, sphere))
        share[close] *= shade_of(take(points, close), take(normals, close), sphere)
    radiance[:, seen] = _shaded(light, hits, seen, albedo, normals, lit, share)

    add_solids(hits, people, first=len(still))
    front = np.flatnonzero(hits.which >= len(still))
    points, normals, albedo = surfaces(hits, front, still + people)
    lit = _lit(points, normals, still + people, light)
    share = 0.55 + 0.45 * np.clip(points[2] / 0.15, 0, 1)
    radiance[:, front] = _shaded(light, hits, front, albedo, normals, lit, share)
    return clean, develop(response, _pixels(radiance, camera))


def depth_map(camera: Pinhole) -> np.ndarray:
    """float32 (h, w): z-depth of the still scene at the pixel centres, in world units; inf where the sky is."""
    return trace_grid(camera, solids(), 1).t


def _lift(points: Vec, normals: Vec) -> Vec:
    """Points a little off their surface, so that rounding cannot put them below it."""
    return each(lambda p, n: p + np.float32(2e-3) * n, points, normals)


def _lit(points: Vec, normals: Vec, shapes: Sequence[Solid], light: Light) -> np.ndarray:
    lit = dot(normals, each(np.float32, light.towards_sun)) > 0
    facing = np.flatnonzero(lit)
    lit[facing] = sunlit(_lift(take(points, facing), take(normals, facing)), shapes, light.towards_sun)
    return lit


def _shaded(
    light: Light, hits: Hits, index: np.ndarray, albedo: np.ndarray, normals: Vec, lit: np.ndarray, share: np.ndarray
) -> np.ndarray:
    d = take(each(np.ravel, hits.rays), index)
    distance = hits.t.reshape(-1)[index] * np.sqrt(dot(d, d))
    return add_haze(light, shine(light, albedo, normals, lit, share), distance)


def _within(points: Vec, sphere: Sequence[float], times: float = 4.0) -> np.ndarray:
    reach = times * sphere[3]
    return (np.abs(points[0] - sphere[0]) < reach) & (np.abs(points[1] - sphere[1]) < reach) & (points[2] < 1.0)


def _pixels(radiance: np.ndarray, camera: Pinhole) -> np.ndarray:
    cells = radiance.reshape(3, camera.height, SAMPLES, camera.width, SAMPLES)
    return np.moveaxis(cells.mean((2, 4)), 0, 2)
