"""Rendering: pixels a second of both fields beside the peak of this machine, and memory against the picture's size.

    python benchmarks/rendering.py [--rounds 5] [--seconds 3] [--out benchmarks/results/rendering.json]

Pixels/s of the paper's MLPs (`crnerf`) and of the hash grid (`crossray`) at 64 + 64 and at 256 + 256 samples a ray, and
of the hash grid at its own trained counts: on one thread and on all cores, in float32, in which pictures are judged; on
CUDA also in bfloat16 where a training would choose it. In turns: each round renders some whole chunks of rays of every
row, as many as --seconds are enough for, one at least, and takes the peak of a large matrix product beside them.
Operations are those of matrix products alone, counted: they are nearly all that the MLPs do, and a small part of what
the hash grid does, which mostly looks up table entries, so its share of the peak says little.

Memory: the most that rendering a whole picture takes by `pipeline.render.render_picture`, as an evaluation does it, at
the trained counts, each time in a process of its own, COPIES of each. Taken off is what comes out: features, depth,
accumulation and colours. The bar: from one size to the next what is left grows by no more than these arrays grow, but
for what COPIES differ by. That leaves room for the rays and for one copy, and none for a picture's samples. Pictures
are those of SIZES that hold at least two chunks of rays, for a smaller one does not fill a chunk's memory, and that
take no longer than --picture-seconds; the three smallest of them in any case. Exit status 1 if the bar is missed.

Weights are untrained (pipeline/timing_scene.py says why that moves no time).
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import statistics
import sys
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import torch
from rich.console import Console
from rich.table import Table

from model.fields.base import Rays
from pipeline.config import Job
from pipeline.files import atomic_write
from pipeline.launch.torchrun import pick_device
from pipeline.provenance import device_name, provenance
from pipeline.render import render_picture, view_rays
from pipeline.timing_inference import EVALUATED, Setting, chunk_of, first, flops_a_ray, settings
from pipeline.timing_job import TimingJob, make_timing, method_job, threads_of, with_precision
from pipeline.timing_measure import MIB, Meter, PeakMemory, Seconds, peak_flops, summarised
from pipeline.timing_scene import camera, reference_photo, untrained
from pipeline.train import set_up_torch, uses_bfloat16

METHODS = ("crnerf", "crossray")
SAMPLES = ((64, 64), EVALUATED)
SIZES = ((80, 60), (96, 72), (128, 96), (256, 192), (512, 384), (1024, 768))  # width, height
LEAST_SIZES, COPIES = 3, 3
VIEW = (512, 384)  # of whose rays some are timed


class Speed(NamedTuple):
    """A row of the first table."""

    setting: Setting
    threads: int
    rays: int  # in each round
    pixel: Seconds
    flops: float  # a pixel
    peak: float  # operations a second, median over the rounds

    @property
    def of_peak(self) -> float:
        """Share of the peak that the counted operations reach."""
        return self.flops / self.pixel.median / self.peak


class Memory(NamedTuple):
    """A row of the second table."""

    method: str
    size: tuple[int, int]  # width, height
    peaks: list[float]  # MiB
    out: float  # MiB of the arrays that come out

    @property
    def left(self) -> float:
        """MiB of the peak without what comes out."""
        return statistics.median(self.peaks) - self.out

    @property
    def spread(self) -> float:
        """MiB by which the same picture's peaks differ: a heap has holes, and not always the same ones."""
        return max(self.peaks) - min(self.peaks)


# ----------------------------------------------------------------------------------------------------------- speed


def rows_of(timing: TimingJob, device: torch.device) -> list[Setting]:
    """Both fields at both counts, and the hash field at its own."""
    found = []
    for method in METHODS:
        for trained in settings(timing, method, device, ("trained",)):
            counts = dict.fromkeys((*SAMPLES, trained.samples))
            found += [trained._replace(samples=samples) for samples in counts]
    return found


def in_bfloat16(timing: TimingJob, device: torch.device) -> list[Setting]:
    """The same in bfloat16, of methods that would be trained in it."""
    halves = timing.model_copy(update={"precision": ("bfloat16",)})
    return [s for s in rows_of(halves, device) if uses_bfloat16(with_precision(s.job, "auto"), device)]


