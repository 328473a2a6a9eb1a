"""A camera that no photo was taken with: what rendering needs to know of a view.

Poses are OpenCV camera-to-world (x right, y down, z forward) in scene units, pixel centres at +0.5, as everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.errors import CrossrayError
from pipeline.manifest import CameraRecord, Row

MAX_SIDE = 2**14  # pixels that a view is asked for: H.264 has no more


@dataclass(frozen=True)
class Camera:
    """One view: size and intrinsics in pixels, pose and depth bounds in scene units."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    c2w: tuple[Row, Row, Row]
    near: float  # depth z at which rendering begins
    far: float  # and ends

    @property
    def pose(self) -> np.ndarray:
        """c2w as float64 (3, 4)."""
        return np.array(self.c2w, np.float64)


def camera_of(record: CameraRecord) -> Camera:
    """A photo's camera, at the size of the shards."""
    bounds = (record.near, record.far)
    return Camera(record.width, record.height, record.fx, record.fy, record.cx, record.cy, record.c2w, *bounds)


def posed(camera: Camera, pose: np.ndarray) -> Camera:
    """The camera at another pose, (3, 4) or (4, 4) camera-to-world."""
    rows = [(float(x), float(y), float(z), float(t)) for x, y, z, t in pose[:3]]
    return replace(camera, c2w=(rows[0], rows[1], rows[2]))


def resized(camera: Camera, width: int, height: int) -> Camera:
    """The camera with pictures of width x height pixels that show all that it showed across the narrower side: where
    the aspect changes, more is seen at the sides or above and below, and nothing is stretched.

    Raises:
        CrossrayError: a side has no pixel.
    """
    if min(width, height) < 1:
        raise CrossrayError(f"a picture of {width} x {height} pixels: each side needs one at least")
    scale = min(width / camera.width, height / camera.height)
    return replace(
        camera,
        width=width,
        height=height,
        fx=camera.fx * scale,
        fy=camera.fy * scale,
        cx=(camera.cx - camera.width / 2) * scale + width / 2,
        cy=(camera.cy - camera.height / 2) * scale + height / 2,
    )
