"""Seconds an image: one, and many of one view that share what no appearance changes.

An image is rendered, coloured, made 8-bit and brought to the host. What images of one view share depends on how an
appearance enters. By the cross-ray transform (CR-NeRF), features are rendered once, and an image more is one affine
map and a sigmoid. As a code at points (Ha-NeRF, NeRF-W), samples, densities and the trunk are done once
(`Field.place`), and an image more is the last layers of the fine MLP at every sample (`Field.look`). The paper moved
such interim results to the host; here each chunk of rays is kept while all appearances look at it. The two kinds of
work are timed apart, and for N images

    seconds an image = (once + N each) / N.

Reading an appearance from its photo is timed apart and is part of neither.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from itertools import product
from typing import Any, NamedTuple

import torch
from torch import Tensor

from model.appearance.crossray import ContentStatistics
from model.fields.base import Codes, Placed, Rays, at_least_float32, render_points
from model.scene_model import SceneModel
from pipeline.config import Job
from pipeline.provenance import device_name
from pipeline.render import View, grid_rays, recoloured, statistics_of, view_rays
from pipeline.timing import TimingRow
from pipeline.timing_job import TimingJob, method_job, threads_of
from pipeline.timing_measure import LEAST, Meter, PeakMemory, Seconds, counted_flops, memory_of
from pipeline.timing_scene import camera, reference_photo, untrained

log = logging.getLogger("crossray")

EVALUATED = (256, 256)  # samples a ray of the released evaluation
LOOKS = 2  # appearances between two looks at the clock
COUNTED = 16  # rays whose operations are counted


class TimedRays(NamedTuple):
    """What some rays of a view took."""

    seconds: Seconds
    rays: int
    view: int  # rays of the view that they are of

    def of(self, rays: int) -> Seconds:
        """What `rays` take."""
        return self.seconds.times(rays / self.rays)

    def sentence(self, rays: int) -> str | None:
        """From what the time of a view of `rays` is extrapolated; None if it is not."""
        if rays != self.view:
            return f"from {self.rays:,} rays of a larger view"
        return None if rays == self.rays else f"from {self.rays:,} of its {rays:,} rays"


class Timed(NamedTuple):
    """What was timed of a view's rays."""

    once: TimedRays
    each: TimedRays | None  # for each code, where the field reads one
    flops: float  # a ray, rendered once
    encode: float | None  # seconds of reading one appearance


class Parts(NamedTuple):
    """What the images of one view cost."""

    once: Seconds
    each: Seconds | None  # None: the method has one appearance, and the view one image
    how: str  # what an image more is
    encode: float | None
    flops: float  # of the rendering, once
    once_from: str | None  # from what `once` is extrapolated
    each_from: str | None  # from what `each` is

    def extrapolated(self, count: int) -> str | None:
        """From what the time of an image is when `count` share the view."""
        parts = [f"the view {self.once_from}"] if self.once_from else []
        parts += [f"an image more {self.each_from}"] if self.each_from else []
        if count > LOOKS:
            parts.append(f"{LOOKS} of the {count} images were made")
        return "; ".join(parts) or None

    def image(self, count: int) -> Seconds:
        """Seconds an image when `count` share the view."""
        whole = self.once if self.each is None else self.once.plus(self.each.times(count))
        return whole.times(1 / count)


class Setting(NamedTuple):
    """One line of the table: a method as it is timed."""

    job: Job
    model: SceneModel
    samples: tuple[int, int]
    samples_as: str
    precision: str


# ------------------------------------------------------------------------------------------------------ the tables


@torch.no_grad()
def inference_rows(timing: TimingJob, meter: Meter, peak: Callable[[str], float]) -> list[TimingRow]:
    """Rows of the tables `inference`, `appearances` and, over pixels, `cost`.

    Args:
        peak: operations a second that the device reaches in a precision.
    """
    wanted, rows = timing.inference, []
    for method in wanted.methods:
        for setting in settings(timing, method, meter.device, wanted.samples):
            found = dict(views(timing, meter, setting, wanted.downscales))
            for count, downscale in product(sorted({1, wanted.images}), wanted.downscales):
                rows.append(image_row("inference", timing, setting, found, downscale, count, meter, peak))
            if setting.samples_as == "trained":
                for count in wanted.appearances:
                    size = wanted.downscales[0]
                    rows.append(image_row("appearances", timing, setting, found, size, count, meter, peak))
    for method in timing.cost if wanted.pixels else ():
        setting = next(settings(timing, method, meter.device, ("trained",)))
        for downscale in wanted.pixels:
            found = dict(views(timing, meter, setting, (downscale,)))  # each timed by itself: they are compared
            row = image_row("cost", timing, setting, found, downscale, 1, meter, peak)
            rows.append(row.model_copy(update={"varied": "pixels"}))
    return rows


