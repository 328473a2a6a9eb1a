"""What only the built-in landmark can tell: the clean view in any light, and where the tourists are."""

from __future__ import annotations

import numpy as np
from PIL import Image

from model.scene_model import SceneModel
from pipeline.config import Job
from pipeline.errors import CrossrayError
from pipeline.landmark import Landmark
from pipeline.photos import Photos
from pipeline.render import predicted_mask

MASK_THRESHOLD = 0.5


def check_truth(job: Job) -> Landmark:
    """The landmark that a job's photos are of.

    Raises:
        CrossrayError: the scene is another one or not at hand, has one test photo alone, whose light could be read
            from no other view, or its photos were reduced.
    """
    if not job.scene.path.is_dir():
        raise CrossrayError(
            f"scene.path: {job.scene.path} is not there, and its truth is needed; `crossray landmark {job.scene.path}` "
            "makes the built-in landmark"
        )
    if not (job.scene.path / "truth" / "landmark.json").is_file():
        raise CrossrayError(
            f"scene.path: {job.scene.path} holds no truth; only the built-in landmark (`crossray landmark`) knows its "
            "views without tourists and in another light"
        )
    if job.scene.downscale != 1:
        raise CrossrayError(
            f"scene.downscale: the landmark's truth is known at the size of its photos alone, and these are at "
            f"R{job.scene.downscale}; train with --set scene.downscale=1"
        )
    landmark = Landmark.read(job.scene.path)
    if len(landmark.names("test")) < 2:
        raise CrossrayError(
            f"scene.path: {job.scene.path} has one test photo; to read its light from elsewhere takes two at least"
        )
    return landmark


def truth_of(job: Job, photos: Photos) -> Landmark:
    """The truth behind a job's photos.

    Raises:
        CrossrayError: there is none (`check_truth`), or it is of other photos.
    """
    landmark = check_truth(job)
    for index in photos.indices("test"):
        name, (height, width) = photos.records[index].name, photos.image(index).shape[:2]
        camera = landmark.record(name).camera
        if (camera.height, camera.width) != (height, width):
            raise CrossrayError(
                f"{job.scene.path}: the truth of {name} is {camera.width} x {camera.height} pixels, its photo "
                f"{width} x {height}"
            )
    return landmark


def elsewhere(photos: Photos, index: int) -> int:
    """The test photo after this one, the first after the last: from its view the light of this one is read."""
    test = photos.indices("test")
    return test[(test.index(index) + 1) % len(test)]


def reduced(picture: np.ndarray, factor: int) -> np.ndarray:
    """A uint8 picture as a reference: by LANCZOS to 1 / factor of its size, as the shards have it."""
    height, width = (max(1, n // factor) for n in picture.shape[:2])
    return np.asarray(Image.fromarray(picture).resize((width, height), Image.Resampling.LANCZOS))


def mask_iou(model: SceneModel, photos: Photos, landmark: Landmark, indices: tuple[int, ...]) -> float | None:
    """Intersection over union of predicted and true masks, pooled over these photos; None without masks."""
    both = either = 0
    for index in indices:
        mask = predicted_mask(model, photos, index)
        if mask is None:
            return None
        predicted, true = mask > MASK_THRESHOLD, landmark.mask(photos.records[index].name)
        both += int((predicted & true).sum())
        either += int((predicted | true).sum())
    return both / max(either, 1)
