"""The built-in landmark itself: a museum with a portico, a dome and two wings, on its square.

One world unit is about six metres; the building is five units wide, faces -y, and its axis is x = 0. Everything here is
fixed: what differs between photos is in light.py and crowd.py. Albedos are linear RGB.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np

from pipeline.landmark.tracer import (
    Ground,
    Hits,
    Paint,
    Solid,
    Surround,
    Vec,
    box,
    checker,
    dot,
    each,
    ellipsoid,
    fade,
    frustum,
    mix,
    plain,
    pulse,
    ripple,
    take,
    tapered,
    unit,
)

RGB = tuple[float, float, float]
SUN = (-0.52, -0.62, 0.588)  # towards the sun, from the left and in front; made a unit vector where used
RADIUS = 8.0  # of the ground and of the trees around it
FOUNTAIN = (0.0, -2.35)
LIMESTONE = (0.66, 0.58, 0.46)
MARBLE = (0.78, 0.75, 0.69)
# Discs (x, y, r) on which no tourist can stand; the building is the rectangle |x| < 2.7, y > -1.15.
OBSTACLES = [(0.0, -2.35, 0.66), (1.72, -2.0, 0.3), (-1.75, -2.0, 0.36), (1.75, -1.2, 0.26), (-1.75, -1.2, 0.26)]


# ---- materials


def _along_face(p: Vec, n: Vec, w: Vec) -> tuple[np.ndarray, np.ndarray]:
    """The horizontal coordinate that runs along an upright wall, and its footprint."""
    sideways = np.abs(n[0]) > np.abs(n[1])
    return np.where(sideways, p[1], p[0]), np.where(sideways, w[1], w[0])


def ashlar(colour: RGB, course: float = 0.13, length: float = 0.34, mortar: float = 0.62, tint: float = 0.12) -> Paint:
    """Coursed stone or brick: staggered blocks of slightly different tints with joints between them."""

    def paint(p: Vec, n: Vec, w: Vec) -> np.ndarray:
        s, ws = _along_face(p, n, w)
        row = np.floor(p[2] / course)
        s = s + 0.5 * length * (row % 2)
        block = np.sin(np.floor(s / length) * 12.99 + row * 78.2)
        level = 1 + tint * block * fade(course, w[2]) * fade(length, ws) + 0.07 * ripple(p, 0.9, w[0])
        upright = np.abs(n[2]) < 0.7
        joint = np.maximum(pulse(p[2], course, 0.12, w[2]), pulse(s, length, 0.05, ws)) * upright
        return np.array(colour, np.float32)[:, None] * level * (1 - (1 - mortar) * joint)

    return paint


def veined(colour: RGB, scale: float = 0.35, depth: float = 0.1) -> Paint:
    """Marble: a smooth grain."""

    def paint(p: Vec, n: Vec, w: Vec) -> np.ndarray:
        return np.array(colour, np.float32)[:, None] * (1 + depth * ripple(p, scale, np.maximum(w[0], w[2])))

    return paint


def column(at: tuple[float, float], drum: float = 0.24) -> Paint:
    """Fluted marble drums."""

    def paint(p: Vec, n: Vec, w: Vec) -> np.ndarray:
        angle = np.arctan2(p[1] - at[1], p[0] - at[0])
        flute = np.cos(14 * angle) * fade(0.04, 0.5 * (w[0] + w[1]))
        level = 1 + 0.1 * flute + 0.05 * np.sin(np.floor(p[2] / drum) * 5.1 + at[0] * 7)
        joint = pulse(p[2] + 0.01, drum, 0.08, w[2])
        return np.array(MARBLE, np.float32)[:, None] * level * (1 - 0.25 * joint)

    return paint


def _facade(p: Vec, n: Vec, w: Vec) -> np.ndarray:
    """The wall behind the columns: warm plaster, a tall dark door, two windows, and niches on the sides."""
    wall = ashlar((0.58, 0.34, 0.22), 0.16, 0.4, 0.75, 0.08)(p, n, w)
    front = n[1] < -0.5
    x, z = np.abs(p[0]), p[2]

    def opening(centre: float, half: float, bottom: float, top: float) -> np.ndarray:
        return front & (np.abs(x - centre) < half) & (z > bottom) & (z < top)

    wall = mix(wall, MARBLE, opening(0, 0.27, 0.27, 1.09))
    panel = pulse(p[0] + 0.01, 0.105, 0.14, w[0]) + pulse(z, 0.2, 0.1, w[2])
    wall = mix(wall, mix((0.05, 0.035, 0.03), (0.16, 0.1, 0.06), np.minimum(panel, 1)), opening(0, 0.2, 0.27, 1.02))
    wall = mix(wall, MARBLE, opening(0.75, 0.17, 0.55, 1.07))
    return mix(wall, (0.06, 0.08, 0.12), opening(0.75, 0.12, 0.6, 1.02))


def _wing(p: Vec, n: Vec, w: Vec) -> np.ndarray:
    """Brick with two rows of windows in pale frames over a stone base."""
    wall = ashlar((0.55, 0.31, 0.21), 0.09, 0.26, 0.8, 0.1)(p, n, w)
    s, ws = _along_face(p, n, w)
    s = np.where(np.abs(n[0]) > np.abs(n[1]), s - 0.05, np.abs(s) - 1.66)
    bay = 0.3
    upright = np.abs(n[2]) < 0.5

    def windows(width: float, bottom: float, top: float) -> np.ndarray:
        row = upright & (((p[2] > bottom) & (p[2] < top)) | ((p[2] > bottom + 0.44) & (p[2] < top + 0.44)))
        return pulse(s - (bay - width) / 2, bay, width / bay, ws) * row

    wall = mix(wall, LIMESTONE, windows(0.18, 0.2, 0.5))
    wall = mix(wall, (0.07, 0.1, 0.15), windows(0.11, 0.23, 0.47))
    wall = mix(wall, LIMESTONE, upright & (p[2] < 0.12))
    return mix(wall, LIMESTONE, upright & (np.abs(p[2] - 0.57) < 0.025))


def _frieze(p: Vec, n: Vec, w: Vec) -> np.ndarray:
    s, ws = _along_face(p, n, w)
    stone = veined(LIMESTONE)(p, n, w)
    band = (p[2] > 1.33) & (p[2] < 1.45) & (np.abs(n[2]) < 0.5)
    field = mix((0.16, 0.25, 0.42), (0.72, 0.64, 0.5), pulse(s + 0.06, 0.25, 0.48, ws))
    return mix(stone, field, band)


def _pediment(p: Vec, n: Vec, w: Vec) -> np.ndarray:
    """A blue field with a golden sun between pale mouldings; terracotta on the slopes."""
    slope_height = 1.575 + 0.43 * (1 - np.abs(p[0]) / 1.5)
    front = n[1] < -0.5
    field = front & (p[2] > 1.625) & (p[2] < slope_height - 0.07)
    face = mix(LIMESTONE, (0.2, 0.29, 0.42), field)
    x, z = p[0], p[2] - 1.755
    radius = np.sqrt(x * x + z * z)
    rays = 0.085 + 0.02 * np.cos(8 * np.arctan2(z, x))
    face = mix(face, (0.8, 0.56, 0.16), front & (radius < rays))
    relief = front & (np.abs(np.abs(x) - 0.45) < 0.16) & (z < 0.02 - 0.35 * (np.abs(x) - 0.45)) & field
    face = mix(face, MARBLE, relief & (np.sin(np.abs(x) * 48) > -0.3))
    return mix(_tiles(p, n, w), face, np.abs(n[2]) < 0.5)


def _tiles(p: Vec, n: Vec, w: Vec) -> np.ndarray:
    """Roof tiles in rows."""
    rows = pulse(p[1], 0.12, 0.25, w[1])
    level = (1 - 0.22 * rows) * (1 + 0.12 * ripple(p, 0.3, w[0]))
    return np.array((0.5, 0.2, 0.11), np.float32)[:, None] * level


def _drum(p: Vec, n: Vec, w: Vec) -> np.ndarray:
    """Twelve arched windows between pilasters."""
    angle = np.arctan2(p[0], -(p[1] - DOME_AT[1])) / (2 * math.pi) * 12
    wide = (w[0] + w[1]) / 2 / 0.3
    x = np.abs(angle - np.round(angle))
    stone = mix(LIMESTONE, MARBLE, pulse(angle - 0.34, 1.0, 0.32, wide))
    arch = 2.08 + LIFT + 0.07 * np.sqrt(np.maximum(1 - (x / 0.22) ** 2, 0))
    return mix(stone, (0.1, 0.12, 0.17), (x < 0.22) & (p[2] > 1.92 + LIFT) & (p[2] < arch) & (np.abs(n[2]) < 0.5))


def _dome(p: Vec, n: Vec, w: Vec) -> np.ndarray:
    """Green copper with sixteen ribs, greener where the rain runs."""
    angle = np.arctan2(p[0] - DOME_AT[0], -(p[1] - DOME_AT[1])) / (2 * math.pi) * 16
    r = np.sqrt((p[0] - DOME_AT[0]) ** 2 + (p[1] - DOME_AT[1]) ** 2)
    rib = pulse(angle + 0.1, 1.0, 0.2, np.minimum((w[0] + w[1]) / np.maximum(r, 0.05) * 1.3, 4.0))
    base = mix((0.2, 0.46, 0.4), (0.3, 0.56, 0.46), 0.5 + 0.5 * ripple(p, 0.5, w[2]))
    return mix(base, (0.1, 0.26, 0.24), rib)


def leaves(colour: RGB, scale: float = 0.16) -> Paint:
    """Foliage: clumps of light and dark green."""

    def paint(p: Vec, n: Vec, w: Vec) -> np.ndarray:
        wide = np.minimum(w[0], w[2])
        level = 1 + 0.34 * ripple(p, scale, wide) + 0.25 * ripple(p, 2.7 * scale, wide) + 0.15 * n[2]
        return np.array(colour, np.float32)[:, None] * np.maximum(level, 0.25)

    return paint


def _ground(p: Vec, n: Vec, w: Vec) -> np.ndarray:
    """Paving with rings around the fountain, two lawns with kerbs, grass around the building, gravel outside."""
    x, y = p[0], p[1]
    wx, wy = w[0], w[1]
    wide = np.maximum(wx, wy)
    near = np.abs(x)
    fx, fy = x - FOUNTAIN[0], y - FOUNTAIN[1]
    r = np.sqrt(fx * fx + fy * fy)
    board = checker(x, y + 0.05, 0.46, wx, wy)
    paving = mix((0.62, 0.53, 0.42), (0.4, 0.35, 0.31), board)
    joint = np.maximum(pulse(x + 0.012, 0.46, 0.052, wx), pulse(y + 0.062, 0.46, 0.052, wy))
    paving = paving * (1 - 0.3 * joint) * (1 + 0.06 * ripple(p, 1.1, wide))
    ring = mix((0.66, 0.58, 0.47), (0.5, 0.26, 0.19), pulse(r, 0.36, 0.5, wide))
    paving = mix(paving, ring, r < 1.08)
    gravel = np.array((0.57, 0.48, 0.36), np.float32)[:, None] * (
        1 + 0.1 * ripple(p, 0.7, wide) + 0.06 * ripple(p, 0.31, wide)
    )
    square = (near < 2.53) & (y > -4.19) & (y < -0.5)
    ground = mix(gravel, paving, square)
    kerb = square & ((near > 2.45) | (y < -4.11))
    ground = mix(ground, MARBLE, kerb)
    mown = mix((0.2, 0.33, 0.08), (0.13, 0.25, 0.06), pulse(x + 0.35 * y, 0.5, 0.5, wide))
    mown = mown * (1 + 0.16 * ripple(p, 0.4, wide) + 0.12 * ripple(p, 1.3, wide))
    dx, dy = np.abs(near - 1.72) - 0.5, np.abs(y + 2.0) - 0.66
    lawn = np.maximum(dx, dy)
    ground = mix(ground, MARBLE, (lawn < 0.05) & (lawn > 0))
    outside = (near > 2.9 + 0.35 * np.sin(1.1 * y)) & (y > -3.0 + 0.4 * np.sin(x)) | (y > 0.2)
    return mix(ground, mown, (lawn <= 0) | outside)


def _skyline(angle: np.ndarray) -> np.ndarray:
    return (
        0.95
        + 0.28 * np.sin(3 * angle + 0.6)
        + 0.14 * np.sin(11 * angle + 1.9)
        + 0.07 * np.abs(np.sin(23 * angle))
        + 0.035 * np.sin(61 * angle)
    )


def _far_trees(p: Vec, n: Vec, w: Vec) -> np.ndarray:
    angle = np.arctan2(p[0], p[1])
    clump = np.sin(23 * angle) * np.sin(5 * p[2] + 9 * angle) + 0.6 * np.sin(47 * angle + 6 * p[2])
    level = 1 + 0.22 * clump * fade(0.9, w[0]) + 0.35 * (p[2] - 0.5)
    return np.array((0.13, 0.2, 0.09), np.float32)[:, None] * np.maximum(level, 0.3)


# ---- the solids

DOME_AT = (0.0, 0.75)
LIFT = 0.16  # of the dome, so that its drum shows above the pediment


@cache
def solids() -> tuple[Solid, ...]:
    """Everything that stands still. The ground is number 0."""
    return (
        Ground(_ground, _disc(RADIUS, 0.0), casts=False, radius=RADIUS),
        Surround(_far_trees, _disc(RADIUS, 1.6), casts=False, radius=RADIUS, skyline=_skyline),
        *_building(),
        *_portico(),
        *_crown(),
        *_square(),
        *_trees(),
    )


def _disc(radius: float, top: float) -> np.ndarray:
    return np.array([(i * radius, j * radius, z) for i in (-1, 1) for j in (-1, 1) for z in (0.0, top)])


def _building() -> list[Solid]:
    stone, marble = ashlar(LIMESTONE), veined(MARBLE)
    parts: list[Solid] = [
        box(-1.62 + 0.1 * k, 1.62 - 0.1 * k, -1.16 + 0.1 * k, 0.2, 0.09 * k, 0.09 * (k + 1), marble if k % 2 else stone)
        for k in range(3)
    ]
    parts += [
        box(-1.4, 1.4, -0.05, 1.6, 0.0, 1.46, _facade),
        box(-1.46, 1.46, 0.29, 1.66, 1.43, 1.5, marble),
        box(-0.9, 0.9, 0.0, 1.6, 1.5, 1.78 + LIFT, stone),
    ]
    for side in (-1, 1):
        x0, x1 = sorted((1.38 * side, 2.6 * side))
        parts += [
            box(x0, x1, 0.15, 1.35, 0.0, 1.06, _wing),
            box(x0 - 0.04, x1 + 0.04, 0.1, 1.4, 1.06, 1.13, marble),
            tapered(((x0 + x1) / 2, 0.75), 0.0, 1.13, 1.42, (1.2, 1.28), (0.7, 0.1), _tiles),
        ]
    return parts


COLUMNS = [(-1.27 + 0.508 * k, -0.74) for k in range(6)] + [(-1.27, -0.38), (1.27, -0.38)]


def _portico() -> list[Solid]:
    marble = veined(MARBLE)
    parts: list[Solid] = []
    for x, y in COLUMNS:
        parts += [
            box(x - 0.125, x + 0.125, y - 0.125, y + 0.125, 0.27, 0.31, marble),
            frustum((x, y), 0.31, 1.2, 0.098, 0.078, column((x, y))),
            frustum((x, y), 1.2, 1.26, 0.08, 0.12, marble),
            box(x - 0.125, x + 0.125, y - 0.125, y + 0.125, 1.26, 1.3, marble),
        ]
    return [
        *parts,
        box(-1.42, 1.42, -0.89, 0.3, 1.3, 1.5, _frieze),
        box(-1.5, 1.5, -0.97, 0.3, 1.5, 1.575, marble),
        tapered((0.0, -0.4), 0.0, 1.575, 2.0, (3.0, 1.1), (0.01, 1.1), _pediment),
    ]


def _crown() -> list[Solid]:
    at, marble, gold = DOME_AT, veined(MARBLE), plain((0.8, 0.56, 0.16))

    def ring(z0: float, z1: float, r0: float, r1: float, paint: Paint) -> Solid:
        return frustum(at, z0 + LIFT, z1 + LIFT, r0, r1, paint)

    return [
        ring(1.78, 1.86, 0.76, 0.76, marble),
        ring(1.86, 2.2, 0.66, 0.66, _drum),
        ring(2.2, 2.27, 0.73, 0.73, marble),
        ellipsoid((*at, 2.26 + LIFT), (0.66, 0.66, 0.62), _dome),
        ring(2.84, 2.9, 0.17, 0.15, marble),
        ring(2.9, 3.06, 0.1, 0.1, plain((0.3, 0.3, 0.33))),
        ellipsoid((*at, 3.06 + LIFT), (0.14, 0.14, 0.12), gold),
        ring(3.15, 3.36, 0.03, 0.0, gold),
    ]


def _square() -> list[Solid]:
    marble, stone, bronze = veined(MARBLE), ashlar(LIMESTONE, 0.09, 0.2), veined((0.2, 0.3, 0.24), 0.2, 0.25)
    x, y = FOUNTAIN

    def water(p: Vec, n: Vec, w: Vec) -> np.ndarray:
        r = np.sqrt((p[0] - x) ** 2 + (p[1] - y) ** 2)
        inside = (n[2] > 0.7) & (r < 0.47)
        return mix(marble(p, n, w), mix((0.12, 0.34, 0.42), (0.2, 0.46, 0.52), pulse(r, 0.11, 0.5, w[0])), inside)

    parts: list[Solid] = [
        frustum((x, y), 0.0, 0.12, 0.56, 0.56, water),
        frustum((x, y), 0.12, 0.36, 0.08, 0.06, marble),
        frustum((x, y), 0.34, 0.43, 0.07, 0.27, marble),
        frustum((x, y), 0.43, 0.6, 0.05, 0.035, marble),
        ellipsoid((x, y, 0.66), (0.1, 0.1, 0.1), plain((0.8, 0.56, 0.16))),
        # the obelisk on the right lawn
        box(1.47, 1.97, -2.25, -1.75, 0.0, 0.1, stone),
        box(1.56, 1.88, -2.16, -1.84, 0.1, 0.3, marble),
        tapered((1.72, -2.0), 0.0, 0.3, 1.5, (0.24, 0.24), (0.15, 0.15), ashlar((0.6, 0.36, 0.28), 0.2, 0.9)),
        tapered((1.72, -2.0), 0.0, 1.5, 1.64, (0.15, 0.15), (0.01, 0.01), plain((0.8, 0.56, 0.16))),
        # the flower bed on the left lawn
        ellipsoid((-1.75, -2.0, 0.0), (0.4, 0.4, 0.14), _flowers),
        ellipsoid((-1.75, -2.0, 0.2), (0.17, 0.17, 0.2), leaves((0.1, 0.24, 0.07), 0.1), rough=0.5),
    ]
    for side in (-1, 1):
        x = 1.75 * side
        parts += [
            box(x - 0.16, x + 0.16, -1.42, -0.95, 0.0, 0.36, stone),
            box(x - 0.19, x + 0.19, -1.45, -0.92, 0.36, 0.41, marble),
            ellipsoid((x, -1.15, 0.53), (0.1, 0.21, 0.12), bronze),
            ellipsoid((x, -1.3, 0.66), (0.1, 0.1, 0.12), bronze),
            ellipsoid((x, -1.38, 0.65), (0.055, 0.08, 0.06), bronze),
        ]
    return parts


def _flowers(p: Vec, n: Vec, w: Vec) -> np.ndarray:
    angle = np.arctan2(p[1] + 2.0, p[0] + 1.75) / (2 * math.pi) * 6
    petals = mix((0.7, 0.1, 0.12), (0.82, 0.62, 0.12), pulse(angle, 1.0, 0.5, w[0] / 0.3))
    return petals * (1 + 0.2 * ripple(p, 0.12, w[0]))


def _trees() -> list[Solid]:
    bark = plain((0.2, 0.13, 0.08))
    parts: list[Solid] = []
    crowns = [
        (-3.0, -0.35, 1.0, (0.15, 0.28, 0.07)),
        (3.1, -0.15, 0.88, (0.24, 0.3, 0.07)),
        (-3.9, 0.9, 1.3, (0.1, 0.22, 0.07)),
        (3.8, 1.2, 1.2, (0.13, 0.24, 0.06)),
        (-4.6, -0.9, 0.95, (0.3, 0.26, 0.06)),
        (4.8, -0.6, 1.1, (0.11, 0.22, 0.08)),
        (-2.1, 3.2, 1.4, (0.12, 0.23, 0.08)),
        (2.3, 3.4, 1.3, (0.14, 0.25, 0.07)),
    ]
    for k, (x, y, s, green) in enumerate(crowns):
        paint = leaves(green, 0.2 * s)
        parts.append(frustum((x, y), 0.0, 0.75 * s, 0.07 * s, 0.045 * s, bark))
        turn = 0.9 * k
        parts.append(ellipsoid((x, y, 1.2 * s), (0.42 * s, 0.42 * s, 0.46 * s), paint, rough=0.55))
        for j in range(3):
            a = turn + 2.1 * j
            centre = (x + 0.3 * s * math.cos(a), y + 0.3 * s * math.sin(a), (0.92 + 0.09 * j) * s)
            parts.append(ellipsoid(centre, (0.32 * s, 0.32 * s, 0.27 * s), paint, rough=0.55))
    for x, y in ((-2.25, -0.42), (2.25, -0.42)):
        parts.append(frustum((x, y), 0.0, 0.14, 0.035, 0.035, bark))
        parts.append(ellipsoid((x, y, 0.68), (0.15, 0.15, 0.6), leaves((0.06, 0.17, 0.07), 0.13), rough=0.5))
    return parts


# ---- surfaces seen by rays


def surfaces(hits: Hits, index: np.ndarray, shapes: tuple[Solid, ...] | list[Solid]) -> tuple[Vec, Vec, np.ndarray]:
    """Points, normals and albedo (3, n) at the hits number `index` (flat) of rays against `shapes`."""
    which = hits.which.reshape(-1)[index]
    t = hits.t.reshape(-1)[index]
    rays = take(each(np.ravel, hits.rays), index)
    c = hits.camera.centre
    points = c[0] + t * rays[0], c[1] + t * rays[1], c[2] + t * rays[2]
    normals = np.zeros((3, index.size), np.float32)
    albedo = np.zeros((3, index.size), np.float32)
    width = t * np.float32(0.5 * 1.3 / min(hits.camera.fx, hits.camera.fy))
    order = np.argsort(which, kind="stable")
    starts = np.searchsorted(which[order], np.arange(len(shapes) + 1))
    for number in range(len(shapes)):
        mine = order[starts[number] : starts[number + 1]]
        if not mine.size:
            continue
        solid, p, d = shapes[number], take(points, mine), unit(take(rays, mine))
        n = solid.normal(p)
        facing = np.maximum(-dot(d, n), 0.05)
        slant = np.sqrt(np.maximum(1 - facing * facing, 0)) / facing
        w = tuple(width[mine] * (1 + np.abs(d[k]) * slant) for k in range(3))
        albedo[:, mine] = solid.paint(p, n, w)
        if solid.rough:
            n = _rustle(p, n, solid.rough)
        normals[:, mine] = n
    return points, (normals[0], normals[1], normals[2]), albedo


def _rustle(p: Vec, n: Vec, amount: float) -> Vec:
    """Normals of foliage, bent by a smooth wave."""
    return unit(
        (
            n[0] + amount * np.sin(23 * p[0] + 17 * p[2] + 3 * np.sin(11 * p[1])),
            n[1] + amount * np.sin(21 * p[1] - 19 * p[2] + 3 * np.sin(13 * p[0])),
            n[2] + amount * np.sin(25 * p[2] + 15 * p[0] - 3 * np.sin(12 * p[1])),
        )
    )


# Spheres (x, y, z, r) that dim the sky's light around them.
_SHADERS = [
    (0.0, -2.35, 0.1, 0.5), (-3.0, -0.35, 0.9, 0.5), (3.1, -0.15, 0.8, 0.45), (-3.9, 0.9, 1.2, 0.65),
    (3.8, 1.2, 1.1, 0.6), (1.72, -2.0, 0.25, 0.26), (-1.75, -1.2, 0.3, 0.26), (1.75, -1.2, 0.3, 0.26),
    (-4.6, -0.9, 0.9, 0.5), (4.8, -0.6, 1.0, 0.55),
]  # fmt: skip


def openness(p: Vec, n: Vec) -> np.ndarray:
    """Share of the sky's light that reaches a point of the still scene: a cheap stand-in for ambient occlusion."""
    x, y, z = p
    share = np.ones_like(x)
    for sphere in _SHADERS:
        share = share * shade_of(p, n, sphere)
    # on the ground, near the walls
    dx, dy = np.maximum(np.abs(x) - 2.6, 0), np.maximum(np.maximum(-0.95 - y, y - 1.6), 0)
    share = share * (1 - 0.45 * np.exp(-np.sqrt(dx * dx + dy * dy) / 0.3) * (z < 0.02))
    # inside the portico, the deeper the darker
    inside = (np.abs(x) < 1.43) & (y < 0.0) & (y > -0.9) & (z > 0.26) & (z < 1.31)
    depth = np.clip((y + 0.86) / 0.8, 0, 1)
    away = np.clip(1 - (z - 0.3) / 1.1, 0, 1)
    return np.where(inside, share * (1 - depth * (0.62 - 0.22 * away)), share)


def shade_of(p: Vec, n: Vec, sphere: tuple[float, float, float, float]) -> np.ndarray:
    """Share of the sky's light that passes a sphere (x, y, z, r)."""
    d = (sphere[0] - p[0], sphere[1] - p[1], sphere[2] - p[2])
    squared = np.maximum(dot(d, d), sphere[3] ** 2)
    facing = np.maximum(dot(d, n) / np.sqrt(squared), 0)
    return 1 - 0.75 * facing * sphere[3] ** 2 / squared
