"""Seconds a training step in float32 and in bfloat16, for both fields, side by side on random rays.

    python benchmarks/precision.py [--threads 1] [--repeats 9] [--out benchmarks/results/precision.json]

The faithful field sees 1,024 rays of one photo, the fast one 4 patches of 12 x 12, as their recipes say.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from pathlib import Path

import torch

from model.fields.base import Rays
from model.scene_model import Batch, SceneModel
from pipeline.config import make_job
from pipeline.files import atomic_write
from pipeline.provenance import provenance

METHODS = ("crnerf", "crossray")


def random_batch(patches: int, size: int, device: torch.device) -> Batch:
    """Rays through a unit box, random colours and photos."""
    n = patches * size * size
    directions = torch.nn.functional.normalize(torch.randn(n, 3), dim=-1)
    photos = [torch.rand(3, 85, 128, device=device) for _ in range(patches)]
    rays = Rays(torch.zeros(n, 3), directions, torch.full((n,), 0.1), torch.full((n,), 5.0))
    return Batch(
        Rays(*(r.to(device) for r in rays)),
        torch.rand(patches, size * size, 3, device=device),
        torch.rand(patches, size * size, 2, device=device),
        torch.arange(patches, device=device),
        photos,
        photos,
    )


def seconds_a_step(method: str, bfloat16: bool, repeats: int, device: torch.device) -> list[float]:
    """Forward and backward, `repeats` times after one that does not count."""
    job = make_job({"name": "benchmark", "method": method, "scene": {"path": "."}})
    torch.manual_seed(0)
    model = SceneModel(job.model, torch.tensor([[-1.0] * 3, [1.0] * 3]), job.patch.photos).to(device)
    model.use_bfloat16 = bfloat16
    batch = random_batch(job.patch.photos, job.patch.size, device)
    times = []
    for repeat in range(repeats + 1):
        generator = torch.Generator(device).manual_seed(repeat)
        began = time.perf_counter()
        terms, _ = model(batch, repeat, generator, job.losses)
        torch.stack(list(terms.values())).sum().backward()
        if device.type == "cuda":
            torch.cuda.synchronize()
        times.append(time.perf_counter() - began)
        model.zero_grad(set_to_none=True)
    return times[1:]


def main() -> None:
    """Measure, print, record."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    rows = []
    print("| method | precision | median s/step | min | max |\n|---|---|---|---|---|")
    for method in METHODS:
        repeats = options.repeats if method == "crossray" or device.type == "cuda" else max(1, options.repeats // 3)
        for name, bfloat16 in (("float32", False), ("bfloat16", True)):
            times = seconds_a_step(method, bfloat16, repeats, device)
            rows.append({"method": method, "precision": name, "seconds": times})
            middle = statistics.median(times)
            print(f"| {method} | {name} | {middle:.3f} | {min(times):.3f} | {max(times):.3f} |", flush=True)
    if options.out:
        device_label = torch.cuda.get_device_name() if device.type == "cuda" else "cpu"
        record = {"provenance": provenance(), "device": device_label, "threads": options.threads, "rows": rows}
        atomic_write(options.out, json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()
