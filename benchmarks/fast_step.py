"""Where the time of a fast training step goes, each part against what the arithmetic or the memory allows.

    python benchmarks/fast_step.py [--seconds 2] [--out benchmarks/results/fast-step.json]

A step of `crossray` as its recipe says (4 patches of 12 x 12 rays, 32 + 16 samples), float32, on one thread of a CPU or
on the GPU that is there. Each part is taken alone, forward and backward, on what it meets in a step. Its limit is the
larger of two: its matrix products and convolutions at the rate of a large matrix product, and the bytes that it has to
move at the rate of a large copy. These bytes are: of a grid, each corner's table entry, read forward, read and written
backward; of the optimiser, each parameter, its gradient and two averages. Others are counted as none.

The aim is a step of 25 ms. Exit status 1 if it is missed.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from model.fields.base import points
from model.fields.hash import HashField, uniform_edges
from model.fields.hashgrid import HashEncoding
from pipeline.files import atomic_write
from pipeline.provenance import device_name, provenance
from pipeline.timing_job import make_timing, training_job, with_precision
from pipeline.timing_measure import Meter, counted_flops, peak_flops
from pipeline.timing_scene import synthetic_photos
from pipeline.timing_training import Steps
from pipeline.train import gradient_norm
from pipeline.work import Context

AIM = 0.025  # seconds a step
PHOTOS = 144
COPIED = 2**26  # bytes of the copy that tells how fast memory is
DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")


class Part(NamedTuple):
    """What is timed alone."""

    name: str
    action: Callable[[], object]
    bytes: float = 0


def main() -> None:
    """Measure, print, record."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=2.0, help="of a part's repeats")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    where = provenance()
    timing = make_timing({"threads": 1, "training": {"rays": 576}})
    job = with_precision(training_job(timing, "crossray"), "float32")
    meter = Meter(DEVICE, options.seconds)
    steps = Steps(job, synthetic_photos(timing, PHOTOS), Context(device=DEVICE))
    flops, bandwidth = peak_flops(meter, "float32"), copied_a_second(meter)
    print(f"{flops / 1e9:.0f} GFLOP/s in a matrix product, {bandwidth / 1e9:.1f} GB/s in a copy\n")
    print(
        "| part | ms | share | limit by arithmetic [ms] | by memory [ms] | times the limit |\n|---|---|---|---|---|---|"
    )
    step = meter.measure(lambda: steps.run(1)).median
    rows = [measured(part, meter, flops, bandwidth) for part in parts_of(steps)]
    march = next(row for row in rows if row["part"] == WHOLE_MARCH)
    inside = sum(row["seconds"] for row in rows if row["part"] in INSIDE_MARCH)
    march |= {"part": "sampling, weights, compositing", "seconds": march["seconds"] - inside, "flops": 0.0}
    march |= {"by_arithmetic": 0.0}
    rest = step - sum(row["seconds"] for row in rows)
    rows.append(
        {"part": "all else: losses, autograd, bookkeeping", "seconds": rest, "by_arithmetic": 0, "by_memory": 0}
    )
    for row in rows:
        print(line(row, step))
    print(f"| **a step** | **{1e3 * step:.1f}** | | | | aim {1e3 * AIM:.0f} ms: {'met' if step <= AIM else 'MISSED'} |")
    if options.out:
        record = {"step_seconds": step, "aim_seconds": AIM, "parts": rows, "peak_flops": flops, "bandwidth": bandwidth}
        record |= {"device": device_name(DEVICE), "threads": 1, "precision": "float32", "provenance": where}
        atomic_write(options.out, json.dumps(record, indent=1) + "\n")
    sys.exit(0 if step <= AIM else 1)


WHOLE_MARCH = "the field along its rays"
INSIDE_MARCH = ("proposal's grid", "field's grid", "networks at points")