def some_rays(setting: Setting, meter: Meter) -> Rays:
    """As many whole chunks of a view's rays as the meter's seconds are enough for, one at least."""
    view = view_rays(camera(0, VIEW[1], VIEW[0]), setting.model.spec.pixel_center, meter.device)
    chunk = chunk_of(setting)
    rendering = partial(setting.model.render, first(view, chunk), samples=setting.samples)
    rendering()  # warm
    return first(view, chunk * max(1, int(meter.seconds / meter.once(rendering))))


@torch.no_grad()
def speeds(rows: list[Setting], threads: list[int], meter: Meter, rounds: int) -> list[Speed]:
    """Every row on so many threads, in turns."""
    torch.set_num_threads(max(threads))
    rays = [some_rays(setting, meter) for setting in rows]
    flops = [flops_a_ray(partial(s.model.render, samples=s.samples), r) for s, r in zip(rows, rays, strict=True)]
    times: dict[tuple[int, int], list[float]] = {(n, i): [] for n in threads for i in range(len(rows))}
    peaks: dict[tuple[int, str], list[float]] = {(n, s.precision): [] for n in threads for s in rows}
    shortly = Meter(meter.device, 0.0)
    for _ in range(rounds):
        for count in threads:
            torch.set_num_threads(count)
            for precision in {s.precision for s in rows}:
                peaks[count, precision].append(peak_flops(shortly, precision))
            for i, (setting, some) in enumerate(zip(rows, rays, strict=True)):
                seconds = meter.once(partial(setting.model.render, some, samples=setting.samples))
                times[count, i].append(seconds / len(some.near))
    return [
        Speed(
            rows[i],
            count,
            len(rays[i].near),
            summarised(times[count, i], None),
            flops[i],
            statistics.median(peaks[count, rows[i].precision]),
        )
        for count, i in times
    ]


# ---------------------------------------------------------------------------------------------------------- memory


def memories(timing: TimingJob, found: list[Speed], device: torch.device, longest: float) -> list[Memory]:
    """Both methods at their sizes, each picture in a process of its own."""
    rows = []
    for method in METHODS:
        job = method_job(timing, method)
        for size in sizes(job, found, longest):
            peaks, outs = zip(*(apart(timing, method, size, device) for _ in range(COPIES)), strict=True)
            rows.append(Memory(method, size, list(peaks), outs[0]))
    return rows


def sizes(job: Job, found: list[Speed], longest: float) -> list[tuple[int, int]]:
    """The sizes at which a method's memory is measured: see the head of this file."""
    own = trained(job)
    of_method = [s for s in found if s.setting.job.method == job.method and s.setting.precision == "float32"]
    fastest = min((s for s in of_method if s.setting.samples == own), key=lambda s: s.pixel.median)
    least = 2 * chunk_of(fastest.setting)
    fitting = [size for size in SIZES if size[0] * size[1] >= least]
    return [
        (width, height)
        for place, (width, height) in enumerate(fitting)
        if place < LEAST_SIZES or width * height * fastest.pixel.median <= longest
    ]


def trained(job: Job) -> tuple[int, int]:
    """Samples a ray of a method's own recipe."""
    mlp, hashed = job.model.mlp, job.model.hash
    if job.model.field == "mlp":
        return mlp.coarse_samples, mlp.fine_samples
    return hashed.proposal_samples, hashed.samples


