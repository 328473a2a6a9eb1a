"""The landmark's tourists: people alone and in groups, under umbrellas, and vehicles, standing on the ground.

`place_crowd` draws who stands in one photo. It measures what they cover on a coarse grid and adds more until a wanted
share of the picture is reached.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.landmark.light import RGB, Light
from pipeline.landmark.scene import OBSTACLES, RADIUS, solids
from pipeline.landmark.tracer import (
    Paint,
    Pinhole,
    Solid,
    Vec,
    add_solids,
    ellipsoid,
    frustum,
    mix,
    plain,
    pulse,
    sunlit,
    tapered,
    trace_grid,
)


@dataclass(frozen=True)
class Tourist:
    """One thing that does not belong to the scene. `size` is a person's height or a vehicle's length, world units."""

    kind: str  # person | car | van | coach
    x: float
    y: float
    yaw: float
    size: float
    colours: tuple[RGB, ...]  # person: shirt, trousers, hair, bag or umbrella; vehicle: body, stripe
    extra: str = ""  # person: "", "bag" or "umbrella"


# length, width and height of vehicles
VEHICLES = {"car": (0.76, 0.31, 0.26), "van": (0.9, 0.34, 0.38), "coach": (1.7, 0.42, 0.54)}
_BRIGHT: tuple[RGB, ...] = (
    (0.7, 0.03, 0.04), (0.03, 0.1, 0.55), (0.85, 0.45, 0.02), (0.02, 0.35, 0.5), (0.5, 0.02, 0.3), (0.9, 0.75, 0.05),
    (0.02, 0.4, 0.12), (0.75, 0.12, 0.35), (0.2, 0.05, 0.4), (0.0, 0.5, 0.55), (0.9, 0.9, 0.92), (0.02, 0.02, 0.03),
)  # fmt: skip
_DARK: tuple[RGB, ...] = ((0.015, 0.02, 0.05), (0.02, 0.02, 0.02), (0.03, 0.05, 0.16), (0.05, 0.02, 0.02))
_HAIR: tuple[RGB, ...] = ((0.02, 0.015, 0.01), (0.08, 0.04, 0.02), (0.4, 0.28, 0.1), (0.01, 0.01, 0.015))
_SKIN: tuple[RGB, ...] = ((0.65, 0.4, 0.28), (0.45, 0.25, 0.15), (0.2, 0.1, 0.06))


def crowd_solids(crowd: Sequence[Tourist]) -> list[Solid]:
    """The shapes of a crowd."""
    return [solid for tourist in crowd for solid in _shapes(tourist)]


def contacts(crowd: Sequence[Tourist]) -> list[tuple[float, float, float, float]]:
    """Spheres (x, y, z, r) that dim the sky's light on the ground around everybody's feet."""
    spheres = []
    for t in crowd:
        if t.kind == "person":
            spheres.append((t.x, t.y, 0.25 * t.size, 0.25 * t.size))
            continue
        length, width, _ = _dimensions(t)
        for along in (-0.35, 0.0, 0.35):
            x, y = t.x + along * length * math.cos(t.yaw), t.y + along * length * math.sin(t.yaw)
            spheres.append((x, y, 0.3 * width, 0.55 * width))
    return spheres


def _dimensions(t: Tourist) -> tuple[float, float, float]:
    length, width, height = VEHICLES[t.kind]
    scale = t.size / length
    return t.size, width * scale, height * scale


def _shapes(t: Tourist) -> list[Solid]:
    return {"person": _person, "car": _car, "van": _van, "coach": _coach}[t.kind](t)


def _local(t: Tourist, p: Vec) -> Vec:
    """World points in the frame of a tourist: x forwards, y to the left, z up."""
    c, s = math.cos(t.yaw), math.sin(t.yaw)
    x, y = p[0] - t.x, p[1] - t.y
    return x * c + y * s, y * c - x * s, p[2]


def _person(t: Tourist) -> list[Solid]:
    h, (shirt, trousers, hair, other, skin) = t.size, t.colours
    c, s = math.cos(t.yaw), math.sin(t.yaw)

    def at(forward: float, left: float) -> tuple[float, float]:
        return t.x + (forward * c - left * s) * h, t.y + (forward * s + left * c) * h

    def face(p: Vec, n: Vec, w: Vec) -> np.ndarray:
        x, _, z = _local(t, p)
        return mix(skin, hair, (z > 0.945 * h) | ((x < 0.0) & (z > 0.88 * h)))

    def sleeve(p: Vec, n: Vec, w: Vec) -> np.ndarray:
        return mix(np.array(shirt) * 0.8, skin, p[2] < 0.47 * h)

    parts: list[Solid] = [
        frustum(at(0.02 * side, 0.07 * side), 0.0, 0.5 * h, 0.05 * h, 0.078 * h, plain(trousers)) for side in (-1, 1)
    ]
    parts += [
        ellipsoid((*at(0, 0), 0.65 * h), (0.105 * h, 0.155 * h, 0.21 * h), plain(shirt), t.yaw),
        ellipsoid((*at(0, 0), 0.915 * h), (0.08 * h, 0.072 * h, 0.09 * h), face, t.yaw),
    ]
    parts += [
        ellipsoid((*at(0.02, 0.19 * side), 0.62 * h), (0.05 * h, 0.045 * h, 0.2 * h), sleeve, t.yaw) for side in (-1, 1)
    ]
    if t.extra == "bag":
        parts.append(ellipsoid((*at(-0.13, 0), 0.68 * h), (0.09 * h, 0.11 * h, 0.15 * h), plain(other), t.yaw))
    if t.extra == "umbrella":

        def gores(p: Vec, n: Vec, w: Vec) -> np.ndarray:
            x, y, _ = _local(t, p)
            return mix(other, np.array(other) * 0.45, pulse(np.arctan2(y, x), math.pi / 4, 0.5, 0.1))

        parts.append(frustum(at(0.05, 0), 1.03 * h, 1.2 * h, 0.38 * h, 0.02 * h, gores))
    return parts


def _wheels(t: Tourist, radius: float) -> list[Solid]:
    length, width, _ = _dimensions(t)
    c, s = math.cos(t.yaw), math.sin(t.yaw)
    parts: list[Solid] = []
    for along in (-0.31 * length, 0.31 * length):
        for left in (-0.47 * width, 0.47 * width):
            centre = (t.x + along * c - left * s, t.y + along * s + left * c, radius)
            parts.append(ellipsoid(centre, (radius, 0.12 * width, radius), plain((0.015, 0.015, 0.015)), t.yaw))
    return parts


def _glass(t: Tourist, bottom: float, top: float, bay: float) -> Paint:
    """Body paint with a band of dark windows and lamps on the ends."""
    length, width, height = _dimensions(t)
    body, stripe = t.colours

    def paint(p: Vec, n: Vec, w: Vec) -> np.ndarray:
        x, y, z = _local(t, p)
        side = np.abs(n[2]) < 0.85
        end = np.abs(x) > 0.47 * length
        pillars = np.where(end, 1.0, pulse(x + 0.5 * bay, bay, 0.9, w[0]))
        colour = mix(body, stripe, (z > 0.4 * height) & (z < 0.47 * height))
        colour = mix(colour, (0.02, 0.03, 0.045), side * pillars * (z > bottom) * (z < top))
        lamp = end & (np.abs(np.abs(y) - 0.36 * width) < 0.09 * width) & (np.abs(z - 0.33 * height) < 0.06 * height)
        return mix(colour, np.where(x > 0, 1.0, 0.6) * np.array([[0.9], [0.35], [0.3]]), lamp)

    return paint


def _car(t: Tourist) -> list[Solid]:
    length, width, height = _dimensions(t)
    at = (t.x, t.y)
    lower = tapered(
        at, t.yaw, 0.17 * height, 0.6 * height, (length, width), (0.95 * length, 0.94 * width),
        _glass(t, 9.0, 9.0, length),
    )  # fmt: skip
    cabin = tapered(
        at, t.yaw, 0.6 * height, height, (0.64 * length, 0.92 * width), (0.4 * length, 0.76 * width),
        _glass(t, 0.64 * height, 0.92 * height, 0.27 * length), shift=-0.03 * length,
    )  # fmt: skip
    return [lower, cabin, *_wheels(t, 0.22 * height)]


def _van(t: Tourist) -> list[Solid]:
    length, width, height = _dimensions(t)
    paint = _glass(t, 0.56 * height, 0.88 * height, 0.3 * length)
    body = tapered(
        (t.x, t.y), t.yaw, 0.13 * height, height, (length, width), (0.86 * length, 0.9 * width), paint,
        shift=-0.06 * length,
    )  # fmt: skip
    return [body, *_wheels(t, 0.17 * height)]


def _coach(t: Tourist) -> list[Solid]:
    length, width, height = _dimensions(t)
    paint = _glass(t, 0.55 * height, 0.85 * height, 0.15 * length)
    body = tapered((t.x, t.y), t.yaw, 0.1 * height, height, (length, width), (0.98 * length, 0.95 * width), paint)
    return [body, *_wheels(t, 0.13 * height)]


# ---- who stands where

COARSE = 64  # cells on the long side of the grid on which coverage is measured


def place_crowd(rng: np.random.Generator, camera: Pinhole, light: Light, target: float) -> list[Tourist]:
    """A crowd that changes about the share `target` of the picture's pixels, counting the shadows that show."""
    if target <= 0:
        return []
    hits = trace_grid(camera, solids(), COARSE / max(camera.width, camera.height))
    low = np.flatnonzero(hits.which == 0)  # shadows are counted on the ground only
    points = hits.points(np.unravel_index(low, hits.t.shape))
    sun, ambient = sum(light.sun) * light.towards_sun[2], sum(light.ambient)
    shadows = sun > 0.5 * ambient
    if shadows and low.size:
        low = low[sunlit(points, solids(), light.towards_sun)]
        points = hits.points(np.unravel_index(low, hits.t.shape))

    crowd: list[Tourist] = []
    covered = np.zeros(hits.t.shape, bool)
    still = len(solids())
    for _ in range(80):
        share = covered.mean()
        if share > 0.88 * target:
            break
        party = _propose(rng, camera, target - share)
        if not all(_free(t, crowd) for t in party):
            continue
        shapes = crowd_solids(party)
        t, which = hits.t.copy(), hits.which.copy()
        add_solids(hits, shapes, first=still)
        changed = covered | (hits.which >= still)
        if shadows and low.size:
            changed.reshape(-1)[low[~sunlit(points, shapes, light.towards_sun)]] = True
        if changed.mean() > 1.12 * target + 0.006:
            hits.t, hits.which = t, which
            continue
        covered = changed
        crowd += party
    return crowd


