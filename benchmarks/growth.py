"""How the fast preset's training step grows: with photos, ranks, rays and the size of the photos.

    python benchmarks/growth.py [--rounds 7] [--out benchmarks/results/growth.json]

(a) 50, 500 and 5,000 training photos: the slowest step within 10 % of the fastest.
(b) 2 ranks against 1: at least 1.9 times the patches a second. Beside it what the machine itself allows: two trainings
    side by side that know nothing of each other share its memory bus, and maybe a core, as two ranks do.
(c) 400 to 1,600 rays a step: seconds a step and microseconds a ray; no bar.
(d) Photos at R/8, R/4 and R/2: as (a), for a step reads patches, not photos.

The step is that of `pipeline.train`, with its batch, losses, backward pass and optimiser, in float32, 4 patches of
12 x 12 rays of 500 photos at R/2 unless a row says otherwise. One thread a rank; (a), (c) and (d) on CUDA where there
is a GPU, (b) where there are two. Photos are noise, and beyond 64 they share their pixels: of 5,000 photos the cameras,
the index and the order of visits are all there, which is what a step could slow down with, but not 3 GB of pixels, so
that rows of photos which are in no cache of the processor are read a little faster than in a real collection.

In turns: each round takes STEPS steps of every setting; of each, median and quartiles over the rounds. The two ranks
are processes that the project's own launcher starts, and take their turns alone, side by side and together (DDP, gloo
on CPUs) in the same two processes; who has no turn sleeps. Of two processes the slower one counts. Exit status 1 if a
bar is missed.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from rich.console import Console
from rich.table import Table

from pipeline.config import Job
from pipeline.files import atomic_write
from pipeline.launch.local import start_ranks
from pipeline.launch.torchrun import pick_device, run_rank
from pipeline.log import set_up_logging
from pipeline.provenance import device_name, provenance
from pipeline.timing_job import TimingJob, make_timing, method_job, training_job, with_precision
from pipeline.timing_measure import Meter, Seconds, summarised
from pipeline.timing_scene import synthetic_photos
from pipeline.timing_training import Steps
from pipeline.together import Together
from pipeline.work import Context

METHOD = "crossray"
STEPS = 10  # a turn
PHOTOS, DOWNSCALE = 500, 2  # where a row does not say otherwise
COUNTS, RAYS, DOWNSCALES = (50, 500, 5000), (400, 576, 784, 1024, 1600), (8, 4, 2)
ALONE, BESIDE, TOGETHER = "1 rank", "2 side by side", "2 ranks"
FLAT, FASTER = 1.10, 1.9  # the bars


class Size(NamedTuple):
    """What a step depends on, or should not."""

    photos: int
    downscale: int
    rays: int


class Row(NamedTuple):
    """A line of the table."""

    part: str  # (a) to (d)
    setting: str
    size: Size
    ranks: int  # processes that train
    patches: int  # a rank and step
    step: Seconds

    @property
    def patches_per_second(self) -> float:
        """Of all ranks."""
        return self.ranks * self.patches / self.step.median

    @property
    def ray_seconds(self) -> float:
        """Of a rank's step, per ray."""
        return self.step.median / self.size.rays


# --------------------------------------------------------------------------------------------------- one process


def recipe(timing: TimingJob) -> Size:
    """The step as the preset has it."""
    patch = method_job(timing, METHOD).patch
    return Size(PHOTOS, DOWNSCALE, patch.photos * patch.size**2)


def sizes(timing: TimingJob) -> list[tuple[str, str, Size]]:
    """The rows of one process: part, what it is called, and its size. Some sizes are in several parts."""
    usual = recipe(timing)
    return [
        *(("(a)", f"{n:,} photos", usual._replace(photos=n)) for n in COUNTS),
        *(("(c)", f"{n:,} rays", usual._replace(rays=n)) for n in RAYS),
        *(("(d)", f"R/{n}", usual._replace(downscale=n)) for n in DOWNSCALES),
    ]


def job_of(timing: TimingJob, size: Size) -> Job:
    """The training of a size, in float32."""
    return with_precision(training_job(timing, METHOD, size.rays), "float32")


def steps_of(timing: TimingJob, size: Size, context: Context) -> Steps:
    """A training of a size, with two turns behind it."""
    steps = Steps(job_of(timing, size), synthetic_photos(timing, size.photos, size.downscale), context)
    steps.run(2 * STEPS)
    return steps


def one_process(timing: TimingJob, rounds: int, device: torch.device) -> list[Row]:
    """(a), (c) and (d)."""
    rows, meter = sizes(timing), Meter(device, 0.0)
    trainings = {size: steps_of(timing, size, Context(device=device)) for _, _, size in rows}
    times: dict[Size, list[float]] = {size: [] for size in trainings}
    for _ in range(rounds):
        for size, steps in trainings.items():
            times[size].append(meter.once(partial(steps.run, STEPS)) / STEPS)
    patches = method_job(timing, METHOD).patch.photos
    return [Row(part, name, size, 1, patches, summarised(times[size], None)) for part, name, size in rows]


# ------------------------------------------------------------------------------------------------- two processes


