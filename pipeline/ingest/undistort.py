"""Photos and model of pinhole cameras, without black borders."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.colmap import import_pycolmap
from pipeline.errors import CrossrayError
from pipeline.scene import pinhole

JPEG_QUALITY = 98
SLACK = 0.5  # pixels by which the outermost pixel centres may look past the photo


def undistort(model_folder: str, photos: str, out: str) -> None:
    """Write `out`/images and `out`/sparse: every registered photo of the model, as a pinhole camera sees it. Photos
    that have no distortion are copied.

    Raises:
        CrossrayError: a photo would have pixels that its camera did not see.
    """
    pycolmap = import_pycolmap()
    model = pycolmap.Reconstruction(model_folder)
    make_pinhole(model)
    scratch = Path(out).with_name(f".{Path(out).name}.tmp")
    shutil.rmtree(scratch, ignore_errors=True)
    (scratch / "model").mkdir(parents=True)
    model.write_binary(scratch / "model")
    options = pycolmap.UndistortCameraOptions()
    options.blank_pixels = 0
    pycolmap.undistort_images(
        scratch / "dense",
        scratch / "model",
        photos,
        undistort_options=options,
        jpeg_quality=JPEG_QUALITY,
    )
    done = pycolmap.Reconstruction(str(scratch / "dense" / "sparse"))
    make_pinhole(done)
    check_borders(model, done)
    done.write_binary(scratch / "dense" / "sparse")
    for extra in (scratch / "dense").iterdir():
        if extra.name not in ("images", "sparse"):
            shutil.rmtree(extra) if extra.is_dir() else extra.unlink()
    shutil.rmtree(out, ignore_errors=True)
    (scratch / "dense").rename(out)
    shutil.rmtree(scratch)


def make_pinhole(model: Any) -> None:
    """Cameras whose distortion is zero become PINHOLE."""
    pycolmap = import_pycolmap()
    for camera in model.cameras.values():
        if camera.is_undistorted() and camera.is_perspective_pinhole and camera.model.name != "PINHOLE":
            values = pinhole(camera)
            camera.model = pycolmap.CameraModelId.PINHOLE
            camera.params = values


def check_borders(before: Any, after: Any) -> None:
    """Refuse photos whose border a distorted camera did not see: it would be black."""
    for image in (before.images[i] for i in before.reg_image_ids()):
        past = looks_past(before.cameras[image.camera_id], after.cameras[after.images[image.image_id].camera_id])
        if past > SLACK:
            raise CrossrayError(
                f"photo {image.name}: undistorted, it would show {past:.1f} pixels beyond its border, which would be "
                "black; its lens is too wide, leave it out"
            )


def looks_past(camera: Any, straight: Any) -> float:
    """Pixels by which the outermost pixel centres of `straight` look past the photo of `camera`."""
    w, h = straight.width, straight.height
    u, v = np.arange(w) + 0.5, np.arange(h) + 0.5
    border = np.concatenate(
        [np.stack(np.broadcast_arrays(a, b), -1) for a, b in ((u, 0.5), (u, h - 0.5), (0.5, v), (w - 0.5, v))]
    )
    rays = straight.cam_from_img(border)
    seen = camera.img_from_cam(np.column_stack([rays, np.ones(len(rays))]))
    past = np.maximum(-seen, seen - [camera.width, camera.height])
    return float(np.where(np.isfinite(past), past, np.inf).max())
