"""timing.json: what a timing measured, a row each, and where it came from.

The rows are those of four tables: the paper's two, seconds an image and minutes of training, and two beyond them,
images a second against the number of appearances, and what a step or an image costs against rays, photos and pixels.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from pipeline.errors import CrossrayError
from pipeline.files import atomic_write

TIMING = "timing.json"


class TimingRow(BaseModel):
    """One measured time, with all that it depends on."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True, allow_inf_nan=False)

    table: Literal["inference", "training", "appearances", "cost"]
    """Which table it belongs to."""
    method: str
    """A row of METHODS."""
    field: Literal["mlp", "hash"]
    """The field of the method."""
    downscale: int | None = None
    """Of the picture: 2 for R/2; None for steps."""
    width: int | None = None
    """Pixels of the picture; None for steps."""
    height: int | None = None
    """Pixels of the picture; None for steps."""
    appearances: int | None = None
    """Images of one view that share its rendering; 1 is a single image. None for steps."""
    how: str
    """What is done: `rendered`, `recoloured` (features once, then colours), `placed once` (samples and all that no code
    changes once, then what a code changes), `trained` (a step)."""
    samples: tuple[int, int]
    """Samples a ray, first and second."""
    samples_as: Literal["trained", "evaluated"]
    """Whether these are the counts of training, or those of the reference's evaluation."""
    unit: Literal["image", "step"]
    """What `seconds` are of."""
    seconds: float = Field(gt=0)
    """Median of a unit. Of images: without the reading of the appearance (`encode_seconds`)."""
    low: float
    """First quartile; where parts were timed apart, the sum of theirs."""
    high: float
    """Third quartile, likewise."""
    repeats: int
    """Measurements behind the median; where parts were timed apart, of the one with the fewest."""
    minutes: float | None = None
    """Of a whole schedule, extrapolated from `seconds`; None for images."""
    steps: int | None = None
    """Of that schedule: the paper's has 20 x 17,200."""
    extrapolated: str | None = None
    """A sentence that says from what; None where a whole unit was measured."""
    peak_memory_MiB: float | None
    """Most that was held at once: on `cuda` of torch's allocator, model included; on `host` what the process grew by
    above its size before. None where the system does not tell. Of an extrapolated image: of the rays that were timed;
    of several images: with two of them; with several ranks: of rank 0."""
    memory_of: Literal["host", "cuda"]
    """Whose memory."""
    rays: int | None = None
    """A step and rank; None for images."""
    ranks: int = 1
    """Processes that trained together."""
    threads: int
    """Torch threads a process."""
    precision: Literal["float32", "bfloat16"]
    """Inside the field."""
    device: str
    """As its maker calls it."""
    photos: int | None = None
    """Training photos, where steps were timed."""
    varied: Literal["rays", "photos", "pixels"] | None = None
    """Table `cost`: what the row differs from its neighbours in."""
    once_seconds: float | None = None
    """Of `seconds` x `appearances`, what the view costs once, however many images share it."""
    each_seconds: float | None = None
    """What each further image of the view costs."""
    encode_seconds: float | None = None
    """Reading one appearance from a reference photo; None where none is read. Not part of `seconds`."""
    flops: float | None = None
    """Floating-point operations of a unit in matrix products and convolutions, counted; nothing else is counted."""
    peak_flops: float | None = None
    """A second, of a large matrix product in this precision, measured in the same run."""
    note: str | None = None
    """What a reader has to know beside."""

    @property
    def of_peak(self) -> float | None:
        """Share of the measured peak that the counted operations reach; None where they were not counted."""
        if self.flops is None or self.peak_flops is None:
            return None
        return self.flops / self.seconds / self.peak_flops


class Timing(BaseModel):
    """timing.json."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Literal[1] = 1
    rows: tuple[TimingRow, ...]
    job: dict[str, Any] = {}
    provenance: dict[str, Any]


def write_timing(folder: Path, rows: Sequence[TimingRow], job: dict[str, Any], provenance: dict[str, Any]) -> Path:
    """Write `folder`/timing.json whole; returns its path."""
    record = Timing(rows=tuple(rows), job=job, provenance=provenance)
    path = folder / TIMING
    atomic_write(path, json.dumps(record.model_dump(mode="json"), indent=1) + "\n")
    return path


def read_timing(path: Path) -> Timing:
    """A timing.json.

    Raises:
        CrossrayError: it cannot be read, or is not one.
    """
    try:
        return Timing.model_validate_json(path.read_bytes())
    except OSError as error:
        raise CrossrayError(f"{path}: cannot be read ({error.strerror})") from error
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise CrossrayError(f"{path}: is not a timing: {where or 'file'}: {first['msg']}") from None
