"""Rays against convex solids, vectorised: what the built-in landmark and its tourists are made of.

Notation: the world has z up and the ground at z = 0. Vectors of many rays are triples of equally shaped float32 arrays
(x, y, z), so that every operation runs over contiguous memory and no result depends on a matrix library's threads.
A ray is origin + t * direction; a miss is t = inf. Directions from a camera have a z-component of 1 in the camera's
frame, so their t *is* the z-depth.

A solid has `paint(p, n, w) -> (3, n)`, its linear albedo at points p with normals n; w = (wx, wy, wz) is the
footprint of a sample along each world axis, by which the patterns below filter themselves.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

Vec = tuple[np.ndarray, np.ndarray, np.ndarray]
Broadcast = Any  # an array, a number, or a triple of either that broadcasts against arrays
Paint = Callable[[Vec, Vec, Vec], np.ndarray]
EPS = 1e-4


def dot(a: Broadcast, b: Broadcast) -> Any:
    """Sum of products; either side may be three plain numbers."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def each(function: Callable[..., Any], *triples: Broadcast) -> Vec:
    """The function applied to x, y and z of the triples."""
    x, y, z = (function(*parts) for parts in zip(*triples, strict=True))
    return x, y, z


def take(v: Vec, index: Any) -> Vec:
    """The same triple at `index` (a mask, integers, or slices)."""
    return v[0][index], v[1][index], v[2][index]


def unit(v: Vec) -> Vec:
    inverse = 1 / np.sqrt(np.maximum(dot(v, v), 1e-20))
    return v[0] * inverse, v[1] * inverse, v[2] * inverse


def _turn(x: float, y: float, yaw: float) -> tuple[float, float]:
    return x * math.cos(yaw) - y * math.sin(yaw), x * math.sin(yaw) + y * math.cos(yaw)


@dataclass(frozen=True)
class Solid:
    """What every shape has; `corners` (n, 3) are the vertices of a convex hull around it."""

    paint: Paint
    corners: np.ndarray
    rough: float = 0.0  # how much the foliage's ripples bend the normal
    casts: bool = True

    def hit(self, o: Broadcast, d: Broadcast) -> Any:
        """Smallest t > EPS, or inf. `o` and `d` broadcast against each other."""
        raise NotImplementedError

    def normal(self, p: Vec) -> Vec:
        raise NotImplementedError


@dataclass(frozen=True)
class Convex(Solid):
    """Intersection of half-spaces n . x <= c: boxes, roofs, obelisks, car cabins."""

    planes: tuple[tuple[float, float, float, float], ...] = ()

    def hit(self, o: Broadcast, d: Broadcast) -> Any:
        near: Any = np.float32(-np.inf)
        far: Any = np.float32(np.inf)
        for a, b, c, offset in self.planes:
            along = dot((a, b, c), d)
            along = np.where(along == 0, np.float32(1e-12), along)
            t = (offset - dot((a, b, c), o)) / along
            near = np.where(along < 0, np.maximum(near, t), near)
            far = np.where(along > 0, np.minimum(far, t), far)
        return np.where((near <= far) & (near > EPS), near, np.float32(np.inf))

    def normal(self, p: Vec) -> Vec:
        best = np.full(p[0].shape, -np.inf, np.float32)
        normal = np.zeros((3, *p[0].shape), np.float32)
        for a, b, c, offset in self.planes:
            distance = dot((a, b, c), p) - offset
            closer = distance > best
            best = np.where(closer, distance, best)
            normal[:, closer] = np.array([[a], [b], [c]], np.float32)
        return normal[0], normal[1], normal[2]


