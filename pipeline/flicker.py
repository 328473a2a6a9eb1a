"""Flicker: how the rendered colour of a surface point drifts along a camera path, in one appearance.

The built-in landmark knows where each pixel's surface is, so points of it are followed from frame to frame, and their
colours are read off the pictures. A matt surface in one light has one colour: what changes is haze with distance and
how a picture is sampled, which the true rendering shows as well (the floor), and what the model adds. With `view`
statistics a colour depends on what else is in the picture; here one sees how much.

Notation: T frames, n points, P appearances. Colours are in 8-bit levels, not rounded.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, get_args

import numpy as np
import torch
from torch import Tensor

from model.appearance.crossray import recolour
from model.methods import StatisticsPolicy
from model.scene_model import ColourMap, SceneModel
from pipeline.errors import CrossrayError
from pipeline.landmark import Landmark
from pipeline.landmark.collection import look
from pipeline.landmark.photo import depth_map, photograph
from pipeline.landmark.tracer import Pinhole
from pipeline.manifest import CameraRecord
from pipeline.photos import Photos
from pipeline.render import View, read_appearance, render_view, view_colours

SPREAD = 40  # degrees to each side that the path goes
SAME_SURFACE = 0.02  # share of the depth: farther apart, two points are not the same
EVERY = 4  # pixels between the points that are followed
SOURCES = 5  # frames whose surface points are followed
NEAR = 0.9  # rays start at this share of the way to the nearest surface of the path
FRAMES_AT_LEAST = 4  # in which a point must be seen for its standard deviation to count


class Walk(NamedTuple):
    """A camera path with the surface points that are followed along it."""

    cameras: list[Pinhole]
    pixels: np.ndarray  # (T, n, 2) float: u, v; pixel centres are at +0.5
    seen: np.ndarray  # (T, n) bool: in the picture, with nothing in front and no edge close by
    nearest: float  # depth of the nearest surface in any frame, world units


class Drift(NamedTuple):
    """How colours change, 8-bit levels."""

    frame: float  # norm of the mean colour change of all points seen in two frames that follow, mean over frames
    point: float  # standard deviation of a point's colour over the frames where it is seen, mean over points
    statistics: float  # as `frame`, of the statistics alone: one frame's features coloured with the next one's


def camera_path(frames: int, side: int) -> list[Pinhole]:
    """A visitor walks an arc in front of the landmark and steps back on the way: `frames` square pictures of `side`
    pixels, from a height at which most photos were taken."""
    cameras = []
    for s in np.linspace(0, 1, frames):
        angle = math.radians(SPREAD * (2 * s - 1))
        distance, eye = 4.9 + 0.7 * s, 0.36
        centre = (distance * math.sin(angle), -0.6 - distance * math.cos(angle), eye)
        rotation = look(centre, (0.0, -0.5, 1.2), 0.0)
        focal = side / 2 / math.tan(math.radians(52) / 2)
        cameras.append(Pinhole(side, side, focal, focal, side / 2, side / 2, rotation, centre))
    return cameras


def walk(frames: int, side: int) -> Walk:
    """The path, and the surface points behind a grid of pixels of some of its frames, followed through all."""
    cameras = camera_path(frames, side)
    depths = [depth_map(camera) for camera in cameras]
    chosen = np.unique(np.linspace(0, frames - 1, SOURCES).round().astype(int))
    points = np.concatenate([surface_points(cameras[i], depths[i]) for i in chosen])
    found = [visible(camera, depth, points) for camera, depth in zip(cameras, depths, strict=True)]
    pixels, seen = (np.stack(parts) for parts in zip(*found, strict=True))
    return Walk(cameras, pixels, seen, min(float(depth.min()) for depth in depths))


def surface_points(camera: Pinhole, depth: np.ndarray) -> np.ndarray:
    """(n, 3): what is behind every EVERY-th pixel of every EVERY-th row, world units; no sky."""
    rows, cols = np.mgrid[EVERY // 2 : camera.height : EVERY, EVERY // 2 : camera.width : EVERY].reshape(2, -1)
    z = depth[rows, cols]
    directions = np.stack(camera.directions(cols + 0.5, rows + 0.5), axis=-1)
    hit = np.isfinite(z)
    return np.asarray(camera.centre) + z[hit, None].astype(np.float64) * directions[hit]


def visible(camera: Pinhole, depth: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixel coordinates (n, 2) of points (n, 3) and whether they are seen (n,): all four pixels around have their
    depth, so that a colour interpolated between them is theirs."""
    u, v, z = camera.project(points)
    col, row = np.floor(u - 0.5), np.floor(v - 0.5)
    inside = (z > 0) & (col >= 0) & (row >= 0) & (col < camera.width - 1) & (row < camera.height - 1)
    col, row = (np.where(inside, x, 0).astype(int) for x in (col, row))
    around = np.stack([depth[row + i, col + j] for i in (0, 1) for j in (0, 1)])
    return np.stack([u, v], axis=-1), inside & (np.abs(around - z) < SAME_SURFACE * z).all(axis=0)


