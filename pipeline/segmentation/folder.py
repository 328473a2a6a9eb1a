"""Masks made elsewhere: a folder of grayscale PNGs, 255 = certainly transient, a photo's full size or any other.

The mask of `castle/a.jpg` is `castle/a.png`, `castle/a.jpg.png` or `castle/a.mask.png` in the folder. The last is how
the built-in landmark keeps its true masks: `folder:LANDMARK/truth` gives what a perfect segmenter would.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from pipeline.manifest import ShardError
from pipeline.pictures import decode_mask
from pipeline.scene import ScenePhoto
from pipeline.segmentation.base import Segmenter, SegmenterError, SegmenterRecord

ASPECT = 0.02  # relative difference from the photo's aspect ratio: rounding, not cropping
SHOWN = 5  # problems of a list
GRAY = ("L", "1", "I;16")


@dataclass(frozen=True)
class MaskFolder(Segmenter):
    folder: Path

    def describe(self, photos: Sequence[ScenePhoto]) -> SegmenterRecord:
        from importlib.metadata import version

        if not self.folder.is_dir():
            raise SegmenterError(f"{self.folder}: no such folder; folder:DIR names one with a PNG mask a photo")
        problems = [problem for photo in photos if (problem := self.problem(photo))]
        if problems:
            more = f"\n  and {len(problems) - SHOWN} more" if len(problems) > SHOWN else ""
            raise SegmenterError(
                f"{self.folder}: {len(problems)} of {len(photos)} photos have no mask that fits:\n  "
                + "\n  ".join(problems[:SHOWN])
                + more
            )
        return SegmenterRecord(name="folder", file=self.folder.name, versions={"pillow": version("pillow")})

    def source(self, photo: ScenePhoto) -> Path:
        found = self.candidates(photo)
        if not found:
            raise SegmenterError(f"{self.folder}: the mask of photo {photo.name} is gone")
        return found[0]

    def probability(self, photo: ScenePhoto, pixels: np.ndarray) -> np.ndarray:
        """(h', w'): the mask's own size."""
        path = self.source(photo)
        try:
            return decode_mask(path.read_bytes(), photo) / np.float32(255)
        except (OSError, ShardError) as error:
            raise SegmenterError(f"{path}: {error}") from error

    def candidates(self, photo: ScenePhoto) -> list[Path]:
        name = Path(photo.name)
        ends = (name.with_suffix(".png"), f"{name}.png", name.with_suffix(".mask.png"))
        paths = [self.folder / end for end in ends]
        return [path for path in dict.fromkeys(paths) if path.is_file()]

    def problem(self, photo: ScenePhoto) -> str | None:
        """What is wrong with the mask of a photo."""
        found = self.candidates(photo)
        if len(found) != 1:
            return f"{photo.name}: " + (f"{found[0].name} and {found[1].name}: keep one" if found else "no mask")
        try:
            with Image.open(found[0], formats=["PNG"]) as image:
                mode, (width, height) = image.mode, image.size
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
            return f"{photo.name}: {found[0].name} is not a PNG picture"
        if mode not in GRAY:
            return f"{photo.name}: {found[0].name} is {mode}, not grayscale"
        if abs(width * photo.height - height * photo.width) > ASPECT * height * photo.width:
            return f"{photo.name} is {photo.width} x {photo.height} and {found[0].name} {width} x {height}"
        return None
