"""torchvision's DeepLabV3 (ResNet-101, PASCAL VOC's classes): M = sum of the softmax over the transient classes.

Not yet run with real weights by us: the tests hold the choice of classes, the probability map and the loading
against a stand-in for torchvision.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from pipeline.scene import ScenePhoto
from pipeline.segmentation import vision
from pipeline.segmentation.base import Segmenter, SegmenterRecord
from pipeline.segmentation.classes import PASCAL_TRANSIENT, channels_of

BUILDER = "deeplabv3_resnet101"


@dataclass(frozen=True)
class DeepLabV3(Segmenter):
    def describe(self, photos: Sequence[ScenePhoto]) -> SegmenterRecord:
        return vision.describe("deeplabv3", BUILDER, PASCAL_TRANSIENT)

    def probability(self, photo: ScenePhoto, pixels: np.ndarray) -> np.ndarray:
        """(h', w') with the photo's aspect and a shorter side of 520, to which the weights' own preprocessing
        resizes.
        """
        import torch

        network, prepare, channels = load()
        image = torch.from_numpy(pixels.copy()).permute(2, 0, 1)
        with torch.inference_mode():
            logits = network(prepare(image)[None])["out"][0]
            return logits.softmax(dim=0)[channels].sum(dim=0).numpy()


@cache
def load() -> tuple[Any, Any, list[int]]:
    """The network, its preprocessing, and the channels of the transient classes."""
    weights = vision.default_weights(BUILDER)
    network = vision.load_network(BUILDER, aux_loss=True)  # the weights have the auxiliary head, which we do not read
    channels = channels_of(PASCAL_TRANSIENT, weights.meta["categories"], BUILDER)
    return network, weights.transforms(), list(channels.values())