def colours_at(picture: np.ndarray, pixels: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """(n, 3) of a picture (h, w, 3) at pixel coordinates (n, 2), bilinear; NaN where a point is not seen."""
    u, v = (pixels[seen] - 0.5).T
    col, row = np.floor(u).astype(int), np.floor(v).astype(int)
    right, down = (u - col)[:, None], (v - row)[:, None]
    upper = picture[row, col] * (1 - right) + picture[row, col + 1] * right
    lower = picture[row + 1, col] * (1 - right) + picture[row + 1, col + 1] * right
    colours = np.full((len(pixels), 3), np.nan)
    colours[seen] = upper * (1 - down) + lower * down
    return colours


def drift(colours: np.ndarray) -> tuple[float, float]:
    """`frame` and `point` of a Drift, of colours (T, n, 3), NaN where a point is not seen.

    Raises:
        ValueError: two frames that follow share no point, or no point is seen in FRAMES_AT_LEAST frames.
    """
    changes = np.diff(colours, axis=0)
    often = np.isfinite(colours[..., 0]).sum(axis=0) >= FRAMES_AT_LEAST
    if not np.isfinite(changes[..., 0]).any(axis=1).all() or not often.any():
        raise ValueError("the frames share too few points to follow")
    deviations = np.sqrt(np.nanvar(colours[:, often], axis=0).mean(axis=-1))
    return float(np.mean([mean_change(change) for change in changes])), float(deviations.mean())


def mean_change(changes: np.ndarray) -> float:
    """The norm of the mean of (n, 3), without the points that are NaN."""
    return float(np.linalg.norm(np.nanmean(changes, axis=0)))


def flicker(model: SceneModel, photos: Photos, path: Walk, names: Sequence[str]) -> dict[StatisticsPolicy, Drift]:
    """The drift by each statistics policy: means over the appearances of some photos, given by name.

    Each frame is rendered once, and coloured by every policy in every appearance. Memory: two frames.

    Raises:
        CrossrayError: the model takes no statistics, or `running` has no averages.
    """
    if model.transform is None:
        raise CrossrayError(f"flicker: model.appearance: {model.spec.appearance} takes no statistics of a view")
    known = {record.name: index for index, record in enumerate(photos.records)}
    found = [read_appearance(model, photos.reference(known[name])) for name in names]
    appearances = torch.cat([F for F in found if F is not None])
    return {
        policy: Drift(*np.mean(parts, axis=0).tolist())
        for policy, parts in drifts_of(model, photos, path, appearances).items()
    }


def drifts_of(
    model: SceneModel, photos: Photos, path: Walk, appearances: Tensor
) -> dict[StatisticsPolicy, list[tuple[float, float, float]]]:
    """By policy, a Drift for each of P appearances F^a."""
    colours: dict[StatisticsPolicy, list[np.ndarray]] = {policy: [] for policy in get_args(StatisticsPolicy)}
    moved: dict[StatisticsPolicy, list[list[float]]] = {policy: [] for policy in colours}
    before: View | None = None
    for t, camera in enumerate(path.cameras):
        view = render_view(model, in_scene_units(camera, photos, path.nearest))
        for policy, seen in colours.items():
            maps = view_colours(model, view, appearances, policy)
            seen.append(levels_at(view, maps, path, t))
            if before is not None:
                by_next = levels_at(before, maps, path, t - 1)
                moved[policy].append([mean_change(change) for change in by_next - seen[-2]])
        before = view
    return {
        policy: [
            (*drift(of_one), float(alone))
            for of_one, alone in zip(np.stack(seen, axis=1), np.mean(moved[policy], axis=0), strict=True)
        ]
        for policy, seen in colours.items()
    }


def levels_at(view: View, colours: ColourMap, path: Walk, t: int) -> np.ndarray:
    """(P, n, 3): the points of frame t in a view of it in P appearances, 8-bit levels."""
    pictures = 255 * recolour(view.features[None], *colours)
    return np.stack([colours_at(p.view(*view.size, 3).cpu().numpy(), path.pixels[t], path.seen[t]) for p in pictures])


def true_drift(landmark: Landmark, path: Walk, names: Sequence[str]) -> Drift:
    """The drift of the truth in the light and response of the same photos: what no rendering can avoid."""
    found = []
    for name in names:
        pictures = [true_picture(landmark, camera, name) for camera in path.cameras]
        seen = zip(pictures, path.pixels, path.seen, strict=True)
        found.append(drift(np.stack([colours_at(*frame) for frame in seen])))
    frame, point = np.mean(found, axis=0).tolist()
    return Drift(frame, point, 0.0)


def true_picture(landmark: Landmark, camera: Pinhole, name: str) -> np.ndarray:
    """float (h, w, 3) in 8-bit levels: nobody there, in the light and response of a photo. Without its vignette, which
    would change a point's colour with its place in the picture.
    """
    record = landmark.record(name)
    return photograph(camera, record.light, replace(record.response, vignette=0.0))[0].astype(np.float64)


def in_scene_units(camera: Pinhole, photos: Photos, nearest: float) -> CameraRecord:
    """A camera of the landmark's world as a photo's record has it.

    Near and far are the same along the path, since bounds that moved would move the samples. Fog that a field left
    right before the cameras is cut off, as it would drown what is measured: nothing is nearer than `nearest` (world
    units).
    """
    far = np.median([photos.records[i].far for i in photos.indices("train")])
    scale = photos.manifest.scene.scale
    rotation, centre = np.array(camera.rotation).T, np.array(camera.centre) / scale
    return CameraRecord(
        key="path",
        name="path",
        image_id=0,
        split="test",
        width=camera.width,
        height=camera.height,
        fx=camera.fx,
        fy=camera.fy,
        cx=camera.cx,
        cy=camera.cy,
        c2w=np.column_stack([rotation, centre]).tolist(),
        near=NEAR * nearest / scale,
        far=float(far),
        source_sha256="0" * 64,
    )
