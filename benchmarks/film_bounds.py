"""Between which depths should a film's rays run? Distance from the truth, and shimmer, along an orbit.

    python benchmarks/film_bounds.py RUN LANDMARK [--side 96] [--out benchmarks/results/film-bounds.json]

RUN is a model trained on the built-in landmark in the folder LANDMARK: here the quick start's.

Of an orbit of 240 frames, three that follow each other are rendered at each of five places and compared with true
pictures of the same cameras, nobody there, in the light of a training photo. PSNR is over all of them; shimmer is the
mean absolute change of the error from a frame to the next: what moves with the scene is no error, what boils is.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pipeline.files import atomic_write
from pipeline.flicker import true_picture
from pipeline.landmark import Landmark
from pipeline.landmark.tracer import Pinhole
from pipeline.painter import Painter
from pipeline.provenance import provenance
from pipeline.views.camera import Camera, camera_of, resized
from pipeline.views.smooth import orbit

FRAMES, PLACES, FOLLOWING = 240, (5, 35, 65, 95, 115), 3
APPEARANCES = 4  # training photos, evenly chosen


def widest(cameras: list[Camera]) -> list[Camera]:
    """The same with the least near and the greatest far of them all."""
    near, far = min(c.near for c in cameras), max(c.far for c in cameras)
    return [replace(c, near=near, far=far) for c in cameras]


def truth(landmark: Landmark, camera: Camera, scale: float, name: str) -> np.ndarray:
    """float64 (h, w, 3) in [0, 1]; `scale` is world units a scene unit."""
    pose = camera.pose
    rows = [(float(x), float(y), float(z)) for x, y, z in pose[:, :3].T]
    x, y, z = (float(v) for v in scale * pose[:, 3])
    lens = camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy
    return true_picture(landmark, Pinhole(*lens, (rows[0], rows[1], rows[2]), (x, y, z)), name) / 255


def scored(painter: Painter, cameras: list[Camera], true: list[np.ndarray], F: Tensor | None) -> dict[str, float]:
    """PSNR in dB, and shimmer in 8-bit levels."""
    errors = [painter.picture(c, F).rgb / 255 - t for c, t in zip(cameras, true, strict=True)]
    psnr = [-10 * np.log10((e**2).mean()) for e in errors]
    changes = [np.abs(b - a).mean() for i, (a, b) in enumerate(pairwise(errors), start=1) if i % FOLLOWING]
    return {"psnr": float(np.mean(psnr)), "shimmer": 255 * float(np.mean(changes))}


def measured(run: Path, scene: Path, side: int) -> dict[str, Any]:
    """Both policies in each appearance."""
    painter, landmark = Painter(run), Landmark.read(scene)
    photos = painter.photos
    train = photos.indices("train")
    film = orbit([camera_of(photos.records[i]) for i in train], FRAMES)
    frames = [k + i for k in PLACES for i in range(FOLLOWING)]
    policies = {
        name: [resized(path[k], side, round(side * path[k].height / path[k].width)) for k in frames]
        for name, path in (("of the cameras around", film), ("widest of the film", widest(film)))
    }
    found = {}
    for index in train[:: -(-len(train) // APPEARANCES)]:
        name = photos.records[index].name
        scale, F = photos.manifest.scene.scale, painter.read(name).F
        true = [truth(landmark, c, scale, name) for c in policies["of the cameras around"]]
        found[name] = {policy: scored(painter, cameras, true, F) for policy, cameras in policies.items()}
    return {"step": painter.checkpoint.step, "method": painter.job.method, "appearances": found}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("landmark", type=Path)
    parser.add_argument("--side", type=int, default=96)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(2)
    result = {
        "benchmark": "film_bounds",
        "side": options.side,
        "unit": {"psnr": "dB", "shimmer": "8-bit levels"},
        **measured(options.run, options.landmark, options.side),
        "provenance": provenance(),
    }
    text = json.dumps(result, indent=2) + "\n"
    print(text)
    if options.out:
        atomic_write(options.out, text)


if __name__ == "__main__":
    main()
