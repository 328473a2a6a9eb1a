"""The whole pipeline on the built-in landmark, through the stages that any real scene goes through, and its scores.

Only here is the truth known, so only here can be scored what matters: the clean view in a given light, and the masks.
"""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from model.scene_model import SceneModel
from pipeline.config import Job, make_job, save_job
from pipeline.cutting import cut_shards
from pipeline.errors import CrossrayError
from pipeline.files import atomic_write
from pipeline.judge import depth_picture
from pipeline.landmark import Landmark, write_landmark
from pipeline.metrics import psnr, ssim_11, to_8bit
from pipeline.photos import Photos, open_photos
from pipeline.progress import shown
from pipeline.render import View, colour_view, predicted_mask, read_appearance, render_view
from pipeline.report import Row, write_overview, write_report
from pipeline.report.words import count
from pipeline.runs import load_run
from pipeline.truth import mask_iou

log = logging.getLogger("crossray")

TRAIN_SECONDS = 90.0
SIZE = 128  # long side of a photo, pixels
MODELS = {  # one field; T in closed form is the best of the landmark's ablation (benchmarks/results/ablation.md)
    "crossray": {"field": "hash", "transform": "closed_form"},
    "nerf": {"field": "hash"},
}
PHOTOS = {"train": 144, "val": 8, "test": 8}
TITLE = "The landmark without its tourists"
SCORES = {
    "psnr": "test views in their own light, against the truth without tourists [dB]",
    "psnr_cross": "the same, the light read from another view [dB]",
    "psnr_nerf": "plain NeRF: same field, processes and seconds [dB]",
    "psnr_floor": "the true view's mean colour [dB]",
    "ssim": "structural similarity, 11 x 11",
    "mask_iou": "tourists found, intersection over union",
    "train_seconds": "training of Crossray [s]",
    "total_seconds": "everything [s]",
}


def quickstart_job(out: Path, method: str, ranks: int, seconds: float) -> Job:
    """The training job of one method; the same field, ranks and seconds for each."""
    return make_job(
        {
            "name": method,
            "method": method,
            "scene": {
                "path": str(out / "scene"),
                "downscale": 1,
                "reference_downscale": 1,
                "shards": str(out / "shards"),
            },
            "runs": str(out / "runs"),
            "ranks": ranks,
            "device": "cpu",
            "model": MODELS[method],
            "train": {"seconds": seconds},
        }
    )


def run_quickstart(
    out: Path,
    *,
    train: Callable[[Job], dict[str, Any]],
    tasks: Callable[[], AbstractContextManager],
    seconds: float = TRAIN_SECONDS,
    size: int = SIZE,
    photos: dict[str, int] | None = None,
) -> dict[str, Any]:
    """Photos, shards, training of CR-NeRF and of plain NeRF, evaluation, report; returns what summary.json holds.

    Args:
        out: folder for everything; running again goes on from what is there.
        train: a launcher.
        tasks: a context manager that gives a mapper for a stage's tasks.
        seconds, size, photos: budget and size of the scene.
    """
    began = time.perf_counter()
    console = Console(highlight=False)
    photos = photos or PHOTOS
    console.rule("1/4  photos and shards")
    ranks = max(1, torch.multiprocessing.cpu_count())
    ours, nerf = (quickstart_job(out, method, ranks, seconds) for method in MODELS)
    with tasks() as mapper:
        write_landmark(out / "scene", **photos, size=size, mapper=shown(mapper, "taking photos"))
        cut_shards(
            out / "scene",
            ours.shards,
            downscale=1,
            reference_downscale=1,
            plan=ours.patch,
            mapper=shown(mapper, "cutting shards"),
        )
    trained = {}
    for number, job in enumerate((ours, nerf), start=2):
        console.rule(f"{number}/4  training {job.name}: {ranks} processes, {seconds:.0f} s")
        save_job(job, job.run / "job.yaml")
        trained[job.name] = train(job)
        if not trained[job.name]["finished"]:
            raise CrossrayError(f"training {job.name} was stopped; the same command again goes on from where it was")
    console.rule("4/4  evaluation and report")
    torch.set_num_threads(ranks)
    scene = Scored(out, ours, nerf)
    summary = {
        **scene.test_scores(),
        "mask_iou": scene.mask_iou(),
        "train_seconds": trained["crossray"]["train_seconds"],
        "train_steps": trained["crossray"]["steps"],
        "nerf_train_seconds": trained["nerf"]["train_seconds"],
        "nerf_train_steps": trained["nerf"]["steps"],
        "ranks": ranks,
        "device": trained["crossray"]["device"],
        "photos": photos,
        "size": size,
    }
    rows = scene.rows()
    write_overview(out / "overview.png", [row.pictures for row in rows])
    summary["total_seconds"] = time.perf_counter() - began
    report = report_of(summary, rows, out / "report.html")
    atomic_write(out / "summary.json", json.dumps(summary, indent=2))
    print_summary(console, out, summary, report)
    return summary