def apart(timing: TimingJob, method: str, size: tuple[int, int], device: torch.device) -> tuple[float, float]:
    """`picture_memory` in a new process: where an earlier picture has left holes in the heap, the next one would be
    measured with these holes."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(picture_memory, timing.model_dump(mode="json"), method, size, device).result()


@torch.no_grad()
def picture_memory(
    mapping: dict[str, Any], method: str, size: tuple[int, int], device: torch.device
) -> tuple[float, float]:
    """MiB at most while a picture (width, height) is rendered, above what was held before, and of what comes out."""
    timing = make_timing(mapping)
    job = method_job(timing, method)
    set_up_torch(job, device)
    model = untrained(job, device, False)
    appearance = model.encode([reference_photo(timing, device)])
    held = torch.cuda.memory_allocated(device) / MIB if device.type == "cuda" else 0.0
    memory = PeakMemory(device)
    view, picture = render_picture(model, camera(0, size[1], size[0]), appearance)
    peak = memory.peak()
    if peak is None:
        raise SystemExit("this system does not tell the peak of a process's memory")
    out = sum(x.nbytes for x in (view.features, view.depth, view.accumulation))
    on_host = picture.nbytes if device.type == "cpu" else 0  # of a GPU's memory it takes none
    return peak - held, (out + on_host) / MIB


def bars(rows: list[Memory]) -> list[dict[str, Any]]:
    """What was asked of each step from a size to the next, what was measured, and whether it is met."""
    found = []
    for small, large in pairwise(rows):
        if small.method == large.method:
            grown, allowed = large.left - small.left, large.out - small.out
            step = f"{small.size[0]} x {small.size[1]} to {large.size[0]} x {large.size[1]}"
            text = f"{small.method}, {step}: MiB that memory grows by beside what comes out"
            spread = max(small.spread, large.spread)
            wanted = f"<= {allowed:.1f} (+ {spread:.1f}, the spread of {COPIES} goes)"
            found.append({"bar": text, "measured": grown, "wanted": wanted, "met": grown <= allowed + spread})
    return found


# ------------------------------------------------------------------------------------------------------ the result


def table_of(found: list[Speed], rows: list[Memory]) -> Table:
    """Speed first, then memory."""
    table = Table(title="Rendering: pixels/s, then memory of whole pictures")
    for column in ("field", "what"):
        table.add_column(column, no_wrap=True)
    for column in ("pixels/s", "of peak", "TFLOP/s", "MiB", "out", "left"):
        table.add_column(column, justify="right", no_wrap=True)
    for s in found:
        name = s.setting.job.method + (", bfloat16" if s.setting.precision == "bfloat16" else "")
        what = f"{s.setting.samples[0]} + {s.setting.samples[1]}, {s.threads} thread{'s' if s.threads > 1 else ''}"
        speed = f"{1 / s.pixel.median:,.0f}", f"{s.of_peak:.0%}", f"{s.flops / s.pixel.median / 1e12:.3f}"
        table.add_row(name, what, *speed)
    table.add_section()
    for m in rows:
        numbers = f"{statistics.median(m.peaks):.1f}", f"{m.out:.1f}", f"{m.left:.1f}"
        table.add_row(m.method, f"{m.size[0]} x {m.size[1]} pixels", "", "", "", *numbers)
    return table


def as_record(s: Speed) -> dict[str, Any]:
    """What results/rendering.json says of a row of the first table; seconds, operations."""
    pixel = {"median": s.pixel.median, "low": s.pixel.low, "high": s.pixel.high, "rounds": s.pixel.repeats}
    names = {"method": s.setting.job.method, "precision": s.setting.precision, "samples": list(s.setting.samples)}
    speed = {"pixels_per_second": 1 / s.pixel.median, "flops_a_pixel": s.flops, "peak_flops": s.peak}
    return {**names, "threads": s.threads, "rays_a_round": s.rays, "pixel": pixel, **speed, "of_peak": s.of_peak}


def main() -> None:
    """Measure, print, record."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument(
        "--seconds", type=float, default=3.0, help="of a row in a round; a chunk is rendered in any case"
    )
    parser.add_argument("--picture-seconds", type=float, default=90.0, help="that a larger picture may take")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    where = provenance()
    timing = make_timing({"what": ["inference"]})
    job = method_job(timing, METHODS[0])
    device = pick_device(job, 0)
    set_up_torch(job, device)
    cuda = device.type == "cuda"
    threads = [threads_of(timing)] if cuda else sorted({1, threads_of(timing)})
    rows = rows_of(timing, device) + (in_bfloat16(timing, device) if cuda else [])
    found = speeds(rows, threads, Meter(device, options.seconds), options.rounds)
    held = memories(timing, found, device, options.picture_seconds)
    judged = bars(held)
    Console(width=100).print(table_of(found, held))  # a pipe has no width of its own, and 80 cut numbers off
    for bar in judged:
        text = f"{bar['bar']}: {bar['measured']:.1f}, wanted {bar['wanted']}: {'met' if bar['met'] else 'MISSED'}"
        print(text)
    if options.out:
        memory = [m._asdict() | {"left": m.left, "spread": m.spread} for m in held]
        record = {
            "bars": judged,
            "device": device_name(device),
            "speed": [as_record(s) for s in found],
            "memory_MiB": memory,
            "provenance": where,
        }
        atomic_write(options.out, json.dumps(record, indent=1) + "\n")
    sys.exit(0 if all(bar["met"] for bar in judged) else 1)


if __name__ == "__main__":
    main()
