"""torchvision's Mask R-CNN (ResNet-50 FPN, version 2, COCO's classes): M = max over detections of score * soft mask.

All transient detections that the network returns count (scores from 0.05 on): a doubtful one only as much as its
score. Not yet run with real weights by us: the tests hold the choice of classes, the probability map and the loading
against a stand-in for torchvision.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from PIL import Image

from pipeline.scene import ScenePhoto
from pipeline.segmentation import vision
from pipeline.segmentation.base import Segmenter, SegmenterRecord
from pipeline.segmentation.classes import COCO_TRANSIENT, channels_of

BUILDER = "maskrcnn_resnet50_fpn_v2"
# Of a photo's longer side. The network works at 1333 at most, and returns up to 100 masks as large as its input.
LONG_SIDE = 1333


@dataclass(frozen=True)
class MaskRCNN(Segmenter):
    def describe(self, photos: Sequence[ScenePhoto]) -> SegmenterRecord:
        return vision.describe("maskrcnn", BUILDER, COCO_TRANSIENT)

    def probability(self, photo: ScenePhoto, pixels: np.ndarray) -> np.ndarray:
        """(h', w'): the photo's size, reduced where that exceeds `LONG_SIDE`."""
        import torch

        network, prepare, labels = load()
        small = np.array(reduced(Image.fromarray(pixels)))
        with torch.inference_mode():
            (found,) = network([prepare(torch.from_numpy(small).permute(2, 0, 1))])
            kept = torch.isin(found["labels"], torch.tensor(labels))
            if not kept.any():
                return np.zeros(small.shape[:2], np.float32)
            masks = found["masks"][kept, 0] * found["scores"][kept, None, None]  # (D, h', w')
            return masks.amax(dim=0).numpy()


def reduced(image: Image.Image) -> Image.Image:
    """`image`, its longer side at most `LONG_SIDE`."""
    scale = LONG_SIDE / max(image.size)
    if scale >= 1:
        return image
    width, height = (max(1, round(side * scale)) for side in image.size)
    return image.resize((width, height), Image.Resampling.BILINEAR)


@cache
def load() -> tuple[Any, Any, list[int]]:
    """The network, its preprocessing, and the labels of the transient classes."""
    weights = vision.default_weights(BUILDER)
    labels = channels_of(COCO_TRANSIENT, weights.meta["categories"], BUILDER)
    return vision.load_network(BUILDER), weights.transforms(), list(labels.values())
