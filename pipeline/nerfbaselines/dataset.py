"""A data set of nerfbaselines as training photos: what shards are elsewhere. Nothing is written; at the size that the
data set has, a photo is a view of its array.

Lengths of a data set are COLMAP units, and become scene units as those of a scene folder do (pipeline/scene.py).
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.config import Job
from pipeline.cutting import camera_record, library_versions, plan_record, scene_record
from pipeline.errors import CrossrayError
from pipeline.manifest import Manifest, ShardInfo, digest, shard_file
from pipeline.photos import Photos
from pipeline.pictures import LANCZOS, resize
from pipeline.scene import Scene, ScenePhoto, camera_to_world, measure, photo_key
from pipeline.truth import reduced

if TYPE_CHECKING:
    from nerfbaselines import Dataset


class DatasetPhotos(Photos):
    """The photos of a data set, all of them for training, in its order.

    Args:
        dataset: with photos, cameras and points; its photos are not changed.
        job: how much photos and references are reduced.

    Raises:
        CrossrayError: no points, points that give no depth bounds, or photos that are not 8-bit RGB.
    """

    def __init__(self, dataset: Dataset, job: Job) -> None:
        scene, downscale = read_scene(dataset), job.scene.downscale
        originals = [picture_of(dataset, i) for i in range(len(scene.photos))]
        self.records = tuple(
            camera_record(photo, downscale, original.tobytes())
            for photo, original in zip(scene.photos, originals, strict=True)
        )
        sizes = [(record.width, record.height) for record in self.records]
        self._images = [resize(original, size, LANCZOS) for original, size in zip(originals, sizes, strict=True)]
        self._references = [reduced(original, job.scene.reference_downscale) for original in originals]
        only = ShardInfo(
            file=shard_file(0),
            sha256=digest([record.source_sha256 for record in self.records]),
            bytes=sum(image.nbytes for image in self._images),
            keys=tuple(record.key for record in self.records),
        )
        self.manifest = Manifest(
            scene=scene_record(scene),
            downscale=downscale,
            reference_downscale=job.scene.reference_downscale,
            shards=(only,),
            patch_plan=plan_record(job.patch, scene, downscale),
            libraries=library_versions(),
        )

    def image(self, i: int) -> np.ndarray:
        """Photo `i`: uint8 (h, w, 3)."""
        return self._images[i]

    def reference(self, i: int) -> np.ndarray:
        """The appearance reference of photo `i`: uint8 (h', w', 3)."""
        return self._references[i]

    def mask(self, i: int) -> None:
        """No photo has one."""
        return


def read_scene(dataset: Dataset) -> Scene:
    """The cameras of a data set in scene units, with depth bounds from its points.

    Raises:
        CrossrayError: it has no points, or they give no depth bounds.
    """
    points, cameras = dataset["points3D_xyz"], dataset["cameras"]
    if points is None or not len(points):
        raise CrossrayError("the data set has no 3-D points (points3D_xyz), and depth bounds come from them")
    root = dataset["image_paths_root"]
    paths = [Path(path) for path in dataset["image_paths"]]
    names = [str(path.relative_to(root)) if root and path.is_relative_to(root) else path.name for path in paths]
    poses = [world_to_camera(pose) for pose in cameras.poses]
    bounds, scale, box = measure(np.asarray(points, np.float64), poses, names)
    photos = tuple(
        ScenePhoto(
            name=names[i],
            key=photo_key(i, names[i]),
            image_id=i,
            split="train",
            path=paths[i],
            width=int(cameras.image_sizes[i][0]),
            height=int(cameras.image_sizes[i][1]),
            intrinsics=numbers(cameras.intrinsics[i]),
            c2w=camera_to_world(poses[i], scale),
            near=bounds[i][0] / scale,
            far=bounds[i][1] / scale,
        )
        for i in range(len(names))
    )
    name = dataset["metadata"].get("scene") or dataset["metadata"].get("id") or "dataset"
    return Scene(str(name), Path(root or "."), photos, scale, box, len(points))


def picture_of(dataset: Dataset, index: int) -> np.ndarray:
    """A photo of a data set: uint8 (h, w, 3).

    Raises:
        CrossrayError: it is something else.
    """
    width, height = (int(n) for n in dataset["cameras"].image_sizes[index])
    image = dataset["images"][index][:height, :width]
    if image.dtype != np.uint8 or image.shape != (height, width, 3):
        raise CrossrayError(
            f"{dataset['image_paths'][index]}: {image.dtype} {image.shape}, and photos are 8-bit RGB of "
            f"{width} x {height} pixels here; linear colours and transparency are not read"
        )
    return image


def world_to_camera(pose: Any) -> np.ndarray:
    """The inverse of a rigid camera-to-world (3, 4), in float64."""
    pose = np.asarray(pose, np.float64)
    rotation = pose[:, :3].T
    return np.column_stack([rotation, -rotation @ pose[:, 3]])


def numbers(intrinsics: Any) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy in pixels."""
    fx, fy, cx, cy = (float(value) for value in intrinsics)
    return fx, fy, cx, cy
