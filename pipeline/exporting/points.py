"""A point cloud of a trained scene in one appearance, as a PLY file.

A point is where a ray of a training view meets its surface: origin + direction * distance. Rays whose light comes from
more than one surface (edges, mist) give none. What one view alone believes in is often wrong (something floating in
front of its camera), so each point is looked at from other training views, the nearest first: a ray from there through
the point must meet its surface where the point is, within AGREE of the distance. The first view to agree keeps the
point, the first that sees through it drops it; a view in which something else stands before it says nothing. A point
that none of NEIGHBOURS views agrees to is dropped.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from itertools import count
from pathlib import Path

import numpy as np
import torch

from model.fields.base import Rays
from pipeline.errors import CrossrayError
from pipeline.exporting.shown import END, Shown
from pipeline.files import atomic_file
from pipeline.manifest import CameraRecord
from pipeline.progress import Progress
from pipeline.render import view_rays

log = logging.getLogger("crossray")

SPREAD = 0.05  # share of the distance from which the middle half of a ray's light comes at most: one surface
AGREE = 0.03  # share of the distance by which two views may differ about a point
NEIGHBOURS = 4  # views that are asked about a point, at most
BASELINE = 0.05  # share of a view's median distance by which neighbours stand apart at least: closer, they see the same
SAME_SIDE = 0.5  # cosine between the viewing directions of neighbours, at least

VERTEX = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")])


def write_points(
    path: Path, shown: Shown, cameras: Sequence[CameraRecord], scale: float, budget: int, work: Path
) -> None:
    """Write the points of views to `path`, in COLMAP units.

    Memory: one view's rays. Each view's points are a file in the folder `work`, so that an interrupted call goes on
    where it was.

    Args:
        cameras: of the training views.
        scale: COLMAP units a scene unit.
        budget: rays in all, at most, evenly chosen pixels of all views.
    """
    stride, rays = stride_for([(c.height, c.width) for c in cameras], budget)
    work.mkdir(parents=True, exist_ok=True)
    parts = [work / f"{camera.key}.npy" for camera in cameras]
    progress = Progress("points")
    try:
        for index, part in enumerate(parts):
            if not part.exists():
                with atomic_file(part) as file:
                    np.save(file, view_points(shown, cameras, index, stride, scale))
            progress.update((index + 1) / len(parts), f"{index + 1} of {len(parts)} views")
    finally:
        progress.close()
    number = sum(len(np.load(part, mmap_mode="r", allow_pickle=False)) for part in parts)
    with atomic_file(path) as file:
        file.write(header(number).encode())
        for part in parts:
            file.write(np.load(part, allow_pickle=False).tobytes())
    log.info("points: %d of %d rays meet one surface that another view agrees to", number, rays)


def header(number: int) -> str:
    """A PLY header for `number` VERTEX records."""
    kinds = {"<f4": "float", "|u1": "uchar"}
    properties = "".join(f"property {kinds[VERTEX[n].str]} {n}\n" for n in VERTEX.names or ())
    return f"ply\nformat binary_little_endian 1.0\nelement vertex {number}\n{properties}end_header\n"


def check_budget(cameras: Sequence[CameraRecord], budget: int) -> None:
    """CrossrayError where so many rays give no point at all."""
    if stride_for([(c.height, c.width) for c in cameras], budget)[1] == 0:
        raise CrossrayError(f"--points {budget}: not one ray of each of {len(cameras)} training views; give more")


def stride_for(sizes: Sequence[tuple[int, int]], budget: int) -> tuple[int, int]:
    """The smallest stride that chooses at most `budget` pixels in views of these heights and widths, as `view_rays`
    chooses them, and how many these are.
    """
    for stride in count(1):
        rays = sum(len(range(stride // 2, h, stride)) * len(range(stride // 2, w, stride)) for h, w in sizes)
        if rays <= budget:
            break
    return stride, rays


def view_points(shown: Shown, cameras: Sequence[CameraRecord], index: int, stride: int, scale: float) -> np.ndarray:
    """The points of one view that other views agree to, VERTEX records in COLMAP units."""
    rays = view_rays(cameras[index], shown.pixel_center, shown.device, stride)
    seen = shown.look(rays)
    there = (seen.distance > 0) & (seen.spread <= SPREAD * seen.distance)
    if not there.any():
        return np.empty(0, VERTEX)
    origins, directions = (r.cpu().numpy().astype(np.float64)[there] for r in (rays.origins, rays.directions))
    points = origins + directions * seen.distance[there, None]
    kept = agreed(shown, cameras, neighbours(cameras, index, float(np.median(seen.distance[there]))), points)
    vertices = np.empty(int(kept.sum()), VERTEX)
    vertices["x"], vertices["y"], vertices["z"] = (points[kept] * scale).T
    vertices["red"], vertices["green"], vertices["blue"] = seen.colours[there][kept].T
    return vertices


def neighbours(cameras: Sequence[CameraRecord], index: int, distance: float) -> list[int]:
    """At most NEIGHBOURS views that look the same way as view `index` from elsewhere, nearest first.

    Args:
        distance: to what view `index` sees, scene units.
    """
    poses = np.array([camera.c2w for camera in cameras])
    apart = np.linalg.norm(poses[:, :, 3] - poses[index, :, 3], axis=1)
    same_side = poses[:, :, 2] @ poses[index, :, 2] >= SAME_SIDE
    order = np.argsort(apart, kind="stable")
    return [int(i) for i in order if same_side[i] and apart[i] >= BASELINE * distance][:NEIGHBOURS]


def agreed(shown: Shown, cameras: Sequence[CameraRecord], views: Sequence[int], points: np.ndarray) -> np.ndarray:
    """bool (M,): which points (M, 3), scene units, `views` agree to."""
    kept, open_ = np.zeros(len(points), bool), np.ones(len(points), bool)
    for camera in (cameras[i] for i in views):
        asked = np.flatnonzero(open_)
        asked = asked[in_picture(camera, points[asked])]
        if not len(asked):
            continue
        rays, distance = rays_to(camera, points[asked], shown.device)
        found = shown.look(rays).distance
        same = np.abs(found - distance) <= AGREE * distance
        through = (found == 0) | (found > (1 + AGREE) * distance)
        kept[asked[same]] = True
        open_[asked[same | through]] = False
    return kept


def in_picture(camera: CameraRecord, points: np.ndarray) -> np.ndarray:
    """bool (M,): which points (M, 3) fall into a picture, before the end of its rays."""
    pose = np.array(camera.c2w)
    x, y, z = ((points - pose[:, 3]) @ pose[:, :3]).T
    front = z > 1e-9
    z = np.where(front, z, 1)
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    return front & inside & (np.linalg.norm(points - pose[:, 3], axis=1) * (1 + AGREE) < END * camera.far)


def rays_to(camera: CameraRecord, points: np.ndarray, device: torch.device) -> tuple[Rays, np.ndarray]:
    """Rays from a camera to points (M, 3), and how far these are (M,)."""
    centre = np.array(camera.c2w)[:, 3]
    offset = points - centre
    distance = np.linalg.norm(offset, axis=1)
    directions = torch.from_numpy((offset / distance[:, None]).astype(np.float32)).to(device)
    origins = torch.from_numpy(centre.astype(np.float32)).to(device).expand_as(directions)
    ends = (directions.new_full((len(points),), bound) for bound in (camera.near, camera.far))
    return Rays(origins, directions, *ends), distance