@dataclass(frozen=True)
class Ellipsoid(Solid):
    centre: tuple[float, float, float] = (0, 0, 0)
    radii: tuple[float, float, float] = (1, 1, 1)
    yaw: float = 0.0

    def _to_sphere(self, v: Broadcast) -> Broadcast:
        x, y = _turn_arrays(v[0], v[1], -self.yaw)
        return x / self.radii[0], y / self.radii[1], v[2] / self.radii[2]

    def hit(self, o: Broadcast, d: Broadcast) -> Any:
        cx, cy, cz = self.centre
        start = self._to_sphere((o[0] - cx, o[1] - cy, o[2] - cz))
        along = self._to_sphere(d)
        a, b, c = dot(along, along), dot(start, along), dot(start, start) - 1
        root = b * b - a * c
        t = (-b - np.sqrt(np.maximum(root, 0))) / a
        return np.where((root > 0) & (t > EPS), t, np.float32(np.inf))

    def normal(self, p: Vec) -> Vec:
        cx, cy, cz = self.centre
        x, y, z = self._to_sphere((p[0] - cx, p[1] - cy, p[2] - cz))
        x, y = _turn_arrays(x / self.radii[0], y / self.radii[1], self.yaw)
        return unit((x, y, z / self.radii[2]))


def _turn_arrays(x: Broadcast, y: Broadcast, yaw: float) -> Broadcast:
    if yaw == 0:
        return x, y
    c, s = math.cos(yaw), math.sin(yaw)
    return x * c - y * s, x * s + y * c


@dataclass(frozen=True)
class Frustum(Solid):
    """An upright capped cone: radius r0 at height z0, r1 at z1 (cylinder where they are equal)."""

    at: tuple[float, float] = (0, 0)
    z0: float = 0.0
    z1: float = 1.0
    r0: float = 1.0
    r1: float = 1.0

    def hit(self, o: Broadcast, d: Broadcast) -> Any:
        slope = (self.r1 - self.r0) / (self.z1 - self.z0)
        x, y, z = o[0] - self.at[0], o[1] - self.at[1], o[2]
        radius = self.r0 + slope * (z - self.z0)
        a = d[0] * d[0] + d[1] * d[1] - slope * slope * d[2] * d[2]
        a = np.where(np.abs(a) < 1e-9, np.float32(1e-9), a)
        b = x * d[0] + y * d[1] - slope * radius * d[2]
        inside = b * b - a * (x * x + y * y - radius * radius)
        root = np.sqrt(np.maximum(inside, 0))
        best: Any = np.float32(np.inf)
        for t in ((-b - root) / a, (-b + root) / a):
            height = z + t * d[2]
            good = (inside > 0) & (t > EPS) & (height >= self.z0) & (height <= self.z1)
            best = np.where(good & (t < best), t, best)
        dz = np.where(d[2] == 0, np.float32(1e-12), d[2])
        for level, r in ((self.z0, self.r0), (self.z1, self.r1)):
            t = (level - z) / dz
            px, py = x + t * d[0], y + t * d[1]
            best = np.where((t > EPS) & (px * px + py * py <= r * r) & (t < best), t, best)
        return best

    def normal(self, p: Vec) -> Vec:
        slope = (self.r1 - self.r0) / (self.z1 - self.z0)
        x, y = p[0] - self.at[0], p[1] - self.at[1]
        r = np.sqrt(np.maximum(x * x + y * y, 1e-12))
        side = r - (self.r0 + slope * (p[2] - self.z0))
        top, bottom = p[2] - self.z1, self.z0 - p[2]
        cap = np.maximum(top, bottom) > side
        up = np.where(top > bottom, np.float32(1), np.float32(-1))
        x, y, z = unit((x / r, y / r, np.full_like(r, -slope)))
        return np.where(cap, 0, x), np.where(cap, 0, y), np.where(cap, up, z)


@dataclass(frozen=True)
class Ground(Solid):
    """The disc z = 0, |x, y| <= radius."""

    radius: float = 1.0

    def hit(self, o: Broadcast, d: Broadcast) -> Any:
        t = -o[2] / np.where(d[2] == 0, np.float32(1e-12), d[2])
        x, y = o[0] + t * d[0], o[1] + t * d[1]
        return np.where((t > EPS) & (x * x + y * y <= self.radius**2), t, np.float32(np.inf))

    def normal(self, p: Vec) -> Vec:
        zero = np.zeros_like(p[0])
        return zero, zero, zero + 1


