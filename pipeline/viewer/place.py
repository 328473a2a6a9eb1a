"""Where the photos of a scene were taken: what a viewer starts from, which way is up, how far rendering reaches."""

from __future__ import annotations

from collections.abc import Sequence
from math import atan, tan

import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.manifest import CameraRecord
from pipeline.views.camera import Camera, camera_of
from pipeline.views.foreign import FAR_AWAY
from pipeline.views.geometry import up_of
from pipeline.views.smooth import bounds_at

SMALLEST_ANGLE, LARGEST_ANGLE = 0.01, 3.1  # radians of a browser's field of view that are drawn


class Place:
    """The training cameras of a scene, at least one; lengths in scene units."""

    def __init__(self, records: Sequence[CameraRecord], box: np.ndarray) -> None:
        """
        Args:
            box: (2, 3), the corners of what was seen.
        """
        self.records = tuple(records)
        self.cameras = [camera_of(record) for record in records]
        poses = np.array([record.c2w for record in records])
        self.positions, self.forward = poses[:, :, 3], poses[:, :, 2]
        self.centre = np.asarray(box, np.float64).mean(axis=0)
        self.up = up_of(poses)

    @property
    def start(self) -> CameraRecord:
        """The camera that is most like all: near the middle of them, looking where they look."""
        distance = np.linalg.norm(self.positions - np.median(self.positions, axis=0), axis=1)
        turned = 1 - self.forward @ self.forward.mean(axis=0)
        return self.records[int(np.argmin(distance / max(distance.mean(), 1e-9) + turned))]

    def look_at(self, record: CameraRecord) -> np.ndarray:
        """(3,) A point in the middle of a camera's view, about as far away as the scene's centre is."""
        pose = camera_of(record).pose
        distance = float((self.centre - pose[:, 3]) @ pose[:, 2])
        return pose[:, 3] + max(distance, 0.1 * record.far) * pose[:, 2]

    def camera(
        self, wxyz: np.ndarray, position: np.ndarray, angle: float, window: tuple[int, int], side: int
    ) -> Camera | None:
        """The camera of a browser's window; None where it shows nothing (no pixel, or numbers that are none).

        Args:
            wxyz: quaternion of the camera-to-world rotation.
            angle: vertical field of view, radians.
            window: its width and height in pixels.
            side: pixels of the picture's long side, at most.
        """
        width, height = window
        numbers = np.concatenate([wxyz, position, [angle, np.linalg.norm(wxyz)]])
        if min(window) < 1 or not (np.abs(numbers) <= FAR_AWAY).all() or numbers[-1] < 1e-9:
            return None
        scale = min(1.0, side / max(window))
        width, height = max(1, round(width * scale)), max(1, round(height * scale))
        focal = height / 2 / tan(min(max(angle, SMALLEST_ANGLE), LARGEST_ANGLE) / 2)
        w, x, y, z = wxyz
        pose = np.column_stack([Rotation.from_quat([x, y, z, w]).as_matrix(), position])
        rows = [(float(a), float(b), float(c), float(d)) for a, b, c, d in pose]
        ((near, far),) = bounds_at(self.cameras, position[None]).tolist()
        return Camera(width, height, focal, focal, width / 2, height / 2, (rows[0], rows[1], rows[2]), near, far)


def quaternion(record: CameraRecord) -> np.ndarray:
    """(4,) w, x, y, z of a camera's camera-to-world rotation."""
    x, y, z, w = Rotation.from_matrix(camera_of(record).pose[:, :3]).as_quat()
    return np.array([w, x, y, z])


def angle_of(record: CameraRecord, aspect: float) -> float:
    """The vertical field of view, radians, in which a window of `aspect` (width over height) shows a whole photo."""
    return 2 * atan(max(record.height / 2 / record.fy, record.width / 2 / record.fx / aspect))


def evenly(items: Sequence[int], most: int) -> tuple[int, ...]:
    """At most `most` of the items, evenly chosen, the first among them."""
    return tuple(items[:: max(1, -(-len(items) // most))])
