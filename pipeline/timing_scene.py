"""A scene to take times on: noise for photos, cameras in a row, models that have learned nothing.

A time does not depend on what is seen. Sample counts are fixed, rays are not ended early, and the fast field reads as
many table entries wherever its samples are. Tried on one CPU: a trained fast field renders its view in the time of an
untrained one; and subnormal numbers, of which trained fields and Adam's averages hold some, do not slow the faithful
field's rendering, and Adam by half a millisecond where all are subnormal.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from model.scene_model import SceneModel
from pipeline.config import Job
from pipeline.manifest import CameraRecord, Manifest, PlanRecord, SceneRecord
from pipeline.patches import PatchPlan
from pipeline.photos import CachedPhoto, CacheIndex, Photos, Picture
from pipeline.timing_job import TimingJob

BOX = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
NEAR, FAR = 1.0, 5.0  # scene units; the cameras are 3 away from the middle
DISTINCT = 64  # photos with pixels of their own (36 MB at R/2): others share theirs, so that 5,000 fit into any memory


def synthetic_photos(timing: TimingJob, count: int, downscale: int = 2) -> Photos:
    """`count` training photos of noise, with references and masks, of the timing's sizes."""
    height, width = timing.size(downscale)
    reference_height, reference_width = (max(1, n) for n in timing.size(timing.reference_downscale))
    image, reference = height * width * 3, reference_height * reference_width * 3
    size = image + reference
    pixels = np.random.default_rng(0).integers(256, size=min(count, DISTINCT) * size, dtype=np.uint8)

    def photo(i: int) -> CachedPhoto:
        start = i % DISTINCT * size
        return CachedPhoto(
            camera=camera(i, height, width),
            image=Picture(start=start, shape=(height, width, 3)),
            reference=Picture(start=start + image, shape=(reference_height, reference_width, 3)),
            mask=Picture(start=start, shape=(height, width)),
        )

    scene = SceneRecord(name="synthetic", hash="0" * 64, scale=1.0, box=BOX, num_points=0)
    manifest = Manifest.model_construct(  # not checked, for nothing was cut: training asks it for the box alone
        scene=scene,
        downscale=downscale,
        reference_downscale=timing.reference_downscale,
        shards=(),
        patch_plan=PlanRecord(plan=PatchPlan(), train_pixels=count * height * width, steps_per_epoch={}),
        libraries={},
    )
    index = CacheIndex(content_hash="0" * 64, bytes=len(pixels), photos=tuple(photo(i) for i in range(count)))
    return Photos(manifest, index, pixels)


def camera(number: int, height: int, width: int) -> CameraRecord:
    """The camera of a photo: 3 units in front of the box, looking at it, a little beside the one before."""
    beside = 0.2 * np.sin(number)
    return CameraRecord(
        key=f"photo{number}",
        name=f"photo{number}.jpg",
        image_id=number,
        split="train",
        width=width,
        height=height,
        fx=width,
        fy=width,
        cx=width / 2,
        cy=height / 2,
        c2w=((1, 0, 0, beside), (0, 1, 0, 0), (0, 0, 1, -3)),
        near=NEAR,
        far=FAR,
        source_sha256="0" * 64,
    )


def untrained(job: Job, device: torch.device, bfloat16: bool) -> SceneModel:
    """The job's model as it is before its first step, ready to render."""
    torch.manual_seed(0)
    model = SceneModel(job.model, torch.tensor(BOX)).to(device).requires_grad_(False).eval()
    model.use_bfloat16 = bfloat16
    if model.transform is not None:
        model.running_count.fill_(1)  # its averages are of nothing, and cost what others do
    return model


def reference_photo(timing: TimingJob, device: torch.device) -> Tensor:
    """What an appearance is read from: noise (3, h, w) in [0, 1]."""
    height, width = timing.size(timing.reference_downscale)
    return torch.rand(3, height, width, generator=torch.Generator().manual_seed(0)).to(device)