@dataclass(frozen=True)
class Surround(Solid):
    """The inner side of an upright cylinder around the origin whose top is a skyline: a far row of trees."""

    radius: float = 1.0
    skyline: Callable[[np.ndarray], np.ndarray] = field(default=np.zeros_like)

    def hit(self, o: Broadcast, d: Broadcast) -> Any:
        a = d[0] * d[0] + d[1] * d[1]
        b = o[0] * d[0] + o[1] * d[1]
        c = o[0] * o[0] + o[1] * o[1] - self.radius**2
        t = (-b + np.sqrt(np.maximum(b * b - a * c, 0))) / np.maximum(a, 1e-12)
        height = o[2] + t * d[2]
        top = self.skyline(np.arctan2(o[0] + t * d[0], o[1] + t * d[1]))
        return np.where((height >= 0) & (height <= top), t, np.float32(np.inf))

    def normal(self, p: Vec) -> Vec:
        return unit((-p[0], -p[1], np.full_like(p[0], 0.35 * self.radius)))


# ---- making solids


def box(x0: float, x1: float, y0: float, y1: float, z0: float, z1: float, paint: Paint) -> Convex:
    """An upright box along the axes."""
    at, size = ((x0 + x1) / 2, (y0 + y1) / 2), (x1 - x0, y1 - y0)
    return tapered(at, 0.0, z0, z1, size, size, paint)


def tapered(
    at: Sequence[float],
    yaw: float,
    z0: float,
    z1: float,
    bottom: Sequence[float],
    top: Sequence[float],
    paint: Paint,
    shift: float = 0.0,
) -> Convex:
    """A block whose `bottom` (length, width) and `top` differ; the top may be shifted along its length."""
    (l0, w0), (l1, w1), rise = bottom, top, z1 - z0
    planes = [(0.0, 0.0, 1.0, z1), (0.0, 0.0, -1.0, -z0)]
    for sign in (1, -1):
        lean = (l0 - l1) / 2 - sign * shift
        planes.append((sign * rise, 0.0, lean, rise * l0 / 2 + lean * z0))
        planes.append((0.0, sign * rise, (w0 - w1) / 2, rise * w0 / 2 + (w0 - w1) / 2 * z0))
    placed = []
    for a, b, c, offset in planes:
        length = math.sqrt(a * a + b * b + c * c)
        x, y = _turn(a / length, b / length, yaw)
        placed.append((x, y, c / length, offset / length + x * at[0] + y * at[1]))
    corners = [
        (*_turn(s * length / 2 + lean, t * width / 2, yaw), z)
        for length, width, z, lean in ((l0, w0, z0, 0.0), (l1, w1, z1, shift))
        for s in (1, -1)
        for t in (1, -1)
    ]
    return Convex(paint, np.array(corners) + [at[0], at[1], 0], planes=tuple(placed))


def ellipsoid(
    centre: Sequence[float], radii: Sequence[float], paint: Paint, yaw: float = 0.0, rough: float = 0.0
) -> Ellipsoid:
    reach = (max(radii[:2]), max(radii[:2]), radii[2]) if yaw else radii
    (x, y, z), (a, b, c) = map(float, centre), map(float, radii)
    return Ellipsoid(paint, _box_corners(centre, reach), rough, centre=(x, y, z), radii=(a, b, c), yaw=yaw)


def frustum(at: Sequence[float], z0: float, z1: float, r0: float, r1: float, paint: Paint) -> Frustum:
    r = max(r0, r1)
    corners = _box_corners((at[0], at[1], (z0 + z1) / 2), (r, r, (z1 - z0) / 2))
    return Frustum(paint, corners, at=(float(at[0]), float(at[1])), z0=z0, z1=z1, r0=r0, r1=r1)


