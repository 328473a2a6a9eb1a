"""How long the fast preset takes to reach what the faithful one reaches: the best validation PSNR of `crnerf` in an
hour of one core's time, against `crossray` in a fiftieth of that.

    python benchmarks/race.py [--minutes 60] [--ranks 1] [--out benchmarks/results/race.json]

The scene is the quick start's landmark (144 training photos, 128 pixels). Ranks have one thread each and share the
minutes: with two of them each run takes half as long. The faithful one has the precision that suits this machine
(bfloat16 where it computes with it). Their checkpoints are then scored on the 8 validation photos against the clean
truth, the appearance read from the whole photo; samples a ray as in training. The seconds are those of the training
loop, as training.json has them; evaluation is not counted.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pipeline.checkpoint import MODEL, committed
from pipeline.files import atomic_write
from pipeline.landmark import Landmark
from pipeline.metrics import psnr, to_8bit
from pipeline.photos import open_photos
from pipeline.provenance import provenance
from pipeline.render import read_appearance, render_picture
from pipeline.runs import checkpoint_of, load_run

SHARE = 50  # the fast preset gets one of so many parts of the time
CHECKPOINTS = 4  # of each run, spread over it
PHOTOS = ["--train", "144", "--val", "8", "--test", "8", "--size", "128"]


def crossray(folder: Path, *words: object) -> None:
    """A command as a process of its own, one thread."""
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    subprocess.run([sys.executable, "-m", "pipeline", *map(str, words)], cwd=folder, env=environment, check=True)


def train(folder: Path, method: str, seconds: float, ranks: int, checkpoint_every: int) -> dict[str, Any]:
    """A run of so many seconds; what training.json says of it."""
    job = {
        "name": method,
        "method": method,
        "scene": {"path": "landmark", "downscale": 1, "reference_downscale": 1},
        "device": "cpu",
        "ranks": ranks,
        "train": {
            "seconds": seconds,
            "checkpoint_every": checkpoint_every,
            "keep_checkpoints": 1000,
            "picture_every": 10**9,
        },
    }
    (folder / f"{method}.yaml").write_text(json.dumps(job))  # JSON is YAML
    crossray(folder, "run", f"{method}.yaml")
    return json.loads((folder / "runs" / method / "training.json").read_text())


def validation_psnr(folder: Path, method: str, step: int) -> list[float]:
    """PSNR of each validation photo's view against the clean truth."""
    job, model, _ = load_run(folder / "runs" / method, step)
    photos, landmark = open_photos(folder / job.shards), Landmark.read(folder / "landmark")
    scores = []
    for index in photos.indices("val"):
        name = photos.records[index].name
        appearance = read_appearance(model, photos.reference(index))
        _, picture = render_picture(model, photos.records[index], appearance)
        scores.append(psnr(to_8bit(picture, "round"), landmark.truth(name, name)))
    return scores


def measured(folder: Path, method: str, seconds: float, ranks: int, checkpoint_every: int) -> dict[str, Any]:
    """A run of so many seconds, and the scores of its checkpoints."""
    training = train(folder, method, seconds, ranks, checkpoint_every)
    steps = [int(p.name.removeprefix("step-")) for p in committed(folder / "runs" / method / "checkpoints")]
    chosen = sorted({steps[round(i)] for i in np.linspace(0, len(steps) - 1, CHECKPOINTS + 1)[1:]})
    scores = {step: validation_psnr(folder, method, step) for step in chosen}
    best = max(scores, key=lambda step: np.mean(scores[step]))
    return {
        "seconds": seconds,
        "training": training,
        "psnr": {step: float(np.mean(values)) for step, values in scores.items()},
        "best_step": best,
        "checkpoint_sha256": checkpoint_of(folder / "runs" / method, best).meta["sha256"][MODEL],
        "best_psnr": float(np.mean(scores[best])),
        "images": scores[best],
    }


def main() -> None:
    """Run both, print the table, record."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--ranks", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/race.json"))
    options = parser.parse_args()
    where = provenance()
    torch.set_num_threads(options.ranks)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        crossray(folder, "landmark", "landmark", *PHOTOS)
        seconds = 60 * options.minutes / options.ranks
        fast = measured(folder, "crossray", seconds / SHARE, options.ranks, 100)
        faithful = measured(folder, "crnerf", seconds, options.ranks, 50)
    record = {"crossray": fast, "crnerf": faithful, "provenance": where}
    atomic_write(options.out, json.dumps(record, indent=2) + "\n")
    for method in ("crnerf", "crossray"):
        run = record[method]
        print(f"{method:10} {run['seconds']:6.0f} s  {run['training']['steps']:6} steps  PSNR {run['best_psnr']:.2f}")


if __name__ == "__main__":
    main()