def settings(
    timing: TimingJob, method: str, device: torch.device, samples: Sequence[str] = ("trained", "evaluated")
) -> Iterator[Setting]:
    """A method in each precision, by default in float32, in which pictures are rendered, with those of `samples` that
    it has."""
    job = method_job(timing, method)
    mlp, hashed = job.model.mlp, job.model.hash
    counts = {"trained": (mlp.coarse_samples, mlp.fine_samples), "evaluated": EVALUATED}
    if job.model.field == "hash":
        counts = {"trained": (hashed.proposal_samples, hashed.samples)}
    for precision in ("float32",) if timing.precision == "auto" else timing.precision:
        model = untrained(job, device, precision == "bfloat16")
        for name in counts:
            if name in samples:
                yield Setting(job, model, counts[name], name, precision)


def views(
    timing: TimingJob, meter: Meter, setting: Setting, downscales: tuple[int, ...]
) -> Iterator[tuple[int, Parts]]:
    """The parts of a view at each size. The largest comes first: where a smaller one has no fewer rays than were timed
    of it, a ray costs the same, and nothing is timed again."""
    model, timed = setting.model, None
    reference = reference_photo(timing, meter.device)
    for downscale in sorted(set(downscales)):
        size = timing.size(downscale)
        log.info(
            "timing %s at R/%d: %d + %d samples, %s", setting.job.method, downscale, *setting.samples, setting.precision
        )
        rays = view_rays(camera(0, *size), model.spec.pixel_center, meter.device)
        if timed is None or timed.once.rays > len(rays.near):
            timed = (time_codes if model.coded else time_features)(meter, setting, rays, reference)
        yield downscale, (coded_parts if model.coded else fused_parts)(meter, setting, timed, rays, size, reference)


def image_row(
    table: str,
    timing: TimingJob,
    setting: Setting,
    found: dict[int, Parts],
    downscale: int,
    count: int,
    meter: Meter,
    peak: Callable[[str], float],
) -> TimingRow:
    """The row of `count` images of one view."""
    parts, (height, width) = found[downscale], timing.size(downscale)
    seconds = parts.image(count)
    fields: dict[str, Any] = {
        "table": table,
        "method": setting.job.method,
        "field": setting.job.model.field,
        "downscale": downscale,
        "width": width,
        "height": height,
        "appearances": count,
        "how": "rendered" if count == 1 else parts.how,
        "samples": setting.samples,
        "samples_as": setting.samples_as,
        "unit": "image",
        "seconds": seconds.median,
        "low": seconds.low,
        "high": seconds.high,
        "repeats": seconds.repeats,
        "extrapolated": parts.extrapolated(count),
        "peak_memory_MiB": seconds.memory,
        "memory_of": memory_of(meter.device),
        "threads": threads_of(timing),
        "precision": setting.precision,
        "device": device_name(meter.device),
        "once_seconds": parts.once.median,
        "each_seconds": parts.each and parts.each.median,
        "encode_seconds": parts.encode,
    }
    if count == 1:
        fields |= {"flops": parts.flops, "peak_flops": peak(setting.precision)}
    return TimingRow(**fields)


# ------------------------------------------------------------------------------------------------------- the parts


def time_features(meter: Meter, setting: Setting, rays: Rays, reference: Tensor) -> Timed:
    """The rendering of features, where the field reads no code."""

    def render(some: Rays) -> None:
        setting.model.render(some, samples=setting.samples)

    timed = time_rays(meter, rays, chunk_of(setting), render)
    return Timed(timed, None, flops_a_ray(render, rays), encoding(meter, setting.model, reference))