def _propose(rng: np.random.Generator, camera: Pinhole, missing: float) -> list[Tourist]:
    """Somebody, at a distance at which they would cover about the `missing` share of the picture."""
    kind = rng.choice(["person", "group", "car", "van", "coach"], p=[0.42, 0.34, 0.12, 0.07, 0.05])
    members = int(rng.integers(2, 6)) if kind == "group" else 1
    height = 0.285 * math.exp(rng.normal(0, 0.06))
    if kind in ("person", "group"):
        area, closest, spread = members * 0.3 * height * height, 0.85, 0.2
    else:
        length, _, tall = VEHICLES[kind]
        area, closest, spread = 0.7 * length * tall, 2.0, 0.8
    view = camera.width * camera.height / (camera.fx * camera.fy)
    share = missing * rng.uniform(0.3, 1.0)
    z = min(max(math.sqrt(area / (view * max(share, 1e-4))) * math.exp(rng.normal(0, 0.15)), closest), 4.6)
    u = rng.uniform(0.04, 0.96) * camera.width
    right, _, forward = camera.rotation
    level = math.hypot(forward[0], forward[1])
    side = (u - camera.cx) / camera.fx * z
    x = camera.centre[0] + forward[0] / level * z + right[0] * side
    y = camera.centre[1] + forward[1] / level * z + right[1] * side
    if kind not in ("person", "group"):
        body, stripe = (_BRIGHT[int(rng.integers(len(_BRIGHT)))] for _ in range(2))
        size = VEHICLES[kind][0] * math.exp(rng.normal(0, 0.05))
        colours = (body, stripe if kind == "coach" else body)
        # Most drivers park across the view; nobody parks exactly so.
        across = math.atan2(right[1], right[0]) + rng.normal(0, 0.5) + math.pi * int(rng.integers(2))
        return [Tourist(str(kind), x, y, across, size, colours)]
    return [
        _draw_person(rng, x + spread * rng.normal() * (k > 0), y + spread * rng.normal() * (k > 0), height)
        for k in range(members)
    ]


