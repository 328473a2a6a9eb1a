"""Cameras as other programs read them: a COLMAP text model, and nerfstudio's transforms.json.

Both hold the cameras of the exported pictures, in the units and the world of the scene's COLMAP model, with pixel
centres at +0.5. A model that was trained with pixel centres elsewhere (`pixel_center`, the released code has 0) renders
pictures whose principal point is off by the difference, and this is what is written: so views, depth maps and points
agree.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.manifest import CameraRecord
from pipeline.views.camera import Camera, camera_of, posed

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # x right, y down, z forward -> x right, y up, z backward


def exported_camera(record: CameraRecord, scale: float, pixel_center: float) -> Camera:
    """The camera of a rendered picture in COLMAP units, pixel centres at +0.5.

    Args:
        scale: COLMAP units a scene unit.
        pixel_center: what the model adds to a pixel's index to get to its ray.
    """
    camera = camera_of(record)
    pose = camera.pose
    pose[:, 3] *= scale
    shift = 0.5 - pixel_center
    return replace(
        posed(camera, pose),
        cx=camera.cx + shift,
        cy=camera.cy + shift,
        near=camera.near * scale,
        far=camera.far * scale,
    )


def colmap_text(cameras: Mapping[str, Camera]) -> dict[str, str]:
    """File name -> text of a COLMAP model without points: one PINHOLE camera a picture, numbered from 1.

    Args:
        cameras: picture's name -> camera, in COLMAP units.
    """
    models = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, fx, fy, cx, cy"]
    images = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; then an empty line, as there are no 2-D points"]
    for number, (name, camera) in enumerate(cameras.items(), start=1):
        models.append(
            f"{number} PINHOLE {camera.width} {camera.height} {camera.fx} {camera.fy} {camera.cx} {camera.cy}"
        )
        rotation = camera.pose[:, :3].T
        x, y, z, w = Rotation.from_matrix(rotation).as_quat()
        values = " ".join(str(float(v)) for v in (w, x, y, z, *(-rotation @ camera.pose[:, 3])))
        images += [f"{number} {values} {number} {name}", ""]
    points = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]; there are none"]
    texts = {"cameras.txt": models, "images.txt": images, "points3D.txt": points}
    return {file: "\n".join(lines) + "\n" for file, lines in texts.items()}


def transforms(
    cameras: Mapping[str, Camera], depths: Mapping[str, str] | None = None, points: str | None = None
) -> dict[str, Any]:
    """The content of a transforms.json: camera-to-world, x right, y up, looking along -z; intrinsics a frame.

    Args:
        cameras: the picture's path in the folder -> camera, in COLMAP units.
        depths: the picture's path -> its depth map's.
        points: path of a point cloud.
    """
    frames = []
    for path, camera in cameras.items():
        pose = np.vstack([camera.pose, [0, 0, 0, 1]]) @ OPENGL
        frame = {
            "file_path": path,
            "transform_matrix": pose.tolist(),
            "fl_x": camera.fx,
            "fl_y": camera.fy,
            "cx": camera.cx,
            "cy": camera.cy,
            "w": camera.width,
            "h": camera.height,
        }
        frames.append(frame | ({"depth_file_path": depths[path]} if depths else {}))
    return {"camera_model": "OPENCV"} | ({"ply_file_path": points} if points else {}) | {"frames": frames}
