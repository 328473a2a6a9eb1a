"""Smooth camera paths that stay where a scene was seen: a loop through the training cameras, and flights from photo to
photo.

The loop's every centre and every point that it looks at is a convex combination of those of the training cameras, with
most of the weight on cameras nearby: so it lies within their hull, and looks as the cameras around it look. Between few
cameras that stand apart nothing can be learned: there it is a flight through those that stand together, and back.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter1d
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation, RotationSpline

from pipeline.errors import CrossrayError
from pipeline.views.camera import Camera, posed, resized
from pipeline.views.geometry import TINY, focus_of, looking, median_of, unit, up_of, weighted_median
from pipeline.views.path import MAX_FRAMES

NEAREST = 8  # cameras whose depth bounds a view takes over
GAP = math.radians(60)  # between neighbours around the focus: a wider one is no part of the loop
BAND = math.radians(12)  # of angles over which cameras are averaged, at most
TAILS = (5, 95)  # percentiles of the cameras' angles between which an open loop stays
ASPECT = 3 / 2
ZOOM = 0.5  # radians by which the edge of a usual picture moves when it grows e-fold
DENSE = 512  # points in which a loop is laid out
AWAY = 0.3  # from all cameras, of the distance to what the nearest one looks at: some 17 degrees
LOST = 0.25  # share of a loop that may be away: of photos that surround a place, up to 45 degrees apart, less is
TOGETHER = 0.45  # between two cameras that stand together, of the distance to what they look at: some 25 degrees
SPOT = 0.02  # of the median distance: cameras within stand in one spot
LINKS = 16  # nearest spots that a spot may be together with
ALIKE = math.radians(30)  # between their viewing directions
SMOOTHING = 0.02  # of a loop's length: sigma of the filter that rounds its corners


def bounds_at(cameras: Sequence[Camera], centres: np.ndarray) -> np.ndarray:
    """Depth bounds (F, 2), near and far, of views from `centres` (F, 3): those of a camera where it stands, elsewhere
    geometric means of the NEAREST ones, whose weights fall to zero at the next one's distance, so that bounds change
    smoothly (Franke and Little's weights).

    Wider bounds would show what floats where no photo has looked: with the least near and the greatest far of all
    frames an orbit of the quick start's run shimmers by a fifth more, and is 0.3 dB farther from the truth
    (`benchmarks/film_bounds.py`).
    """
    lengths = np.log([(camera.near, camera.far) for camera in cameras])
    count = min(NEAREST + 1, len(cameras))
    distance, nearest = cKDTree([camera.pose[:, 3] for camera in cameras]).query(centres, k=range(1, count + 1))
    end = distance[:, -1:] if len(cameras) > NEAREST else 2 * distance[:, -1:]
    distance = np.maximum(distance, 1e-6 * end + TINY)
    weights = (np.maximum(end - distance, 0) / distance) ** 2 + TINY
    return np.exp(np.einsum("fk,fkb->fb", weights / weights.sum(1, keepdims=True), lengths[nearest]))


def orbit(cameras: Sequence[Camera], frames: int, size: tuple[int, int] | None = None) -> list[Camera]:
    """A closed loop through training cameras: around what they look at where they surround it, else along them and
    back; it starts and ends without a jump. Where more than LOST of it is away from all cameras, it is a flight through
    the largest group of cameras that stand `together`, in pictures that show no more than theirs do.

    The field of view across the shorter side follows that of the cameras around: a wide picture then shows no more
    above and below than their photos do. Depth bounds are `bounds_at`, or between those of a flight's stops. Memory: a
    few DENSE x len(cameras) float64.

    Args:
        size: width and height of the pictures; by default 3:2, as high as the photos' shorter sides in the median.

    Raises:
        CrossrayError: no camera, a number of frames outside 1 to MAX_FRAMES, or a size without pixels.
    """
    check_count(frames)
    if not cameras:
        raise CrossrayError("an orbit goes along training cameras, and there is none")
    poses = np.array([camera.pose for camera in cameras])
    up = up_of(poses)
    typical = median_distance(cameras)
    targets, angles = looked_at(poses, up, typical)
    route, is_closed = angle_route(angles)
    focal = np.log([[math.sqrt(c.fx * c.fy) / min(c.width, c.height)] for c in cameras])
    rows = laid_out(np.hstack([poses[:, :, 3], targets, focal]), angles, route, is_closed, typical)
    if lost(rows[:, :3], poses, targets) > LOST and len(group := together(poses, targets)) > 1:
        there = [cameras[group[k]] for k in unrolled(angles[group])]
        return there_and_back(there, frames, centred(cameras, size))
    share = np.arange(frames) / frames
    share = share if is_closed else (1 - np.cos(2 * np.pi * share)) / 2  # there and back, slow where it turns
    centre, target, focal = np.split(sampled(rows, share, is_closed), (3, 6), axis=1)
    _, nearest = cKDTree(poses[:, :, 3]).query(centre)
    rotation = looking(unit(target - centre, poses[nearest, :, 2]), up)
    lens = centred(cameras, size)
    f = np.exp(focal) * min(lens.width, lens.height)
    lengths = np.hstack([f, bounds_at(cameras, centre)]).tolist()
    return [
        posed(replace(lens, fx=f, fy=f, near=near, far=far), np.column_stack([r, c]))
        for r, c, (f, near, far) in zip(rotation, centre, lengths, strict=True)
    ]


def between(stops: Sequence[Camera], frames: int) -> list[Camera]:
    """A flight from camera to camera, easing in and out; the first and last frame are the first and last stop exactly
    (a single frame is the first stop).

    Centres go straight between two stops, as the chord stays among the cameras where an arc would bulge out of them,
    and two photos alone do not tell what the arc should go around. Through several stops they follow a monotone cubic,
    which never overshoots, rotations a spline with continuous angular velocity (of two: slerp), and focal lengths and
    depth bounds are interpolated in their logarithms. Size: that of the first stop, to which the others are `resized`.

    Raises:
        CrossrayError: fewer than two stops, or a number of frames outside 1 to MAX_FRAMES.
    """
    check_count(frames)
    if len(stops) < 2:
        raise CrossrayError(f"a flight needs two cameras at least, and has {len(stops)}")
    first, *_ = stops = same_size(stops)
    poses = np.array([stop.pose for stop in stops])
    rotations = Rotation.from_matrix(poses[:, :, :3])
    lengths = np.log([(stop.fx, stop.fy, stop.near, stop.far) for stop in stops])
    values = np.hstack([poses[:, :, 3], lengths, [(stop.cx, stop.cy) for stop in stops]])
    times = travel_times(stops)
    share = np.arange(frames) / max(frames - 1, 1)
    moments = times[-1] * share * share * (3 - 2 * share)
    found = PchipInterpolator(times, values)(moments)
    found[:, 3:7] = np.exp(found[:, 3:7])
    turned = RotationSpline(times, rotations)(moments).as_matrix()
    cameras = []
    for rotation, (x, y, z, fx, fy, near, far, cx, cy) in zip(turned, found.tolist(), strict=True):
        lens = replace(first, fx=fx, fy=fy, cx=cx, cy=cy, near=near, far=far)
        cameras.append(posed(lens, np.column_stack([rotation, (x, y, z)])))
    cameras[-1:] = [stops[-1]]
    cameras[0] = first
    return cameras


def same_size(stops: Sequence[Camera]) -> list[Camera]:
    """The cameras in pictures of the first one's size."""
    first = stops[0]
    return [first, *(resized(stop, first.width, first.height) for stop in stops[1:])]


# ---------------------------------------------------------------------------------------------------- parts of a loop


def median_distance(cameras: Sequence[Camera]) -> float:
    """How far away things are in the median camera, roughly: the middle of its depth bounds."""
    return float(np.median([(camera.near + camera.far) / 2 for camera in cameras]))


def looked_at(poses: np.ndarray, up: np.ndarray, distance: float) -> tuple[np.ndarray, np.ndarray]:
    """Of cameras (N, 3, 4): the point on each optical axis that is nearest to their focus (N, 3), and each camera's
    angle around it (N,) in radians.

    Cameras that look outwards, as in a room, are ordered by where they look; their angle is that of a camera on the
    other side that looks inwards.
    """
    centres, forwards = poses[:, :, 3], poses[:, :, 2]
    focus = focus_of(poses, distance)
    depth = ((focus - centres) * forwards).sum(1)
    inwards = np.median(depth) > 0.05 * distance
    typical = float(np.median(depth)) if inwards else distance
    targets = centres + np.clip(depth, typical / 2, typical * 2)[:, None] * forwards
    outwards = centres - focus if inwards else -forwards
    ahead = looking(unit(median_of(forwards), forwards[0]), up)[:, 0]  # horizontal: angle zero is across the main view
    side = np.cross(up, ahead)
    return targets, np.arctan2(outwards @ side, outwards @ ahead)


def lost(centres: np.ndarray, poses: np.ndarray, targets: np.ndarray) -> float:
    """Share of the places (M, 3) of a loop that are away from all cameras (N, 3, 4): farther from the nearest one than
    AWAY of the distance to what it looks at.
    """
    distance, nearest = cKDTree(poses[:, :, 3]).query(centres)
    return float((distance > AWAY * np.linalg.norm(targets - poses[:, :, 3], axis=1)[nearest]).mean())


def together(poses: np.ndarray, targets: np.ndarray) -> list[int]:
    """The largest group of spots in which cameras (N, 3, 4) stand together, each with another spot of it: a camera of
    each. Of several of a size the widest, which shows most. One camera, where no two spots are together.
    """
    depth = np.linalg.norm(targets - poses[:, :, 3], axis=1)
    cells = np.round(poses[:, :, 3] / (SPOT * np.median(depth)))
    _, spots = np.unique(cells, axis=0, return_index=True)  # a burst, or a tripod, is one
    centres, forwards, depth = poses[spots, :, 3], poses[spots, :, 2], depth[spots]
    apart, j = cKDTree(centres).query(centres, k=range(1, min(LINKS, len(spots)) + 1))
    i = np.broadcast_to(np.arange(len(spots))[:, None], j.shape)
    joined = apart <= TOGETHER * np.minimum(depth[i], depth[j])
    joined &= (forwards[i] * forwards[j]).sum(-1) > math.cos(ALIKE)
    links = coo_matrix((np.ones(joined.sum()), (i[joined], j[joined])), shape=(len(spots), len(spots)))
    _, label = connected_components(links, directed=False)
    groups = [np.flatnonzero(label == k) for k in range(label.max() + 1)]
    largest = max(groups, key=lambda g: (len(g), float(np.ptp(centres[g], axis=0).max())))
    return spots[largest].tolist()


def unrolled(angles: np.ndarray) -> np.ndarray:
    """The order (N,) of angles from the far side of their widest gap, once round."""
    order = np.argsort(angles)
    gaps = np.diff(angles[order], append=angles[order[0]] + 2 * np.pi)
    return np.roll(order, -gaps.argmax() - 1)


def there_and_back(stops: Sequence[Camera], frames: int, lens: Camera) -> list[Camera]:
    """A flight through cameras and back, in pictures of the size of `lens` that show no more than the photos do, but
    for their principal points; slow at both ends.
    """
    cropped = []
    for stop in stops:
        f = max(stop.fx * lens.width / stop.width, stop.fy * lens.height / stop.height)
        cropped.append(posed(replace(lens, fx=f, fy=f, near=stop.near, far=stop.far), stop.pose))
    there = between(cropped, frames + 1)
    return [there[frames - abs(frames - 2 * k)] for k in range(frames)]


def angle_route(angles: np.ndarray) -> tuple[np.ndarray, bool]:
    """The angles (DENSE,) along which a loop goes, and whether they are a full circle: where no gap between neighbours
    is wider than GAP. Else they are those of the largest group of cameras between such gaps, without its TAILS.
    """
    order = np.sort(angles)
    gaps = np.diff(order, append=order[0] + 2 * np.pi)
    breaks = np.flatnonzero(gaps > GAP)
    if not len(breaks):
        return order[0] + np.linspace(0, 2 * np.pi, DENSE, endpoint=False), True
    unrolled = np.roll(order, -breaks[0] - 1)
    unrolled = np.where(unrolled < unrolled[0], unrolled + 2 * np.pi, unrolled)
    groups = np.split(unrolled, np.flatnonzero(np.diff(unrolled) > GAP) + 1)
    low, high = np.percentile(max(groups, key=len), TAILS)
    return np.linspace(low, high, DENSE), False


def laid_out(seen: np.ndarray, angles: np.ndarray, route: np.ndarray, is_closed: bool, distance: float) -> np.ndarray:
    """Rows (DENSE, 7) of a loop at equal steps: centre, target and the focal length's logarithm, from those of the
    cameras, side by side in `seen` (N, 7), at their angles: a local regression over angles, robust but for the focal
    length, rounded. `distance` weighs turning against moving.
    """
    band = min(BAND, max(float(np.ptp(route)) / 6, 1e-6))
    off = np.angle(np.exp(1j * (route[:, None] - angles)))
    weights = np.exp(-((off / band) ** 2) / 2)  # above 0: no gap on the route is wider than some bands
    weights /= weights.sum(1, keepdims=True)
    found = np.hstack([weighted_median(seen[:, :6], weights), weights @ seen[:, 6:]])
    for _ in range(2):  # equal steps; rounded; equal again
        found = even(found, is_closed, distance)
        found = gaussian_filter1d(found, SMOOTHING * DENSE, axis=0, mode="wrap" if is_closed else "nearest")
    return even(found, is_closed, distance)


def even(found: np.ndarray, is_closed: bool, distance: float) -> np.ndarray:
    """Rows (DENSE, 7), as `laid_out` has them, at equal steps along them; a step is as long as the centre moves and the
    view turns, in lengths of `distance`.
    """
    line = np.vstack([found, found[:1]]) if is_closed else found
    forward = unit(line[:, 3:6] - line[:, :3], np.eye(3)[2])
    steps = np.linalg.norm(np.diff(line[:, :3], axis=0), axis=1) / distance + np.linalg.norm(
        np.diff(forward, axis=0), axis=1
    )
    along = np.concatenate([[0], np.cumsum(steps + 1e-9)])
    wanted = np.linspace(0, along[-1], DENSE, endpoint=not is_closed)
    return np.column_stack([np.interp(wanted, along, column) for column in line.T])


def sampled(rows: np.ndarray, share: np.ndarray, is_closed: bool) -> np.ndarray:
    """Rows (F, D) of a loop laid out in rows (DENSE, D), at shares (F,) in [0, 1] of its length; of a closed one the
    first row follows the last.
    """
    line = np.vstack([rows, rows[:1]]) if is_closed else rows
    return np.column_stack([np.interp(share * (len(line) - 1), np.arange(len(line)), column) for column in line.T])


def centred(cameras: Sequence[Camera], size: tuple[int, int] | None) -> Camera:
    """A camera of this size, by default of the median camera's, whose principal point is its middle."""
    if size is None:
        height = even_pixels(float(np.median([min(camera.width, camera.height) for camera in cameras])))
        size = even_pixels(height * ASPECT), height
    width, height = size
    if min(size) < 1:
        raise CrossrayError(f"a picture of {width} x {height} pixels: each side needs one at least")
    return replace(cameras[0], width=width, height=height, cx=width / 2, cy=height / 2)


def even_pixels(length: float) -> int:
    """The nearest even number of pixels, as films want it; 2 at least."""
    return max(2, round(length / 2) * 2)


def travel_times(stops: Sequence[Camera]) -> np.ndarray:
    """When a flight passes each of its stops (N,), from 0 on, so that it is about equally fast throughout: a way as
    long as the average one takes as much as the average turn, and a zoom as much as the turn that moves a picture's
    edge as far. Every leg takes some time, also one that leads nowhere.
    """
    poses = np.array([stop.pose for stop in stops])
    rotations = Rotation.from_matrix(poses[:, :, :3])
    zoom = np.log([stop.fx / stop.width * stop.fy / stop.height for stop in stops]) / 2
    ways = np.linalg.norm(np.diff(poses[:, :, 3], axis=0), axis=1)
    turns = (rotations[:-1].inv() * rotations[1:]).magnitude() + ZOOM * np.abs(np.diff(zoom))
    legs = ways / max(ways.mean(), 1e-9) + turns / max(turns.mean(), 1e-9)
    return np.concatenate([[0], np.cumsum(legs + 1e-2)])


def check_count(frames: int) -> None:
    """CrossrayError for a number of frames that no path has."""
    if not 1 <= frames <= MAX_FRAMES:
        raise CrossrayError(f"a camera path of {frames} frames: it needs 1 to {MAX_FRAMES}")
