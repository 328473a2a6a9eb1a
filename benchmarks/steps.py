"""The faithful training step against this machine's limit: FLOP/s achieved beside the peak measured in the same run.

    python benchmarks/steps.py [--seconds 40] [--out benchmarks/results/steps.json]

A step of `crnerf` (32 x 32 rays, 64 + 64 samples, with losses, backward pass and optimiser) on one thread of a CPU, or
on the GPU that is there. The limit is the step's matrix products and convolutions at the rate of one large matrix
product. Bars, on a CPU: at most 1.3 times the limit in float32, 2 times in bfloat16, and no more memory than the 3.1 GB
that the released code takes.

What stands between is mostly memory that the system hands out page by page; a row without the blocks of points that
stay in the cache (`model.fields.base.in_blocks`) shows how much. Each row is a process of its own, which measures the
peak before and after its steps. Exit status 1 if a bar is missed.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from model.fields import base
from pipeline.files import atomic_write
from pipeline.provenance import device_name, provenance
from pipeline.timing_job import make_timing, training_job, with_precision
from pipeline.timing_measure import MIB, Meter, peak_flops, resident
from pipeline.timing_scene import synthetic_photos
from pipeline.timing_training import Steps
from pipeline.work import Context

BARS = {"float32": 1.3, "bfloat16": 2.0}  # times the limit
MEMORY = 3.1e9  # bytes
PHOTOS = 64
WAYS = ("as it is", "all points at once")
DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")


def main() -> None:
    """Measure, print, record."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=40.0, help="of the steps of a row; three are made in any case")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--one", nargs=2, metavar=("PRECISION", "WAY"), help="measure one row and print it as JSON")
    options = parser.parse_args()
    if options.one:
        print(json.dumps(measured(*options.one, options.seconds)))
        return
    where = provenance()
    print("| precision | way | seconds a step | peak [GFLOP/s] | limit [s] | times the limit | memory [GB] | |")
    print("|---|---|---|---|---|---|---|---|")
    rows = []
    for precision in BARS:
        for way in WAYS if DEVICE.type == "cpu" else WAYS[:1]:
            row = in_a_process(precision, way, options.seconds)
            rows.append(row)
            print(line(row), flush=True)
    if options.out:
        atomic_write(options.out, json.dumps({"rows": rows, "bars": BARS, "provenance": where}, indent=1) + "\n")
    sys.exit(1 if any(row["met"] is False for row in rows) else 0)


def in_a_process(precision: str, way: str, seconds: float) -> dict[str, Any]:
    """A row, measured where nothing was before."""
    command = [sys.executable, __file__, "--seconds", str(seconds), "--one", precision, way]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def measured(precision: str, way: str, seconds: float) -> dict[str, Any]:
    """A row: the step in one precision, in one of WAYS."""
    if way == "all points at once":
        base.BLOCK_POINTS = 2**60
    timing = make_timing({"threads": 1, "training": {"photos": PHOTOS}})
    job = with_precision(training_job(timing, "crnerf"), precision)
    meter = Meter(DEVICE, seconds)
    torch.set_num_threads(1)
    brief = replace(meter, seconds=3.0)
    peaks = [peak_flops(brief, precision)]
    steps = Steps(job, synthetic_photos(timing, PHOTOS), Context(device=DEVICE))
    flops = steps.flops()
    step = meter.measure(lambda: steps.run(1))
    cuda = DEVICE.type == "cuda"
    memory = torch.cuda.max_memory_allocated(DEVICE) if cuda else resident("VmHWM")
    peaks.append(peak_flops(brief, precision))
    limit = flops / max(peaks)
    ratio = step.median / limit
    met = None
    if not cuda and way == WAYS[0]:
        met = ratio <= BARS[precision] and memory <= MEMORY
    return {
        "method": job.method,
        "precision": precision,
        "way": way,
        "rays": job.patch.photos * job.patch.size**2,
        "seconds": step.median,
        "low": step.low,
        "high": step.high,
        "repeats": step.repeats,
        "flops": flops,
        "peak_flops": peaks,
        "limit_seconds": limit,
        "ratio": ratio,
        "memory_MiB": memory / MIB,
        "met": met,
        "device": device_name(DEVICE),
    }


def line(row: dict[str, Any]) -> str:
    """A row of the table."""
    verdict = {True: "met", False: "MISSED", None: ""}[row["met"]]
    return (
        f"| {row['precision']} | {row['way']} | {row['seconds']:.2f} | {max(row['peak_flops']) / 1e9:.0f} | "
        f"{row['limit_seconds']:.2f} | {row['ratio']:.2f} | {row['memory_MiB'] * MIB / 1e9:.2f} | {verdict} |"
    )


if __name__ == "__main__":
    main()