def _draw_person(rng: np.random.Generator, x: float, y: float, height: float) -> Tourist:
    def pick(palette: tuple[RGB, ...]) -> RGB:
        return palette[int(rng.integers(len(palette)))]

    trousers = pick(_DARK if rng.random() < 0.7 else _BRIGHT)
    colours = (pick(_BRIGHT), trousers, pick(_HAIR), pick(_BRIGHT), pick(_SKIN))
    extra = str(rng.choice(["", "bag", "umbrella"], p=[0.62, 0.24, 0.14]))
    return Tourist(
        "person", x, y, rng.uniform(-math.pi, math.pi), height * math.exp(rng.normal(0, 0.07)), colours, extra
    )


def _free(tourist: Tourist, crowd: Sequence[Tourist]) -> bool:
    """Whether somebody can stand there: on open ground, in front of the building, not in one another."""
    mine = _footprint(tourist)
    taken = [*OBSTACLES, *(disc for other in crowd for disc in _footprint(other))]
    for x, y, r in mine:
        if (y > -1.25 - r and abs(x) < 2.75 + r) or y > 0.5 or math.hypot(x, y) > RADIUS - 0.5:
            return False
        if any(math.hypot(x - a, y - b) < r + s for a, b, s in taken):
            return False
    return True


def _footprint(t: Tourist) -> list[tuple[float, float, float]]:
    if t.kind == "person":
        return [(t.x, t.y, 0.05)]
    length, width, _ = _dimensions(t)
    c, s = math.cos(t.yaw), math.sin(t.yaw)
    return [(t.x + k * length * c, t.y + k * length * s, 0.6 * width) for k in (-0.4, -0.2, 0.0, 0.2, 0.4)]
