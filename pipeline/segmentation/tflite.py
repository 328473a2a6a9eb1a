"""Any DeepLab-like TFLite model with PASCAL VOC's classes: M = sum of the softmax over the transient classes.

Such a model takes one RGB picture, float32 (1, h, w, 3) in [-1, 1], and gives logits, float32 (1, h', w', 21). The
photo is squeezed to (h, w), whatever its aspect. Class names are read from a text file beside the model (the same
name with `.txt`, a line a class); without one the classes are in PASCAL's order.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from pipeline.files import sha256_of
from pipeline.scene import ScenePhoto
from pipeline.segmentation.base import Segmenter, SegmenterError, SegmenterRecord
from pipeline.segmentation.classes import PASCAL, PASCAL_TRANSIENT, channels_of

MISSPELT = {"biyclce": "bicycle"}  # in the label file that went round with TensorFlow's own model


@dataclass(frozen=True)
class TFLite(Segmenter):
    file: Path

    def describe(self, photos: Sequence[ScenePhoto]) -> SegmenterRecord:
        from importlib.metadata import version

        open_model(self.file, quick=False)
        labels = read_labels(self.file)
        return SegmenterRecord(
            name="tflite",
            file=self.file.name,
            sha256=sha256_of(self.file),
            classes=channels_of(PASCAL_TRANSIENT, labels, str(self.file)),
            versions={"ai-edge-litert": version("ai-edge-litert")},
        )

    def probability(self, photo: ScenePhoto, pixels: np.ndarray) -> np.ndarray:
        model, channels = load(self.file)
        taken, given = model.get_input_details()[0], model.get_output_details()[0]
        _, height, width, _ = taken["shape"]
        squeezed = Image.fromarray(pixels).resize((int(width), int(height)), Image.Resampling.BILINEAR)
        model.set_tensor(taken["index"], np.asarray(squeezed, np.float32)[None] / 127.5 - 1)
        model.invoke()
        return softmax(model.get_tensor(given["index"])[0])[..., channels].sum(axis=-1)


@cache
def load(file: Path) -> tuple[Any, list[int]]:
    """The model, ready to run, and the channels of the transient classes."""
    channels = channels_of(PASCAL_TRANSIENT, read_labels(file), str(file))
    return open_model(file, quick=True), list(channels.values())


def open_model(file: Path, quick: bool) -> Any:
    """An interpreter of the model. `quick` takes its fast kernels, which announce themselves on standard error.

    Raises:
        SegmenterError: ai-edge-litert is not installed, or the file is no such model.
    """
    try:
        from ai_edge_litert.interpreter import Interpreter, OpResolverType
    except ImportError as error:
        raise SegmenterError(f"tflite:FILE needs ai-edge-litert ({error}): pip install -e '.[tflite]'") from error
    if not file.is_file():
        raise SegmenterError(f"{file}: no such file; tflite:FILE names a TFLite model")
    kernels = OpResolverType.AUTO if quick else OpResolverType.BUILTIN_WITHOUT_DEFAULT_DELEGATES
    try:
        model = Interpreter(str(file), num_threads=1, experimental_op_resolver_type=kernels)
        model.allocate_tensors()
    except (ValueError, RuntimeError) as error:
        raise SegmenterError(f"{file} cannot be read as a TFLite model ({error})") from error
    taken, given = model.get_input_details(), model.get_output_details()
    if not (fits(taken, 3) and fits(given, len(PASCAL))):
        raise SegmenterError(
            f"{file} takes {shapes(taken)} and gives {shapes(given)}; what we can use takes float32 1 x h x w x 3 and "
            f"gives float32 1 x h x w x {len(PASCAL)}, the logits of PASCAL VOC's classes"
        )
    return model


def fits(tensors: list[dict], channels: int) -> bool:
    """Whether `tensors` is one float32 tensor (1, h, w, channels)."""
    if len(tensors) != 1 or tensors[0]["dtype"] is not np.float32 or len(tensors[0]["shape"]) != 4:
        return False
    batch, height, width, last = tensors[0]["shape"]
    return batch == 1 and min(height, width) > 1 and last == channels


def shapes(tensors: list[dict]) -> str:
    return ", ".join(f"{np.dtype(t['dtype']).name} {' x '.join(map(str, t['shape']))}" for t in tensors)


def read_labels(file: Path) -> list[str]:
    """PASCAL's names in the order of the model's channels.

    Raises:
        SegmenterError: the text file beside the model names other classes.
    """
    path = file.with_suffix(".txt")
    if not path.is_file():
        return list(PASCAL)
    try:
        lines = [line for line in path.read_text(encoding="utf-8-sig").splitlines() if line.strip()]
    except (OSError, UnicodeDecodeError) as error:
        raise SegmenterError(f"{path} cannot be read ({error}); it names the classes of {file.name}") from error
    names = [re.sub("[^a-z]", "", line.lower()) for line in lines]  # "TV-monitor" -> "tvmonitor"
    names = [MISSPELT.get(name, name) for name in names]
    if sorted(names) != sorted(PASCAL):
        unknown = [line for line, name in zip(lines, names, strict=True) if name not in PASCAL]
        what = f"it has {', '.join(unknown[:5])}" if unknown else f"it has {len(lines)} lines"
        raise SegmenterError(f"{path} does not name PASCAL VOC's {len(PASCAL)} classes, one a line ({what})")
    return names


def softmax(logits: np.ndarray) -> np.ndarray:
    """Over the last axis."""
    powers = np.exp(logits - logits.max(axis=-1, keepdims=True))
    return powers / powers.sum(axis=-1, keepdims=True)
