"""How a run is doing, read from its folder alone: so it works for any launcher, and from any machine that sees it."""

from __future__ import annotations

import json
import socket
import time
from pathlib import Path
from typing import Any, NamedTuple

from rich.table import Table
from rich.text import Text

from pipeline.checkpoint import committed
from pipeline.errors import CrossrayError
from pipeline.heartbeat import STAGES, alive, driver_path, rank_path, read_beat

MOST_RANKS = 10_000  # that are looked for, whatever a file says


class Status(NamedTuple):
    """One run."""

    name: str
    stage: (
        str  # what its driver does, or: training, losing ranks, lost (they are gone without a word), trained, stopped
    )
    step: int
    total: int | None  # None: trained for a time
    progress: float  # in [0, 1]
    seconds_left: float | None
    checkpoint: int | None  # step of the newest committed one
    checkpoint_age: float | None  # seconds
    evaluation: str | None
    ranks_alive: int
    ranks: int


def find_runs(paths: list[Path]) -> list[Path]:
    """Run folders: each path is one, or holds some.

    Raises:
        CrossrayError: a path is neither.
    """
    found = []
    for path in paths:
        runs = {p.parent for p in path.glob("**/job.yaml")} | {p.parents[1] for p in path.glob("**/ranks/driver.json")}
        if not runs:
            raise CrossrayError(f"{path}: no run is there (a run has a job.yaml)")
        found += sorted(runs)
    return found


def status_of(run: Path) -> Status:
    """What a run's folder tells."""
    lead = read_beat(rank_path(run, 0)) or {}
    ranks = min(int(lead.get("ranks", 0)), MOST_RANKS)
    beats = [read_beat(rank_path(run, rank)) for rank in range(ranks)]
    living = sum(beat is not None and alive(beat) and beat["stage"] == "training" for beat in beats)
    stage = lead.get("stage", "not trained")
    if stage == "training" and living < ranks:
        stage = "lost" if living == 0 else "losing ranks"
    driver = read_beat(driver_path(run))
    if driver and driver["stage"] in STAGES and stage != "training" and may_live(driver):
        stage = driver["stage"]
    whole = committed(run / "checkpoints")
    return Status(
        name=run.name,
        stage=stage,
        step=int(lead.get("step", 0)),
        total=lead.get("total"),
        progress=float(lead.get("progress", 0.0)),
        seconds_left=lead.get("seconds_left") if stage == "training" else None,
        checkpoint=int(whole[-1].name.removeprefix("step-")) if whole else None,
        checkpoint_age=time.time() - (whole[-1] / "meta.json").stat().st_mtime if whole else None,
        evaluation=last_evaluation(run),
        ranks_alive=living,
        ranks=ranks,
    )


def may_live(driver: dict[str, Any]) -> bool:
    """Whether a driver still does what it said; of another machine nobody knows, for drivers beat once a stage."""
    return driver["host"] != socket.gethostname() or alive(driver)


def last_evaluation(run: Path) -> str | None:
    """The newest one in words: protocol, step, PSNR."""
    paths = sorted(run.glob("eval/*/step-*/metrics.json"), key=lambda p: (p.parent.name, p.stat().st_mtime))
    for path in reversed(paths):
        try:
            result = json.loads(path.read_text())
            return f"{result['protocol']} at {result['step']}: {result['mean']['psnr']:.2f} dB"
        except (OSError, ValueError, KeyError, TypeError):
            continue
    return None


def as_table(statuses: list[Status]) -> Table:
    """A row a run."""
    table = Table("run", "stage", "step", "left", "last checkpoint", "last evaluation", "ranks alive", pad_edge=False)
    for s in statuses:
        total = f" of {s.total}" if s.total is not None else ""
        kept = f"step {s.checkpoint}, {duration(s.checkpoint_age)} ago" if s.checkpoint_age is not None else "none"
        table.add_row(
            Text(s.name),
            s.stage,
            f"{s.step}{total} ({100 * s.progress:.0f} %)",
            "-" if s.seconds_left is None else duration(s.seconds_left),
            kept,
            Text(s.evaluation or "none"),
            f"{s.ranks_alive} of {s.ranks}" if s.stage in ("training", "losing ranks", "lost") else "-",
        )
    return table


def duration(seconds: float) -> str:
    """90 -> `1 min 30 s`: the two largest units."""
    whole = max(round(seconds), 0)
    units = (("d", whole // 86400), ("h", whole // 3600 % 24), ("min", whole // 60 % 60), ("s", whole % 60))
    first = next((i for i, (_, n) in enumerate(units) if n), 3)
    return " ".join(f"{n} {unit}" for unit, n in units[first : first + 2] if n) or "0 s"