def _box_corners(centre: Sequence[float], reach: Sequence[float]) -> np.ndarray:
    signs = np.array([(i, j, k) for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    return np.array(centre) + signs * np.array(reach)


# ---- cameras


@dataclass(frozen=True)
class Pinhole:
    """A photo's size and camera. `rotation` rows are the camera's x (right), y (down), z (forward) in the world."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    rotation: tuple[tuple[float, float, float], ...]
    centre: tuple[float, float, float]

    def directions(self, u: np.ndarray, v: np.ndarray) -> Vec:
        """World directions, camera z-component 1, of pixel coordinates (pixel centres at +0.5), which broadcast."""
        x = ((u - self.cx) / self.fx).astype(np.float32)
        y = ((v - self.cy) / self.fy).astype(np.float32)
        right, down, forward = self.rotation
        return (
            x * right[0] + y * down[0] + forward[0],
            x * right[1] + y * down[1] + forward[1],
            x * right[2] + y * down[2] + forward[2],
        )

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pixel coordinates u, v and z-depth of points (n, 3), in double precision."""
        offset = np.asarray(points, np.float64) - np.array(self.centre)
        x, y, z = (offset[:, 0] * r[0] + offset[:, 1] * r[1] + offset[:, 2] * r[2] for r in self.rotation)
        safe = np.where(np.abs(z) < 1e-9, 1e-9, z)
        return self.fx * x / safe + self.cx, self.fy * y / safe + self.cy, z

    def window(self, corners: np.ndarray) -> tuple[float, float, float, float] | None:
        """Bounds (u0, u1, v0, v1) of `corners`; infinite where they reach behind the camera, None if all do."""
        u, v, z = self.project(corners)
        if z.max() < 0.02:
            return None
        if z.min() < 0.02:
            return -math.inf, math.inf, -math.inf, math.inf
        return float(u.min()) - 0.5, float(u.max()) + 0.5, float(v.min()) - 0.5, float(v.max()) + 0.5


# ---- tracing


@dataclass
class Hits:
    """Nearest hits of rays from one point: `t` (inf: sky) and `which` solid (-1: sky), shaped like the rays."""

    camera: Pinhole
    rays: Vec
    t: np.ndarray
    which: np.ndarray

    def points(self, index: Any) -> Vec:
        t, d, c = self.t[index], take(self.rays, index), self.camera.centre
        return c[0] + t * d[0], c[1] + t * d[1], c[2] + t * d[2]


def trace_grid(camera: Pinhole, solids: Sequence[Solid], samples: float) -> Hits:
    """Rays through a grid of round(samples * side) cells: 1 gives the pixel centres, 2 gives 2 x 2 a pixel."""
    columns, rows = round(camera.width * samples), round(camera.height * samples)
    u = (np.arange(columns) + 0.5) * (camera.width / columns)
    v = (np.arange(rows) + 0.5) * (camera.height / rows)
    rays = camera.directions(u[None, :], v[:, None])
    hits = Hits(camera, rays, np.full(rays[0].shape, np.inf, np.float32), np.full(rays[0].shape, -1, np.int16))
    add_solids(hits, solids, first=0)
    return hits


def add_solids(hits: Hits, solids: Sequence[Solid], first: int) -> None:
    """Let more solids, numbered from `first`, stand in front of what a grid of rays has hit so far."""
    camera, (rows, columns) = hits.camera, hits.t.shape
    for number, solid in enumerate(solids, first):
        window = camera.window(solid.corners)
        if window is None:
            continue
        c0, c1 = (_clamp(w * columns / camera.width, columns) for w in window[:2])
        r0, r1 = (_clamp(w * rows / camera.height, rows) for w in window[2:])
        part = (slice(r0, r1 + 1), slice(c0, c1 + 1))
        t = solid.hit(camera.centre, take(hits.rays, part))
        closer = t < hits.t[part]
        hits.t[part][closer] = t[closer]
        hits.which[part][closer] = number


def _clamp(x: float, size: int) -> int:
    return int(min(max(x, -1.0), size)) if x >= 0 else 0


def trace_points(camera: Pinhole, solids: Sequence[Solid], u: np.ndarray, v: np.ndarray) -> Hits:
    """Rays through scattered pixel coordinates u, v (n,)."""
    rays = camera.directions(u, v)
    hits = Hits(camera, rays, np.full(u.shape, np.inf, np.float32), np.full(u.shape, -1, np.int16))
    for number, solid in enumerate(solids):
        window = camera.window(solid.corners)
        if window is None:
            continue
        inside = np.flatnonzero((u > window[0]) & (u < window[1]) & (v > window[2]) & (v < window[3]))
        t = solid.hit(camera.centre, take(rays, inside))
        closer = t < hits.t[inside]
        hits.t[inside[closer]] = t[closer]
        hits.which[inside[closer]] = number
    return hits


def sunlit(points: Vec, solids: Sequence[Solid], sun: Sequence[float]) -> np.ndarray:
    """bool (n,): whether a parallel ray from each point towards `sun` (unit) leaves the scene.

    Points and solids are compared first in the plane across the light, where most pairs cannot meet.
    """
    side = np.cross(sun, (0.0, 0.0, 1.0))
    side = side / np.linalg.norm(side)
    up = np.cross(side, sun)
    axes = np.array([side, up, sun])
    a, b, c = (dot(points, axis) for axis in axes.astype(np.float32))
    towards = each(np.float32, sun)
    lit = np.ones(points[0].shape, bool)
    for solid in solids:
        if not solid.casts:
            continue
        across = (solid.corners[:, None, :] * axes).sum(2)
        (a0, b0, _), (a1, b1, c1) = across.min(0).tolist(), across.max(0).tolist()
        near = np.flatnonzero((a > a0) & (a < a1) & (b > b0) & (b < b1) & (c < c1) & lit)
        if near.size:
            lit[near] = ~np.isfinite(solid.hit(take(points, near), towards))
    return lit


# ---- patterns that filter themselves


def pulse(x: Broadcast, period: float, duty: float, w: Broadcast) -> np.ndarray:
    """Share of [x - w/2, x + w/2] in which frac(x / period) < duty: stripes that never alias."""
    w = np.maximum(w, 1e-3 * period) / period
    x = x / period

    def filled(s: np.ndarray) -> np.ndarray:
        whole = np.floor(s)
        return whole * duty + np.minimum(s - whole, duty)

    return (filled(x + w / 2) - filled(x - w / 2)) / w


def checker(x: Broadcast, y: Broadcast, period: float, wx: Broadcast, wy: Broadcast) -> np.ndarray:
    """1 on the black fields of a board with squares of `period`, 0 on the white ones, filtered."""
    return 0.5 + 0.5 * (2 * pulse(x, 2 * period, 0.5, wx) - 1) * (2 * pulse(y, 2 * period, 0.5, wy) - 1)


def ripple(p: Vec, scale: float, w: Broadcast) -> np.ndarray:
    """Smooth noise of wavelengths about `scale`, in [-1, 1], gone where the footprint w nears the wavelength."""
    f = 2 * math.pi / scale
    x, y, z = (v * f for v in p)
    wave = (
        np.sin(x * 0.83 + y * 0.51 + z * 0.33 + 1.3 * np.sin(y * 0.47 - z * 0.62))
        + np.sin(y * 0.79 - x * 0.42 + z * 0.57 + 1.1 * np.sin(z * 0.55 + x * 0.38))
        + np.sin(z * 0.88 + x * 0.37 - y * 0.46 + 1.2 * np.sin(x * 0.61 + y * 0.29))
    )
    return wave / 3 * fade(scale, w)


def fade(period: float, w: Broadcast) -> np.ndarray:
    """Contrast left of a pattern of `period` under a footprint w."""
    return np.exp(-((2.2 * w / period) ** 2))


def mix(a: Broadcast, b: Broadcast, share: Broadcast) -> np.ndarray:
    """Colours (3,) or (3, n) blended: b where share (n,) is 1."""
    a, b = (np.asarray(c, np.float32).reshape(3, -1) for c in (a, b))
    return a + (b - a) * share


def plain(colour: Sequence[float]) -> Paint:
    """One albedo everywhere."""
    tint = np.array(colour, np.float32)[:, None]
    return lambda p, n, w: np.broadcast_to(tint, (3, p[0].size))