class Scored:
    """The two trained models beside the truth."""

    def __init__(self, out: Path, ours: Job, nerf: Job) -> None:
        self.landmark = Landmark.read(out / "scene")
        self.photos: Photos = open_photos(ours.shards)
        self.model: SceneModel = load_run(ours.run)[1]
        self.nerf: SceneModel = load_run(nerf.run)[1]

    def test_scores(self) -> dict[str, float]:
        """Means over the test views; docs/quickstart.md defines each."""
        test = self.photos.indices("test")
        scores: dict[str, list[float]] = {k: [] for k in ("psnr", "psnr_cross", "psnr_floor", "psnr_nerf", "ssim")}
        for position, index in enumerate(test):
            name = self.name(index)
            truth = self.landmark.truth(name, name)
            view = render_view(self.model, self.photos.records[index])
            picture = self.coloured(view, self.photos.reference(index))
            elsewhere = self.name(test[(position + 1) % len(test)])
            crossed = self.coloured(view, self.landmark.truth(elsewhere, name))
            flat = np.broadcast_to(truth.mean(axis=(0, 1)) / 255, truth.shape)
            scores["psnr"].append(psnr(picture, truth))
            scores["psnr_cross"].append(psnr(crossed, truth))
            scores["psnr_floor"].append(psnr(flat, truth))
            scores["psnr_nerf"].append(psnr(self.nerf_picture(index), truth))
            scores["ssim"].append(ssim_11(picture, truth))
        return {k: float(np.mean(v)) for k, v in scores.items()}

    def mask_iou(self) -> float | None:
        """Intersection over union of predicted and true masks, pooled over all training photos."""
        return mask_iou(self.model, self.photos, self.landmark, self.photos.indices("train"))

    def rows(self) -> list[Row]:
        """Rows of the report: three test photos, and the three training photos with the most transients."""
        crowded = sorted(self.photos.indices("train"), key=lambda i: -self.landmark.mask(self.name(i)).mean())[:3]
        test = self.photos.indices("test")
        rows = []
        for index in (*test[:: max(1, len(test) // 3)][:3], *crowded):
            name, camera = self.name(index), self.photos.records[index]
            view = render_view(self.model, camera)
            lent = max(test, key=lambda i: self.distance(i, index))
            rows.append(
                Row(
                    title=f"{camera.split} photo {camera.name} (other light: {self.name(lent)})",
                    pictures={
                        "photo": self.photos.image(index),
                        "clean truth": self.landmark.truth(name, name),
                        "NeRF, same budget": self.nerf_picture(index),
                        "Crossray": self.coloured(view, self.photos.reference(index)),
                        "in another photo's light": self.coloured(view, self.photos.reference(lent)),
                        "predicted mask": to_8bit(self.mask(index), "round"),
                        "true mask": self.landmark.mask(name).astype(np.uint8) * 255,
                        "depth": depth_picture(view),
                    },
                    compare=("clean truth", "Crossray"),
                )
            )
        return rows

    def distance(self, a: int, b: int) -> float:
        """How far apart the mean colours of two photos are."""
        means = [self.photos.reference(i).mean(axis=(0, 1)) for i in (a, b)]
        return float(np.linalg.norm(means[0] - means[1]))

    def mask(self, index: int) -> np.ndarray:
        """Transient probability (h, w) of a photo."""
        mask = predicted_mask(self.model, self.photos, index)
        assert mask is not None
        return mask

    def name(self, index: int) -> str:
        """The photo's file name."""
        return self.photos.records[index].name

    def coloured(self, view: View, reference: np.ndarray) -> np.ndarray:
        """A view of our model as 8-bit picture, in the appearance of a photo."""
        return to_8bit(colour_view(self.model, view, read_appearance(self.model, reference)), "round")

    def nerf_picture(self, index: int) -> np.ndarray:
        """Plain NeRF's 8-bit picture of a photo's view."""
        return to_8bit(colour_view(self.nerf, render_view(self.nerf, self.photos.records[index]), None), "round")


def report_of(summary: dict[str, Any], rows: list[Row], path: Path) -> Path:
    """The page of the quick start; returns its path."""
    return write_report(path, TITLE, scores_of(summary), rows, lead_of(summary))


def scores_of(summary: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Key, value and meaning of each score."""
    return [(key, "-" if summary[key] is None else f"{summary[key]:.3f}", text) for key, text in SCORES.items()]


def lead_of(summary: dict[str, Any]) -> str:
    """What was trained, on what, and for how long."""
    return (
        f"{summary['train_steps']:,} steps of {summary['photos']['train']} photos on {summary['device']}, "
        f"{count(summary['ranks'], 'process', 'processes')}, and plain NeRF beside it with the same field and the same "
        "seconds."
    )


def report_again(out: Path, path: Path) -> Path:
    """The page of a quick start that was run before, as the file `path`; returns it.

    Raises:
        CrossrayError: its runs, its shards or its summary cannot be used.
    """
    try:
        summary = json.loads((out / "summary.json").read_text())
        ours, nerf = (quickstart_job(out, m, summary["ranks"], summary["train_seconds"]) for m in MODELS)
        scores, lead = scores_of(summary), lead_of(summary)
    except (ValueError, KeyError, TypeError) as error:
        raise CrossrayError(
            f"{out / 'summary.json'}: is not what the quick start writes ({type(error).__name__}: {error}); "
            f"`crossray quickstart --out {out}` writes it anew"
        ) from None
    return write_report(path, TITLE, scores, Scored(out, ours, nerf).rows(), lead)


def print_summary(console: Console, out: Path, summary: dict[str, Any], report: Path) -> None:
    """The table at the end, and what to do next."""
    table = Table("score", "value", "what it is", title="Crossray quickstart")
    for key, text in SCORES.items():
        table.add_row(key, f"{summary[key]:.3f}" if summary[key] < 1 else f"{summary[key]:.2f}", text)
    console.print(table)
    console.print(f"pictures:     {report.resolve()}", soft_wrap=True)
    console.print(f"TensorBoard:  tensorboard --logdir {out / 'runs'}", soft_wrap=True)
    console.print("next:         crossray run jobs/train_scene_cpu.yaml --set scene.path=YOUR_SCENE", soft_wrap=True)
