"""A timing as a job: what is timed, at which sizes, and how long a measurement may take.

Neither a scene nor a trained run is needed: weights are untrained and photos are noise (pipeline/timing_scene.py says
why neither moves a time).
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import Field, ValidationError

from model.methods import METHODS, smallest_reference
from pipeline.config import Job, JobError, Section, explained, make_job, merge, nearest, parse_setting, parse_yaml

Positive = Annotated[int, Field(ge=1)]
Precision = Literal["float32", "bfloat16"]


class InferenceTiming(Section):
    """Seconds an image, one and many of one view; images a second; cost against pixels."""

    methods: tuple[str, ...] = ("hanerf", "crnerf", "crossray")
    """Rows of `crossray methods`."""
    downscales: Annotated[tuple[Positive, ...], Field(min_length=1)] = (4, 2)
    """Sizes of the pictures: the paper's R/4 and R/2."""
    samples: tuple[Literal["trained", "evaluated"], ...] = ("trained", "evaluated")
    """Samples a ray: those of training (64 + 64), those that the reference evaluates with (256 + 256). The fast field
    has its own, and only those."""
    images: int = Field(64, ge=1)
    """How many images of one view the columns of multiple images share."""
    appearances: tuple[Positive, ...] = (1, 8, 64, 512)
    """Numbers of images of one view for the table of images a second, at the first of `downscales`."""
    pixels: tuple[Positive, ...] = (32, 16, 8)
    """Downscales of the pictures whose cost is compared, of the methods in `cost`."""


class TrainingTiming(Section):
    """Minutes of the paper's schedule; cost against rays and photos."""

    methods: tuple[str, ...] = ("nerfw", "hanerf", "crnerf", "crossray")
    """Rows of `crossray methods`."""
    ranks: int = Field(1, ge=1)
    """Processes that train together: one a GPU, or one a CPU core."""
    rays: int = Field(1024, ge=4)
    """Rays a rank and step, over as many photos as the method's recipe says."""
    photos: int = Field(763, ge=1)
    """Training photos: Brandenburg Gate has 763."""
    epochs: int = Field(20, ge=1)
    """Of the schedule whose minutes are extrapolated."""
    steps_per_epoch: int = Field(17200, ge=1)
    """Of that schedule."""
    cost_rays: tuple[Positive, ...] = (400, 576, 784, 1024, 1600)
    """Rays a step that are compared, of the methods in `cost`."""
    cost_photos: tuple[Positive, ...] = (50, 500, 5000)
    """Numbers of training photos that are compared; the cost must not depend on them."""


