"""cameras.png: the points of a scene and its cameras from above."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pipeline.files import atomic_file

MOST_POINTS = 30_000
DEPTH = 0.04  # of a drawn camera, of the picture's width


def draw_cameras(path: Path, model: Any, title: str) -> None:
    """Draw a `pycolmap.Reconstruction`; up is what the photographers' cameras agree on."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    images = [model.images[i] for i in model.reg_image_ids()]
    poses = np.stack([image.cam_from_world().matrix() for image in images])
    rotation = from_above(poses)
    centres = -np.einsum("nji,nj->ni", poses[:, :, :3], poses[:, :, 3]) @ rotation.T
    points = np.array([p.xyz for p in model.points3D.values()]) @ rotation.T
    colours = np.array([p.color for p in model.points3D.values()]) / 255
    low, high = bounds(points, centres)
    inside = np.flatnonzero((points[:, :2] >= low).all(1) & (points[:, :2] <= high).all(1))
    if len(inside) > MOST_POINTS:
        inside = np.random.default_rng(0).choice(inside, MOST_POINTS, replace=False)
    width = float((high - low).max())
    lines = []
    for image, pose, centre in zip(images, poses, centres, strict=True):
        camera = model.cameras[image.camera_id]
        half = camera.width / 2 / camera.focal_length_x
        rays = np.array([[-half, 0, 1], [half, 0, 1]]) @ pose[:, :3] @ rotation.T
        a, b = centre[:2] + DEPTH * width * rays[:, :2]
        lines.append([centre[:2], a, b, centre[:2]])
    figure = Figure(figsize=(8, 8 * max(0.4, min(1.5, (high - low)[1] / (high - low)[0]))), dpi=120)
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.scatter(points[inside, 0], points[inside, 1], s=2, c=colours[inside], linewidths=0)
    axes.add_collection(LineCollection(lines, colors="#c2410c", linewidths=0.9))
    axes.scatter(centres[:, 0], centres[:, 1], s=6, c="#c2410c")
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", title=title)
    axes.set_facecolor("#f4f4f2")
    axes.tick_params(labelsize=7)
    axes.set_xlabel("from above; COLMAP units", fontsize=8)
    figure.tight_layout()
    with atomic_file(path) as file:
        canvas.print_png(file)


def from_above(poses: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) from the world of world-to-camera `poses` (n, 3, 4) to x right, y ahead, z up, for a photographer
    who holds the camera and looks as all do on average.
    """
    up = -poses[:, 1, :3].mean(0)
    up /= np.linalg.norm(up)
    ahead = poses[:, 2, :3].mean(0)
    ahead -= up * (ahead @ up)
    if np.linalg.norm(ahead) < 1e-6:  # they look all round
        ahead = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    ahead /= np.linalg.norm(ahead)
    return np.stack([np.cross(ahead, up), ahead, up])


def bounds(points: np.ndarray, centres: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners (2,) of what is drawn: all cameras, and the points but for a few far ones."""
    some = np.percentile(points[:, :2], [2, 98], axis=0)
    low = np.minimum(some[0], centres[:, :2].min(0))
    high = np.maximum(some[1], centres[:, :2].max(0))
    margin = 0.07 * float((high - low).max())
    return low - margin, high + margin
