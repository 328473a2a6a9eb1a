"""Whose content statistics should a view be coloured with? Flicker along a camera path, and PSNR, by policy.

    python benchmarks/flicker.py RUN [RUN ...] [--frames 40] [--side 96] [--out benchmarks/results/flicker.json]

RUNs are trained cross-ray models of one built-in landmark: here four of 90 s on one core, `crossray` with three seeds
and with the closed-form transform:

    crossray landmark landmark --train 96 --val 8 --test 8 --size 128
    crossray run job.yaml [--set patch.seed=1 | --set patch.seed=2 | --set model.transform=closed_form] --set name=...

with this job.yaml:

    {name: crossray, method: crossray, scene: {path: landmark, downscale: 1, reference_downscale: 1}, device: cpu,
     train: {seconds: 90}}

Flicker is measured in the appearances of three test photos (pipeline/flicker.py). PSNR is over all test photos, the
same rendering coloured by each policy, and compared with `view` photo by photo: of each run, and of the means over the
runs of a transform and over all runs, which have the same photos.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch

from model.methods import StatisticsPolicy
from pipeline.bootstrap import paired_interval
from pipeline.checkpoint import MODEL
from pipeline.files import atomic_write
from pipeline.flicker import flicker, true_drift, walk
from pipeline.judge import Judge, Shared
from pipeline.metrics import to_8bit
from pipeline.protocol import parse_protocol
from pipeline.provenance import provenance
from pipeline.runs import load_run, photos_of
from pipeline.truth import truth_of

PROTOCOLS = ("crnerf-full@R1", "cross@R1")
APPEARANCES = 3  # test photos in whose appearances flicker is measured
POLICIES: tuple[StatisticsPolicy, ...] = get_args(StatisticsPolicy)


def psnr_by_policy(judge: Judge, indices: tuple[int, ...]) -> dict[str, list[float]]:
    """PSNR of each photo by each policy, from one rendering, which the judge keeps."""
    found: dict[str, list[float]] = {policy: [] for policy in POLICIES}
    for index in indices:
        for policy in POLICIES:
            judge.model.spec = replace(judge.model.spec, statistics=policy)
            picture = to_8bit(judge.render(index).picture, judge.protocol.rounding)
            found[policy].append(judge.score(picture, index, None)["psnr"])
    return found


def measured(run: Path, frames: int, side: int) -> dict[str, Any]:
    """Flicker and PSNR of a run by policy, and the flicker of its truth."""
    job, model, checkpoint = load_run(run)
    photos = photos_of(job, checkpoint)
    landmark, path = truth_of(job, photos), walk(frames, side)
    names = landmark.names("test")[:APPEARANCES]
    drifts, shared = flicker(model, photos, path, names), Shared()
    test = photos.indices("test")
    judges = {name: Judge(model, photos, parse_protocol(name)[0], landmark, shared) for name in PROTOCOLS}
    return {
        "run": run.name,
        "method": job.method,
        "transform": job.model.transform,
        "seed": job.patch.seed,
        "seconds": job.train.seconds,
        "step": checkpoint.step,
        "checkpoint_sha256": checkpoint.meta["sha256"][MODEL],
        "truth": true_drift(landmark, path, names)._asdict(),
        "flicker": {policy: drift._asdict() for policy, drift in drifts.items()},
        "psnr": {name: psnr_by_policy(judge, test) for name, judge in judges.items()},
    }


def compared(rows: list[dict[str, Any]], protocol: str, policy: str) -> dict[str, Any]:
    """A policy's PSNR less that of `view`, over the photos: of each the mean over some runs."""
    a, b = (np.mean([row["psnr"][protocol][p] for row in rows], axis=0).tolist() for p in (policy, "view"))
    return {"difference": float(np.mean(np.subtract(a, b))), "interval": paired_interval(a, b)}


def main() -> None:
    """Measure, print, record."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--side", type=int, default=96)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/flicker.json"))
    options = parser.parse_args()
    where = provenance()
    torch.set_num_threads(1)
    rows = []
    print("| run | policy | frame | point | statistics | " + " | ".join(f"PSNR {p}" for p in PROTOCOLS) + " |")
    print("|---" * (5 + len(PROTOCOLS)) + "|")
    for run in options.runs:
        row = measured(run, options.frames, options.side)
        rows.append(row)
        for policy, numbers in {**row["flicker"], "truth": row["truth"]}.items():
            psnr = [f"{np.mean(row['psnr'][p][policy]):.2f}" if policy != "truth" else "" for p in PROTOCOLS]
            cells = [run.name, policy, *(f"{x:.2f}" for x in numbers.values()), *psnr]
            print("| " + " | ".join(cells) + " |", flush=True)
    transforms = {row["transform"]: [r for r in rows if r["transform"] == row["transform"]] for row in rows}
    groups = {row["run"]: [row] for row in rows} | {f"all {t}": of for t, of in transforms.items()} | {"all": rows}
    against = {
        protocol: {policy: {name: compared(group, protocol, policy) for name, group in groups.items()}
                   for policy in POLICIES if policy != "view"}
        for protocol in PROTOCOLS
    }  # fmt: skip
    for protocol, policies in against.items():
        for policy, groups_of in policies.items():
            for name, found in groups_of.items():
                print(f"{protocol}, {name}: {policy} - view {found['difference']:+.3f} dB, {found['interval']}")
    record = {
        "format": 1,
        "frames": options.frames,
        "side": options.side,
        "appearances": APPEARANCES,
        "runs": rows,
        "psnr_less_view": against,
        "provenance": where,
    }
    atomic_write(options.out, json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()
