"""What a segmenter is: a small picklable value that knows how to find its network, and what it records of itself."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from pipeline.errors import CrossrayError
from pipeline.manifest import digest
from pipeline.scene import ScenePhoto

Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class SegmenterError(CrossrayError):
    """A segmenter that is not known, not installed, or cannot be used."""


class SegmenterRecord(BaseModel):
    """A segmenter as `masks.json` lists it."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    file: str | None = None  # of the weights or the model, without its folder
    sha256: Sha256 | None = None  # of that file
    classes: dict[str, int] = {}  # what is masked -> the network's channel for it
    versions: dict[str, str] = {}  # of the libraries that ran it

    @property
    def identity(self) -> str:
        """SHA-256 of what decides the masks. A new version of a library does not make another segmenter."""
        return digest(self.model_dump(mode="json", include={"name", "sha256", "classes"}))


class Segmenter:
    """One way to make masks. Values travel to the tasks, and their networks do not: `probability` loads its network
    once a process.
    """

    def describe(self, photos: Sequence[ScenePhoto]) -> SegmenterRecord:
        """What it is, after a look at whether it can mask `photos`.

        Raises:
            SegmenterError: something is not installed, not there, or not of a kind that we can use.
        """
        raise NotImplementedError

    def source(self, photo: ScenePhoto) -> Path | None:
        """The file from which, beside the photo, its mask is made."""
        return None

    def probability(self, photo: ScenePhoto, pixels: np.ndarray) -> np.ndarray:
        """Transient probability of the photo with the uint8 RGB `pixels` (h, w, 3): float32 in [0, 1], (h', w') of
        any size and aspect, covering the whole photo.
        """
        raise NotImplementedError
