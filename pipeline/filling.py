"""The command line that trains and evaluates what a cell of a table lacks."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterable, Sequence

from model.methods import METHODS
from pipeline.paper_tables import PAPER, PAPER_REFERENCE, Wanted
from pipeline.records import Budget, Column, parts_of
from pipeline.results import setting


def command(row: Wanted, column: Column, protocols: Sequence[str]) -> str:
    """The command line that trains and evaluates what a cell lacks."""
    budget, downscale = column.budget, int(parts_of(column.protocol)["downscale"])
    as_paper = budget.device == "cuda" and column.field == "mlp"
    scene = f"data/{column.scene}"
    words = [column.scene, f"R{downscale}", row.method, row.masks, *row.changes, f"{row.rays}rays" if row.rays else ""]
    words += [] if budget == PAPER else [str(budget)]
    settings = [setting("scene.path", scene), f"name={slug(words)}", f"method={row.method}"]
    if column.field != METHODS[row.method].field:
        settings.append(f"model.field={column.field}")
    settings += [f"model.{change}" for change in row.changes]
    settings.append(f"scene.downscale={downscale}")
    if column.reference != PAPER_REFERENCE:
        settings.append(f"scene.reference_downscale={column.reference}")
    if row.masks:
        settings.append(setting("scene.shards", f"shards/{column.scene}-R{downscale}-{row.masks}"))
    if row.rays:
        settings.append(f"patch.size={round(row.rays**0.5)}")
    settings += budget_settings(budget, as_paper)
    settings.append(f"evaluate.protocols=[{','.join(protocols)}]")
    job = "jobs/train_scene.yaml" if as_paper else "jobs/train_scene_cpu.yaml"
    run = shlex.join([job, *(word for key in settings for word in ("--set", key))])
    if not row.masks:
        return run
    return f"{shlex.join(['crossray', 'mask', scene, '--with', row.masks, '--replace'])} && {run}"


def budget_settings(budget: Budget, as_paper: bool) -> list[str]:
    """The settings that give a training its budget, on top of one of the two job files."""
    wanted = {
        "ranks": budget.ranks,
        "device": budget.device,
        "threads": budget.threads,
        "train.seconds": budget.seconds,
        "train.epochs": budget.epochs,
        "train.steps_per_epoch": budget.steps_per_epoch,
    }
    file = {"threads": 1, "train.seconds": None, "train.epochs": 20, "train.steps_per_epoch": "auto"}
    if as_paper:
        file |= {"ranks": 8, "device": "cuda", "train.steps_per_epoch": 17200}
    else:
        file |= {"ranks": 2, "device": "cpu", "train.seconds": 300}
    timed = ("train.epochs", "train.steps_per_epoch") if budget.seconds is not None else ()
    return [setting(key, value) for key, value in wanted.items() if key not in timed and file.get(key) != value]


def slug(words: Iterable[str]) -> str:
    """Words as the name of a run."""
    text = "-".join(re.sub(r"[^A-Za-z0-9._]+", "-", word).strip("-.") for word in words if word)
    return re.sub(r"-{2,}", "-", text).strip("-._")[:100] or "run"
