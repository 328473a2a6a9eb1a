"""One picture of a study on the landmark: test views down, the photo, the truth and every variant's rendering across.

    python benchmarks/sheet.py runs/ablation data/landmark --out docs/methods/landmark.png

Renderings are those that were scored under `cross@R1`: their light was read from another view.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

from pipeline.landmark import Landmark

PROTOCOL = "cross@R1"
VIEWS = 4


def rendering(study: Path, variant: str, seed: int, name: str) -> np.ndarray | None:
    """The scored picture of one test photo, None where the study has no such run."""
    found = sorted(study.glob(f"landmark.{variant}.seed{seed}/eval/{PROTOCOL}/step-*/metrics.json"))
    if not found:
        return None
    keys = {row["name"]: row["key"] for row in json.loads(found[-1].read_text())["images"]}
    return np.asarray(Image.open(found[-1].parent / f"{keys[name]}.png"))


def main() -> None:
    """Draw and save."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", type=Path)
    parser.add_argument("landmark", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    landmark = Landmark.read(options.landmark)
    names = landmark.names("test")[:VIEWS]
    variants = json.loads((options.study / "study.json").read_text())["study"]["variants"]
    columns = {
        "photo": [np.asarray(Image.open(options.landmark / "dense" / "images" / name)) for name in names],
        "truth": [landmark.truth(name, name) for name in names],
    }
    for variant in variants:
        pictures = [rendering(options.study, variant, options.seed, name) for name in names]
        if pictures[0] is not None:
            columns[variant] = [p for p in pictures if p is not None]
    figure, axes = plt.subplots(
        len(names), len(columns), figsize=(1.5 * len(columns), 1.3 * len(names)), layout="constrained", squeeze=False
    )
    for (title, pictures), column in zip(columns.items(), axes.T, strict=True):
        column[0].set_title(title, fontsize=8)
        for axis, picture in zip(column, pictures, strict=True):
            axis.imshow(picture)
            axis.axis("off")
    figure.savefig(options.out, dpi=110)


if __name__ == "__main__":
    main()
