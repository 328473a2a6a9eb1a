"""What a run's folder tells without its model: evaluations, curves, timing; and what of it cannot be read."""

from __future__ import annotations

import json
import logging
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from pipeline.bootstrap import interval
from pipeline.errors import CrossrayError
from pipeline.record import read_losses
from pipeline.report.plots import Series
from pipeline.timing import TIMING, TimingRow, read_timing

Result = dict[str, Any]  # what a metrics.json holds

RESERVOIR = {"scalars": 0, "images": 1, "histograms": 1, "tensors": 1, "audio": 1}  # 0: all


class Evaluations(NamedTuple):
    """Of each protocol the results by step, rising; and the files that could not be read."""

    by_protocol: dict[str, dict[int, Result]]
    damaged: list[Path]

    def newest(self) -> dict[str, Result]:
        """Of each protocol the result of the latest step."""
        return {name: list(by_step.values())[-1] for name, by_step in self.by_protocol.items()}


def read_json(path: Path) -> dict[str, Any] | None:
    """A JSON object; None where there is none."""
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None


def read_evaluations(run: Path) -> Evaluations:
    """Every metrics.json of a run."""
    found: dict[str, dict[int, Result]] = {}
    damaged = []
    for path in sorted(run.glob("eval/*/step-*/metrics.json")):
        result = read_json(path)
        if result is None or not is_result(result):
            damaged.append(path)
            continue
        found.setdefault(str(result["protocol"]), {})[result["step"]] = result
    return Evaluations({name: dict(sorted(steps.items())) for name, steps in found.items()}, damaged)


def is_result(result: Result) -> bool:
    """Whether a metrics.json has what the page is made of."""
    try:
        images, mean = result["images"], result["mean"]
        texts = [result["protocol"], *(row[key] for row in images for key in ("name", "key"))]
        numbers = [mean["psnr"], *(row["psnr"] for row in images), *(v for v in mean.values() if v is not None)]
    except (KeyError, TypeError, AttributeError):
        return False
    right = all(isinstance(t, str) for t in texts) and all(isinstance(n, int | float) for n in numbers)
    return bool(images) and right and isinstance(result.get("step"), int)


def scores_of(result: Result, metric: str) -> list[float]:
    """A metric of each image, NaN where it is not recorded."""
    return [float(row[metric]) if row.get(metric) is not None else float("nan") for row in result["images"]]


def interval_of(result: Result, metric: str) -> tuple[float, float] | None:
    """The 95 % interval of a mean, as recorded, else from the images; None where neither is there."""
    recorded = result.get("interval") or {}
    if metric in recorded:
        pair = recorded[metric]
        return None if pair is None else (float(pair[0]), float(pair[1]))
    return interval(scores_of(result, metric)) if metric in result["images"][0] else None


def read_curves(run: Path) -> dict[str, Series]:
    """Every scalar that training wrote to TensorBoard, by tag; evaluations, in a folder of their own, are not of them.

    Memory: the scalars, and one picture of each tag.
    """
    folder = run / "tensorboard"
    if not any(folder.glob("events*")):
        return {}
    level = logging.getLogger("tensorboard").level
    logging.getLogger("tensorboard").setLevel(logging.ERROR)  # a file that is still written is no news
    try:
        board = EventAccumulator(str(folder), size_guidance=RESERVOIR)
        board.Reload()
        curves = {}
        for tag in board.Tags()["scalars"]:
            events = board.Scalars(tag)
            curves[tag] = Series(
                tag.partition("/")[2] or tag,
                np.array([e.step for e in events], np.int64),
                np.array([e.value for e in events], np.float64),
            )
        return curves
    finally:
        logging.getLogger("tensorboard").setLevel(level)


def read_loss_curves(run: Path) -> dict[str, Series]:
    """The losses of every step of rank 0, by name, from the run's record; nothing where there is none."""
    try:
        losses = read_losses(run).get(0)
    except (CrossrayError, OSError, ValueError):
        return {}
    if losses is None or not len(losses.rows):
        return {}
    steps = np.arange(1, len(losses.rows) + 1)
    return {name: Series(name, steps, losses.rows[:, i].astype(np.float64)) for i, name in enumerate(losses.names)}


def timings_beside(run: Path, method: str, field: str) -> list[TimingRow]:
    """What the timings beside a run (`crossray timing`) measured of its method."""
    rows: list[TimingRow] = []
    for path in sorted(run.parent.glob(f"*/{TIMING}")):
        with suppress(CrossrayError):  # the tables tell what is wrong with it
            rows += [row for row in read_timing(path).rows if (row.method, row.field) == (method, field)]
    return rows
