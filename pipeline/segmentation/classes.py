"""Which things count as transient: what walks, flies, drives, or is carried by those who do.

Nothing that stands where it stands is in the lists, however often it is moved: a mask over a bench or a lamp would
take a part of the place away for good. "We carefully choose the categories for estimation to avoid masking out
static objects" (the paper, section on transient objects) is all that is published; the choice is ours.
"""

from __future__ import annotations

from collections.abc import Sequence

from pipeline.segmentation.base import SegmenterError

PASCAL = (
    "background", "aeroplane", "bicycle", "bird", "boat", "bottle", "bus", "car", "cat", "chair", "cow",
    "diningtable", "dog", "horse", "motorbike", "person", "pottedplant", "sheep", "sofa", "train", "tvmonitor",
)  # fmt: skip

# All of PASCAL VOC but bottle, chair, diningtable, pottedplant, sofa, tvmonitor.
PASCAL_TRANSIENT = (
    "aeroplane", "bicycle", "bird", "boat", "bus", "car", "cat", "cow", "dog", "horse", "motorbike", "person",
    "sheep", "train",
)  # fmt: skip

# Of COCO: people, vehicles, animals, and what people wear and carry. Not street furniture, plants, food or interiors.
COCO_TRANSIENT = (
    "person",
    "bicycle", "car", "motorcycle", "airplane", "bus", "train", "truck", "boat",
    "bird", "cat", "dog", "horse", "sheep", "cow", "elephant", "bear", "zebra", "giraffe",
    "backpack", "umbrella", "handbag", "tie", "suitcase", "cell phone",
    "frisbee", "skis", "snowboard", "sports ball", "kite", "baseball bat", "baseball glove", "skateboard",
    "surfboard", "tennis racket",
)  # fmt: skip


def channels_of(transient: Sequence[str], labels: Sequence[str], where: str) -> dict[str, int]:
    """Name -> its place in `labels`, for each name in `transient`.

    Raises:
        SegmenterError: one is missing.
    """
    missing = [name for name in transient if name not in labels]
    if missing:
        raise SegmenterError(f"{where} has no class {', '.join(missing)}: its classes are {', '.join(labels)}")
    return {name: labels.index(name) for name in transient}
