"""From the words of the command line to a segmenter."""

from __future__ import annotations

from collections.abc import Callable
from difflib import get_close_matches
from pathlib import Path

from pipeline.files import resolved
from pipeline.segmentation.base import Segmenter, SegmenterError
from pipeline.segmentation.deeplabv3 import DeepLabV3
from pipeline.segmentation.folder import MaskFolder
from pipeline.segmentation.maskrcnn import MaskRCNN
from pipeline.segmentation.tflite import TFLite

NETWORKS: dict[str, Callable[[], Segmenter]] = {"deeplabv3": DeepLabV3, "maskrcnn": MaskRCNN}
WITH_PATH: dict[str, Callable[[Path], Segmenter]] = {"tflite": TFLite, "folder": MaskFolder}
CHOICES = "deeplabv3, maskrcnn, tflite:FILE, folder:DIR"


def find_segmenter(words: str) -> Segmenter:
    """`deeplabv3`, `maskrcnn`, `tflite:FILE` or `folder:DIR` as a segmenter.

    Raises:
        SegmenterError: none of these.
    """
    name, _, path = words.partition(":")
    if name in NETWORKS and not path:
        return NETWORKS[name]()
    if name in WITH_PATH and path:
        return WITH_PATH[name](resolved(Path(path).expanduser()))
    close = get_close_matches(name, [*NETWORKS, *WITH_PATH], n=1)
    hint = f"; did you mean {close[0]!r}?" if close and close[0] != name else ""
    raise SegmenterError(f"--with {words}: not one of {CHOICES}{hint}")