def fused_parts(
    meter: Meter, setting: Setting, timed: Timed, rays: Rays, size: tuple[int, int], reference: Tensor
) -> Parts:
    """Where the field reads no code: features are rendered once, and an image more is a new colour."""
    model, total = setting.model, len(rays.near)
    rendered, flops, sentence = timed.once.of(total), total * timed.flops, timed.once.sentence(total)
    channels = model.render(first(rays, 1), samples=setting.samples).features.shape[-1]
    features = torch.rand(total, channels, device=meter.device)  # as many as the view has: their values are free
    view = View(size, features, torch.empty(0), torch.empty(0))
    if model.transform is None:
        coloured = meter.measure(lambda: eight_bit(model.colours(features[None], None)[0]))
        return Parts(rendered.plus(coloured), None, "rendered", None, flops, sentence, None)

    def statistics() -> ContentStatistics | None:
        points = model.point_features(grid_rays(rays, size), setting.samples) if model.fuses_points else None
        return statistics_of(model, view._replace(points=points))

    content, appearances = statistics(), model.encode([reference]).expand(LOOKS, -1, -1, -1)
    once = rendered.plus(meter.measure(statistics))
    each = meter.measure(lambda: recoloured(view, model.colour_map(content, appearances))).times(1 / LOOKS)
    return Parts(once, each, "recoloured", timed.encode, flops, sentence, None)


def time_codes(meter: Meter, setting: Setting, rays: Rays, reference: Tensor) -> Timed:
    """Where the field reads a code: the placing of samples, and a look at one chunk of them."""
    model = setting.model
    code = model.embedding.weight[:1] if model.embedding is not None else model.encode([reference])

    def place(some: Rays) -> Placed:
        for part in model.field.chunks(some, None, setting.samples):
            with model.autocast(meter.device):
                placed = model.field.place(part, samples=setting.samples)
        return placed

    placed = place(first(rays, chunk_of(setting)))

    def looks() -> None:
        for _ in range(LOOKS):
            look(model, placed, code)

    looking = TimedRays(meter.measure(looks).times(1 / LOOKS), len(placed.t), len(rays.near))
    flops = flops_a_ray(lambda some: look(model, place(some), code), rays)
    timed = time_rays(meter, rays, chunk_of(setting), place)
    return Timed(timed, looking, flops, encoding(meter, model, reference))


def coded_parts(
    meter: Meter, setting: Setting, timed: Timed, rays: Rays, size: tuple[int, int], reference: Tensor
) -> Parts:
    """Where the field reads a code: samples are placed once, and an image more looks at them again. A view rendered
    anew does just this for one code (`Field.march`)."""
    assert timed.each is not None
    total = len(rays.near)
    return Parts(
        timed.once.of(total),
        timed.each.of(total),
        "placed once",
        timed.encode,
        total * timed.flops,
        timed.once.sentence(total),
        timed.each.sentence(total),
    )


def look(model: SceneModel, placed: Placed, code: Tensor) -> Tensor:
    """The 8-bit colours (R, 3) of placed rays in one code (1, CODE)."""
    with model.autocast(placed.t.device):
        level = model.field.look(placed, Codes(code.expand(len(placed.t), -1))).levels[-1]
    return eight_bit(model.colours(at_least_float32(level.composite().features)[None], None)[0])


def encoding(meter: Meter, model: SceneModel, reference: Tensor) -> float | None:
    """Seconds of reading one appearance; None where none is read from photos."""
    if model.encoder is None:
        return None
    return meter.measure(lambda: model.encode([reference])).median


def time_rays(meter: Meter, rays: Rays, chunk: int, work: Callable[[Rays], object]) -> TimedRays:
    """What rays take, or as many whole chunks of them as the meter's seconds are enough for (one in any case)."""
    memory, total = PeakMemory(meter.device), len(rays.near)
    some = first(rays, chunk)
    work(some)
    seconds = meter.once(lambda: work(some))
    count = min(total, chunk * max(1, int(meter.seconds / LEAST / max(seconds, 1e-9))))
    part = first(rays, count)
    if count > len(some.near):
        seconds = meter.once(lambda: work(part))
    return TimedRays(meter.repeated(lambda: work(part), seconds, memory), count, total)


def chunk_of(setting: Setting) -> int:
    """Rays that `SceneModel.render` takes at once."""
    device = next(setting.model.parameters()).device
    return max(1, render_points(device) // setting.model.field.points_a_ray(setting.samples))


def flops_a_ray(work: Callable[[Rays], object], rays: Rays) -> float:
    """Operations that a ray takes, counted on a few."""
    some = first(rays, COUNTED)
    return counted_flops(lambda: work(some)) / len(some.near)


def first(rays: Rays, count: int) -> Rays:
    """The first `count` of the rays."""
    return Rays(*(r[:count] for r in rays))


def eight_bit(colours: Tensor) -> Tensor:
    """Colours as uint8 on the host."""
    return colours.clamp(0, 1).mul_(255).round_().to(torch.uint8).cpu()
