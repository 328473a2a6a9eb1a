"""The tables of a study: mean and spread over seeds, published numbers beside them; study.json and table.md."""

from __future__ import annotations

import json
import math
import statistics
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from rich.table import Table as RichTable
from rich.text import Text

from pipeline.cells import BETTER, METRICS, Cell, bold, decimal, row_of, title_of
from pipeline.files import atomic_write
from pipeline.published import Scores, published_tables
from pipeline.study import Keys, Run, StudyJob

RULE = (
    "Cells are mean ± sample standard deviation over seeds (number of seeds). Bold: the best mean of a column and all "
    "that are tied with it, which is where the difference of two means is at most sqrt(sd_a² + sd_b²). A row of one "
    "seed has no spread: it is compared with none, and nothing of it is bold."
)
PUBLISHED = (
    "Published: `{}` in pipeline/published.yaml, numbers of the paper for its own scenes and its own training. They "
    "stand beside ours and are not compared with them."
)


def write_results(study: StudyJob, results: Sequence[Keys], tables: Sequence[Table], failures: Keys) -> None:
    """study.json and table.md in the study's folder."""
    record = {"study": study.model_dump(mode="json"), "runs": list(results), "failures": failures}
    atomic_write(study.folder / "study.json", json.dumps(record, indent=2))
    atomic_write(study.folder / "table.md", as_markdown(study, tables, failures))


class Spread(NamedTuple):
    """Mean and sample standard deviation of n numbers; the latter is None for one number."""

    mean: float
    sd: float | None
    n: int


class Table(NamedTuple):
    """One scene under one protocol."""

    title: str
    header: list[str]
    rows: list[list[Cell]]


def spread(values: Iterable[float]) -> Spread | None:
    """Of numbers, one a seed; None where there are none."""
    values = list(values)
    if not values:
        return None
    return Spread(statistics.fmean(values), statistics.stdev(values) if len(values) > 1 else None, len(values))


def tied_with_best(column: Sequence[Spread | None], better: Any) -> list[bool]:
    """Which rows have the best mean or one tied with it (RULE); none unless two rows have a spread."""
    compared = [s for s in column if s is not None and s.sd is not None]
    if len(compared) < 2:
        return [False] * len(column)
    mean, sd, _ = better(compared, key=lambda s: s.mean)
    return [s is not None and s.sd is not None and abs(s.mean - mean) <= math.hypot(s.sd, sd) for s in column]


def make_tables(study: StudyJob, runs: Sequence[Run], results: Sequence[Keys]) -> list[Table]:
    """A table each scene and protocol, the variants in their order."""
    tables = []
    for scene in study.scenes:
        protocols = dict.fromkeys(p for run in runs if run.scene == scene for p in run.job.evaluate.protocols)
        for protocol in protocols or [None]:
            tables.append(make_table(study, scene, protocol, [r for r in results if r["scene"] == scene]))
    return tables


def make_table(study: StudyJob, scene: str, protocol: str | None, results: Sequence[Keys]) -> Table:
    """One scene's runs under one protocol (None: nothing was evaluated)."""
    measured: dict[str, list[dict[str, float]]] = {name: [] for name in study.variants}  # variant -> one a seed
    for result in results:
        mean = result["protocols"].get(protocol, {}).get("mean", {})
        scores = {key: value for key, value in mean.items() if value is not None}
        measured[result["variant"]].append(scores | {"seconds": result["seconds"], "steps": result["steps"]})
    found = dict.fromkeys(key for rows in measured.values() for row in rows for key in row)
    metrics = [m for m in METRICS if m in found] + [m for m in found if m not in (*METRICS, "seconds", "steps")]
    columns = [column_of(metric, measured) for metric in (*metrics, "seconds", "steps")]
    header, beside = published_columns(study)
    return Table(
        f"{scene}, {protocol}" if protocol else scene,
        ["variant", *(title_of(m) for m in metrics), "training seconds", "steps", *header],
        [[Cell(name), *cells, *beside[name]] for name, *cells in zip(study.variants, *columns, strict=True)],
    )


def column_of(metric: str, measured: dict[str, list[dict[str, float]]]) -> list[Cell]:
    """A metric's cells, one a variant."""
    column = [spread(row[metric] for row in rows if metric in row) for rows in measured.values()]
    best = tied_with_best(column, BETTER[metric]) if metric in BETTER else [False] * len(column)
    return [Cell(shown(value, metric), mark) for value, mark in zip(column, best, strict=True)]


def published_columns(study: StudyJob) -> tuple[list[str], dict[str, list[Cell]]]:
    """Of the study's published table: a title each scene, and each variant's cells, all metrics in one."""
    table = published_tables()[study.published] if study.published else {}
    rows: dict[str, Scores] = {name: table.get(name, {}) for name in study.variants}
    scenes = dict.fromkeys(scene for row in rows.values() for scene in row)
    metrics = [m for m in METRICS if any(m in scores for row in rows.values() for scores in row.values())]
    header = [f"published: {scene}, {' / '.join(map(title_of, metrics))}" for scene in scenes]
    cells = {
        name: [
            Cell(" / ".join(decimal(row[scene].get(m), m) for m in metrics) if scene in row else "-")
            for scene in scenes
        ]
        for name, row in rows.items()
    }
    return header, cells


def shown(value: Spread | None, metric: str) -> str:
    """mean ± sd (n)."""
    if value is None:
        return "-"
    deviation = "" if value.sd is None else f" ± {decimal(value.sd, metric)}"
    return f"{decimal(value.mean, metric)}{deviation} ({value.n})"


def captions(study: StudyJob) -> list[str]:
    """What a reader of the tables has to know."""
    return [RULE, *([PUBLISHED.format(study.published)] if study.published else [])]


def as_markdown(study: StudyJob, tables: Sequence[Table], failures: Keys) -> str:
    """The study's page."""
    lines = [f"# {study.name}", "", *(line for caption in captions(study) for line in (caption, ""))]
    for table in tables:
        lines += [f"## {table.title}", "", row_of(table.header), row_of(["---"] * len(table.header))]
        lines += [row_of(map(bold, row)) for row in table.rows]
        lines.append("")
    if failures:
        lines += ["## Not done", "", *(f"- {name}: {reason}" for name, reason in failures.items()), ""]
    return "\n".join(lines)


def as_rich(table: Table) -> RichTable:
    """For a terminal."""
    shape = RichTable(*table.header, title=table.title)
    shape.columns[0].no_wrap = True
    for row in table.rows:
        shape.add_row(*(Text(cell.text, style="bold" if cell.best else "") for cell in row))
    return shape
