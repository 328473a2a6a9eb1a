"""A posed scene of random textures, written by hand: small enough for a test, readable as a COLMAP text
model.

The cameras stand on a circle of radius `RADIUS` around the origin in the plane y = 0 and look at it, `STEP`
radians apart. Camera i is the rotation R_y(i * STEP) of one at (0, 0, -RADIUS): world-to-camera is (R_y(-i *
STEP), (0, 0, RADIUS)).
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, sin
from pathlib import Path

import numpy as np
from PIL import Image

RADIUS = 4.0
STEP = 0.1
NUM_POINTS = 60


def photo_names(photos: int, suffix: str = ".jpg") -> list[str]:
    return [f"photo_{i:03d}{suffix}" for i in range(photos)]


def tiny_points(seed: int = 0) -> np.ndarray:
    """(NUM_POINTS, 3) float64, in the cube of half-side 1 around the origin."""
    return np.random.default_rng(seed).uniform(-1, 1, (NUM_POINTS, 3))


def write_tiny_scene(
    root: Path,
    photos: int = 6,
    size: tuple[int, int] = (48, 36),
    splits: Sequence[str] | None = None,
    *,
    tsv: bool = True,
    suffix: str = ".jpg",
    shared_camera: bool = False,
    seed: int = 0,
) -> Path:
    """Write `photos` photos of `size` (width, height) under `root/dense`, their model, and `root/tiny.tsv`;
    return `root`.

    `splits`: one a photo; by default every fourth is a test photo. COLMAP's image ids count backwards from
    the number of photos, and camera ids are 100 + the photo's number (100 for all with `shared_camera`), so
    that no two ids agree.
    """
    width, height = size
    names = photo_names(photos, suffix)
    splits = splits or ["test" if i % 4 == 3 else "train" for i in range(photos)]
    images, sparse = root / "dense" / "images", root / "dense" / "sparse"
    images.mkdir(parents=True)
    sparse.mkdir()
    rng = np.random.default_rng(seed)
    for name in names:
        texture = rng.integers(0, 256, (max(2, height // 6), max(2, width // 6), 3), dtype=np.uint8)
        Image.fromarray(texture).resize(size, Image.Resampling.BICUBIC).save(images / name)
    focal, points = float(width), tiny_points(seed)
    ids = [photos - i for i in range(photos)]
    cameras = [100] if shared_camera else [100 + i for i in range(photos)]
    lines = [f"{c} PINHOLE {width} {height} {focal} {focal} {width / 2} {height / 2}" for c in cameras]
    (sparse / "cameras.txt").write_text("\n".join(lines) + "\n")
    lines = []
    for i, name in enumerate(names):
        a = -i * STEP
        lines.append(f"{ids[i]} {cos(a / 2)} 0 {sin(a / 2)} 0 0 0 {RADIUS} {cameras[0 if shared_camera else i]} {name}")
        rotation = np.array([[cos(a), 0, sin(a)], [0, 1, 0], [-sin(a), 0, cos(a)]])
        x, y, z = (points @ rotation.T + [0, 0, RADIUS]).T
        pixels = zip(focal * x / z + width / 2, focal * y / z + height / 2, strict=True)
        lines.append(" ".join(f"{u:.4f} {v:.4f} {k + 1}" for k, (u, v) in enumerate(pixels)))
    (sparse / "images.txt").write_text("\n".join(lines) + "\n")
    lines = []
    for k, (x, y, z) in enumerate(points):
        track = " ".join(f"{image_id} {k}" for image_id in ids)
        lines.append(f"{k + 1} {x} {y} {z} 128 128 128 0.5 {track}")
    (sparse / "points3D.txt").write_text("\n".join(lines) + "\n")
    if tsv:
        rows = ["filename\tid\tsplit\tdataset"]
        rows += [
            f"{name}\t{1000 + i}.0\t{split}\ttiny" for i, (name, split) in enumerate(zip(names, splits, strict=True))
        ]
        (root / "tiny.tsv").write_text("\n".join(rows) + "\n")
    return root