def parts_of(steps: Steps) -> list[Part]:
    """The parts of a step, on what the first one meets."""
    work, model, field = steps.work, steps.model, steps.model.field
    assert isinstance(field, HashField)
    batch, seed = work.batch(0), work.generator
    rays, spec = batch.rays, field.spec
    placed = field.place(rays, seed(0))
    edges = uniform_edges(rays.near, rays.far, spec.proposal_samples, seed(0))
    coarse = field.contract(points(rays, 0.5 * (edges[:, 1:] + edges[:, :-1]))).flatten(0, -2)
    fine = field.contract(points(rays, placed.t)).flatten(0, -2)
    seen = [x.detach().requires_grad_() for x in (field.proposal_grid(coarse), field.grid(fine))]
    features = model.seen(field.march(rays, seed(0)).levels[-1], batch).features.detach().requires_grad_()
    parameters = [p for p in model.parameters() if p.requires_grad]

    def whole_march() -> None:
        march = field.march(rays, seed(0))
        back(model.seen(march.levels[-1], batch).features.sum() + march.losses["interlevel"])

    def appearance() -> None:
        F = model.appearances(batch)
        content = model.transform.content_statistics(features)  # type: ignore[union-attr]
        back(model.colours(features, F, content))

    def optimise() -> None:
        for p in parameters:
            p.grad = torch.zeros_like(p) if p.grad is None else p.grad
        gradient_norm(steps.optimiser)
        steps.optimiser.step()

    return [
        Part("batch: pixels, rays, references", lambda: work.batch(1)),
        Part(INSIDE_MARCH[0], lambda: back(field.proposal_grid(coarse)), looked_up(field.proposal_grid, coarse)),
        Part(INSIDE_MARCH[1], lambda: back(field.grid(fine)), looked_up(field.grid, fine)),
        Part(INSIDE_MARCH[2], lambda: back(field.proposal(seen[0]).sum() + field.trunk(seen[1]).sum())),
        Part(WHOLE_MARCH, whole_march),
        Part("appearance: encoder, transform, decoder", appearance),
        Part("segmenter", lambda: back(model.masks(batch))),
        Part("optimiser", optimise, 28.0 * sum(p.numel() for p in parameters)),
    ]


def back(x: Tensor | None) -> None:
    """The backward pass of a sum."""
    assert x is not None
    x.sum().backward()


def looked_up(grid: HashEncoding, x: Tensor) -> float:
    """Bytes of the table entries that points (N, 3) read forward, and read and write backward."""
    return 3.0 * 8 * len(x) * grid.out_channels * 4


def measured(part: Part, meter: Meter, flops: float, bandwidth: float) -> dict[str, Any]:
    """A part's row."""
    counted = counted_flops(part.action)
    seconds = meter.measure(part.action)
    return {
        "part": part.name,
        "seconds": seconds.median,
        "low": seconds.low,
        "high": seconds.high,
        "repeats": seconds.repeats,
        "flops": counted,
        "bytes": part.bytes,
        "by_arithmetic": counted / flops,
        "by_memory": part.bytes / bandwidth,
    }


def copied_a_second(meter: Meter) -> float:
    """Bytes a second that a large copy reads and writes."""
    a = torch.zeros(COPIED, dtype=torch.uint8, device=meter.device)
    b = torch.ones_like(a)
    return 2 * COPIED / meter.measure(lambda: a.copy_(b)).median


def line(row: dict[str, Any], step: float) -> str:
    """A row of the table."""
    limit = max(row["by_arithmetic"], row["by_memory"])
    times = f"{row['seconds'] / limit:.1f}" if limit else ""
    limits = " | ".join(f"{1e3 * x:.2f}" if x else "" for x in (row["by_arithmetic"], row["by_memory"]))
    return f"| {row['part']} | {1e3 * row['seconds']:.1f} | {row['seconds'] / step:.0%} | {limits} | {times} |"


if __name__ == "__main__":
    main()