def two_processes(timing: TimingJob, rounds: int) -> list[Row]:
    """(b)."""
    job, size = method_job(timing, METHOD), recipe(timing)
    times = start_ranks(job, as_rank, timing.model_dump(mode="json"), rounds)[0]
    ranks = {ALONE: 1, BESIDE: 2, TOGETHER: 2}
    return [Row("(b)", name, size, n, job.patch.photos, summarised(times[name], None)) for name, n in ranks.items()]


def as_rank(mapping: dict[str, Any], rounds: int) -> dict[str, list[float]]:
    """Entry point of a rank: seconds a step of each kind of turn, a number each round."""
    set_up_logging()
    timing = make_timing(mapping)
    return run_rank(method_job(timing, METHOD), lambda _, context: turns(timing, rounds, context))


def turns(timing: TimingJob, rounds: int, context: Context) -> dict[str, list[float]]:
    """The turns of a rank, alone, beside the other, and together with it."""
    size, meter, together = recipe(timing), Meter(context.device, 0.0), Together(context)
    own, shared = (steps_of(timing, size, c) for c in (Context(device=context.device), context))
    idle = context.rank != 0
    kinds: dict[str, Callable[[], None]] = {
        ALONE: (lambda: None) if idle else lambda: own.run(STEPS),
        BESIDE: lambda: own.run(STEPS),
        TOGETHER: lambda: shared.run(STEPS),
    }
    times: dict[str, list[float]] = {kind: [] for kind in kinds}
    for _ in range(rounds):
        for kind, run in kinds.items():
            together.numbers()  # all are here
            times[kind].append(float(together.numbers(meter.once(run) / STEPS).max()))
    return times


# ----------------------------------------------------------------------------------------------------- the result


def bars(rows: list[Row]) -> list[dict[str, Any]]:
    """What was asked, what was measured, and whether it is met."""
    found = []
    for part, what in (("(a)", "photos"), ("(d)", "size of the photos")):
        medians = [row.step.median for row in rows if row.part == part]
        ratio = max(medians) / min(medians)
        text = f"{part} step time against {what}: slowest / fastest"
        found.append({"bar": text, "measured": ratio, "wanted": f"<= {FLAT:.2f}", "met": ratio <= FLAT})
    speed = {row.setting: row.patches_per_second for row in rows if row.part == "(b)"}
    ratio, allowed = speed[TOGETHER] / speed[ALONE], speed[BESIDE] / speed[ALONE]
    text = f"(b) patches/s of 2 ranks / of 1 (side by side, untied: {allowed:.2f})"
    return [*found, {"bar": text, "measured": ratio, "wanted": f">= {FASTER:.2f}", "met": ratio >= FASTER}]


def table_of(rows: list[Row]) -> Table:
    """All rows."""
    table = Table(title=f"A training step of {METHOD}, float32, one thread a rank")
    for column in ("part", "setting", "ms/step", "quartiles", "us/ray", "patches/s"):
        table.add_column(column, justify="left" if column in ("part", "setting") else "right")
    for row in rows:
        low, middle, high = (f"{1e3 * s:.2f}" for s in (row.step.low, row.step.median, row.step.high))
        numbers = f"{1e6 * row.ray_seconds:.1f}", f"{row.patches_per_second:.1f}"
        table.add_row(row.part, row.setting, middle, f"{low} to {high}", *numbers)
    return table


def as_record(row: Row) -> dict[str, Any]:
    """What results/growth.json says of a row; seconds."""
    size = {"photos": row.size.photos, "downscale": row.size.downscale, "rays": row.size.rays}
    names = {"part": row.part, "setting": row.setting, "ranks": row.ranks, **size}
    step = {"median": row.step.median, "low": row.step.low, "high": row.step.high, "rounds": row.step.repeats}
    return {**names, "step": step, "ray": row.ray_seconds, "patches_per_second": row.patches_per_second}


def main() -> None:
    """Measure, print, record."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    where = provenance()
    set_up_logging()
    common = {"threads": 1, "what": ["training"]}
    timing = make_timing(common)
    device = pick_device(method_job(timing, METHOD), 0)
    # Two ranks need a GPU each, else they share this machine's processor.
    pair = make_timing(
        common | {"device": "cuda" if torch.cuda.device_count() > 1 else "cpu", "training": {"ranks": 2}}
    )
    rows = [*two_processes(pair, options.rounds), *one_process(timing, options.rounds, device)]
    rows.sort(key=lambda row: row.part)
    found = bars(rows)
    Console().print(table_of(rows))
    for bar in found:
        text = f"{bar['bar']}: {bar['measured']:.3f}, wanted {bar['wanted']}: {'met' if bar['met'] else 'MISSED'}"
        print(text)
    if options.out:
        devices = {"one process": device_name(device), "two": device_name(pick_device(method_job(pair, METHOD), 0))}
        record = {
            "bars": found,
            "steps_a_turn": STEPS,
            "devices": devices,
            "rows": [as_record(row) for row in rows],
            "provenance": where,
        }
        atomic_write(options.out, json.dumps(record, indent=1) + "\n")
    sys.exit(0 if all(bar["met"] for bar in found) else 1)


if __name__ == "__main__":
    main()
