"""Segmenters made elsewhere: what in a photo is transient, by networks that have never seen the scene.

base.py says what a segmenter is and classes.py which things count as transient; then a file a kind: deeplabv3.py,
maskrcnn.py (both torchvision's, found by vision.py), tflite.py, folder.py. `pipeline/masks.py` is the stage that
runs one over a scene.
"""

from pipeline.segmentation.base import Segmenter, SegmenterError, SegmenterRecord
from pipeline.segmentation.kinds import find_segmenter

__all__ = ["Segmenter", "SegmenterError", "SegmenterRecord", "find_segmenter"]