class TimingJob(Section):
    """Times methods on this machine, without a scene."""

    kind: Literal["timing"] = "timing"
    """What the job does."""
    name: str = Field("timing", pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", max_length=100)
    """What is measured goes to `<runs>/<name>/timing.json`; an earlier one there is replaced."""
    runs: Path = Path("runs")
    """Folder of all runs."""
    what: Annotated[tuple[Literal["inference", "training"], ...], Field(min_length=1)] = ("inference", "training")
    """What is timed."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """`auto`: CUDA where there is a GPU."""
    threads: int | None = Field(None, ge=1, le=1024)
    """Torch threads a process on CPU; null: all cores, shared by the ranks."""
    precision: Literal["auto"] | Annotated[tuple[Precision, ...], Field(min_length=1)] = "auto"
    """Inside the field. `auto`: float32, and bfloat16 where a training would choose it."""
    seconds: float = Field(2.0, gt=0)
    """That the repeats of one measurement may take together (three are made in any case). A picture that takes longer
    is extrapolated from some of its rays, and its row says so."""
    width: int = Field(992, ge=32)
    """Pixels of a photo before it is reduced. The default is Brandenburg Gate's mean: 17,200 steps x 8 GPUs x 1,024
    rays over 763 photos are 184,670 pixels a photo at R/2; 496 x 372 are 184,512."""
    height: int = Field(744, ge=32)
    """As `width`."""
    reference_downscale: int = Field(8, ge=1)
    """The appearance encoder and the segmenter see a photo reduced by this factor."""
    cost: tuple[str, ...] = ("crossray",)
    """Methods whose cost is compared over rays, photos and pixels."""
    inference: InferenceTiming = InferenceTiming()
    """Seconds an image."""
    training: TrainingTiming = TrainingTiming()
    """Minutes of a training."""

    @property
    def folder(self) -> Path:
        """Where timing.json is written."""
        return self.runs / self.name

    def size(self, downscale: int) -> tuple[int, int]:
        """Height and width of a reduced photo."""
        return self.height // downscale, self.width // downscale


def load_timing(path: Path, settings: Sequence[str] = ()) -> TimingJob:
    """The timing in a YAML file of this kind, with `key.sub=value` settings on top.

    Raises:
        JobError: a key or a value is wrong; the message names it.
    """
    try:
        raw = parse_yaml(path.read_text())
    except (yaml.YAMLError, ValueError) as error:
        raise JobError(f"{path}: not a YAML file: {error}") from error
    return make_timing(raw, settings, source=str(path))


def make_timing(raw: dict[str, Any], settings: Sequence[str] = (), source: str = "timing") -> TimingJob:
    """Like load_timing, from a mapping."""
    for setting in settings:
        raw = merge(raw, parse_setting(setting))
    try:
        timing = TimingJob.model_validate(raw)
    except ValidationError as error:
        raise JobError("\n".join(f"{source}: {line}" for line in explained(error, TimingJob))) from None
    try:
        check_timing(timing)
    except (ValueError, JobError) as error:
        raise JobError(f"{source}: {error}") from None
    return timing


def check_timing(timing: TimingJob) -> None:
    """Refuse methods that are none, images that could share nothing, and sizes that no model takes.

    Raises:
        ValueError, JobError: the message names the key.
    """
    if "inference" in timing.what:
        check_methods("inference.methods", timing.inference.methods)
        check_methods("cost", timing.cost)
        check_shared(timing.inference)
        for method in (*timing.inference.methods, *timing.cost):
            check_reference(timing, method)
        for key in ("downscales", "pixels"):
            for downscale in getattr(timing.inference, key):
                if min(timing.size(downscale)) < 1:
                    raise ValueError(
                        f"inference.{key}: {downscale} leaves nothing of {timing.width} x {timing.height} pixels"
                    )
    if "training" in timing.what:
        check_methods("training.methods", timing.training.methods)
        check_methods("cost", timing.cost)
        for method in (*timing.training.methods, *timing.cost):
            check_reference(timing, method)
            training_job(timing, method)
        for method in timing.cost:
            for rays in timing.training.cost_rays:
                training_job(timing, method, rays, "training.cost_rays")


def check_methods(key: str, names: Iterable[str]) -> None:
    """ValueError for a name that is no method."""
    for name in names:
        if name not in METHODS:
            raise ValueError(f"{key}: {name!r} is not known{nearest(name, list(METHODS))}")


def check_shared(inference: InferenceTiming) -> None:
    """ValueError for a method of one appearance where several images of a view are asked for."""
    if max(inference.images, *inference.appearances, 1) == 1:
        return
    for name in inference.methods:
        if METHODS[name].appearance == "none":
            raise ValueError(
                f"inference.methods: {name} has one appearance, so there are no {inference.images} images of one view; "
                "--set inference.images=1 --set 'inference.appearances=[1]' times a single one"
            )


def check_reference(timing: TimingJob, method: str) -> None:
    """ValueError where a reduced photo is smaller than what the method's networks read."""
    least, size = smallest_reference(method_job(timing, method).model), timing.size(timing.reference_downscale)
    if min(size) < least:
        raise ValueError(
            f"reference_downscale: {timing.reference_downscale} makes photos of {timing.width} x {timing.height} "
            f"{size[1]} x {size[0]} pixels, and the networks of {method} read no side under {least}"
        )


def methods_of(timing: TimingJob) -> list[str]:
    """All methods that are timed, each once."""
    chosen = {"inference": timing.inference.methods, "training": timing.training.methods}
    return list(dict.fromkeys(name for what in timing.what for name in (*chosen[what], *timing.cost)))


def threads_of(timing: TimingJob, ranks: int = 1) -> int:
    """Torch threads of each of so many processes."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return timing.threads or max(1, cores // ranks)


def method_job(timing: TimingJob, method: str) -> Job:
    """A training of the method by its own recipe, with the schedule of the timing."""
    training = timing.training
    return make_job(
        {
            "name": timing.name,
            "method": method,
            "runs": str(timing.runs),
            "scene": {"path": "synthetic", "downscale": 2, "reference_downscale": timing.reference_downscale},
            "ranks": training.ranks,
            "launcher": "local",
            "device": timing.device,
            "threads": threads_of(timing, training.ranks),
            "train": {"epochs": training.epochs, "steps_per_epoch": training.steps_per_epoch},
        }
    )


def training_job(timing: TimingJob, method: str, rays: int | None = None, key: str = "training.rays") -> Job:
    """The training whose steps are timed: the method's with so many rays a rank, by default those of the timing.

    Raises:
        ValueError, JobError: `rays`, which `key` names, cannot be cut into square patches that the method takes.
    """
    rays, job = rays or timing.training.rays, method_job(timing, method)
    photos = job.patch.photos
    side = math.isqrt(rays // photos)
    if side < 2 or side * side * photos != rays:
        fitting = max(2, round(math.sqrt(rays / photos))) ** 2 * photos
        patches = "one square patch" if photos == 1 else f"{photos} square patches"
        raise ValueError(f"{key}: {rays} rays are not {patches}, which the recipe of {method} takes; {fitting} are")
    try:
        return make_job(merge(job.model_dump(mode="json"), {"patch": {"size": side}}))
    except JobError as error:
        raise JobError(f"{key}: {rays} rays of {method}: {error}") from None


def with_precision(job: Job, precision: str) -> Job:
    """The job computing in `precision` inside the field."""
    return job.model_copy(update={"train": job.train.model_copy(update={"precision": precision})})
