"""The paper's tables of scores, generated from what is recorded: published numbers in columns of their own.

A column of ours is one scene under one protocol at one downscale, one field and one budget of training, so that no two
of these are ever mixed. An empty cell has the command that would fill it. Ours are compared with ours, photo by photo
(pipeline/bootstrap.py), and never with what was published. What the paper's tables are is in
pipeline/paper_tables.py, tables of times in pipeline/time_tables.py, others in pipeline/beyond_tables.py, and how all
look in pipeline/page.py.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import groupby
from typing import Literal, NamedTuple

import numpy as np

from model.methods import METHODS
from pipeline.bootstrap import interval, tied
from pipeline.cells import BETTER, METRICS, Cell, decimal, title_of
from pipeline.filling import command
from pipeline.paper_tables import (
    FIELDS,
    LABELS,
    PAPER,
    PAPER_REFERENCE,
    PAPER_SCENES,
    RAYS,
    SEGMENTERS,
    Plan,
    Wanted,
    plans,
)
from pipeline.published import published_tables
from pipeline.records import Column, Design, Score, Source, parts_of
from pipeline.results import meaning_today

PROTOCOLS = ("crnerf-full", "nerfw-half", "cross")  # in this order, before all others


# ---------------------------------------------------------------------------------------------- what a table is made of


class Entry(NamedTuple):
    """What stands in a cell."""

    kind: Literal["published", "ours", "lacking", "none"]
    lines: tuple[Cell, ...] = ()
    sources: tuple[Source, ...] = ()
    others: tuple[Source, ...] = ()
    """What was measured of the same, too, and is not in the cell."""
    command: str | None = None
    """What would fill it, where it is lacking."""


class Head(NamedTuple):
    """A column's head."""

    kind: Literal["published", "ours"]
    lines: tuple[str, ...]


class Row(NamedTuple):
    """A row; `beyond`: the paper has none like it."""

    label: str
    beyond: bool
    entries: tuple[Entry, ...]


class Table(NamedTuple):
    """A table of the page."""

    title: str
    text: str
    heads: tuple[Head, ...]
    rows: tuple[Row, ...]
    label: str = ""
    """Over the first column."""


NONE = Entry("none")


# ----------------------------------------------------------------------------------------------------- tables of scores


def score_tables(scores: Sequence[Score]) -> list[Table]:
    """The paper's tables of scores."""
    plain = [score for score in scores if not parts_of(score.protocol)["suffix"]]
    return [score_table(plan, plain) for plan in plans()]


def score_table(plan: Plan, scores: Sequence[Score]) -> Table:
    """One of the paper's tables."""
    rows = (*plan.rows, *rays_rows(plan, scores), *further_rows(plan, scores))
    targets = [target(scene, plan.downscale, rows, scores) for scene in plan.scenes]
    found = columns_of(score for score in scores if any(row.takes(score) for row in rows))
    known = [*targets, *(target(scene, n, rows, scores) for n in plan.but for scene in plan.scenes)]
    others = [column for column in found if column not in known] if plan.others else []
    columns = [*targets, *others]
    ours = [fill(column, rows, scores, plan.metrics, siblings(column, columns)) for column in columns]
    heads, entries = [], []
    for place, column in enumerate(columns):
        if place < len(plan.scenes):
            heads.append(head_published(plan.scenes[place], plan))
            entries.append([entry_published(row, plan.scenes[place], plan) for row in rows])
        heads.append(head_of(column, columns, plan.metrics))
        entries.append(ours[place])
    return assemble(plan.title, plan.text, heads, rows, entries)


def fitted_tables(scores: Sequence[Score]) -> list[Table]:
    """A table of scores under protocols that fit something to the left half of the test photo, if there are some."""
    fitted = [score for score in scores if parts_of(score.protocol)["suffix"]]
    if not fitted:
        return []
    columns = columns_of(fitted)
    rows = list(map(row_beyond, dict.fromkeys(score.design for score in fitted)))
    text = (
        "`+affine` is the control: a picture's colours fitted to the left half of the test photo by one affine map, 12 "
        "numbers, nothing learned. `+fit`: the appearance that the encoder reads is fitted further to the left half."
    )
    entries = [fill(column, rows, fitted, METRICS, siblings(column, columns)) for column in columns]
    heads = [head_of(column, columns, METRICS) for column in columns]
    return [assemble("Beyond the paper: fits to the left half of the test photo", text, heads, rows, entries)]


def assemble(
    title: str, text: str, heads: Sequence[Head], rows: Sequence[Wanted], columns: Sequence[Sequence[Entry]]
) -> Table:
    """Columns of entries as a table."""
    made = tuple(Row(w.label, w.beyond, tuple(entries)) for w, *entries in zip(rows, *columns, strict=True))
    return Table(title, text, tuple(heads), made, "method")


def rays_rows(plan: Plan, scores: Sequence[Score]) -> list[Wanted]:
    """Of the table of numbers of rays: those of `crossray` that were measured."""
    if not any(row.rays for row in plan.rows):
        return []
    rows = [
        Wanted("crossray", f"{LABELS['crossray']}, {count} rays", field="hash", rays=count, beyond=True)
        for count in RAYS
    ]
    return [row for row in rows if any(row.takes(score) for score in scores)]


def further_rows(plan: Plan, scores: Sequence[Score]) -> list[Wanted]:
    """Rows for what was measured beyond the paper's."""
    designs = dict.fromkeys(
        score.design
        for score in scores
        if plan.further(score) and score.usual_patch and not any(row.takes(score) for row in plan.rows)
    )
    return list(map(row_beyond, designs))


def row_beyond(design: Design) -> Wanted:
    """A row for a design that the paper does not have."""
    method, field, changes, masks = design
    return Wanted(method, label_of(design), field=field, changes=changes, masks=masks, beyond=True)


def label_of(design: Design) -> str:
    """A design in words."""
    method = "crnerf" if design.method == "crossray" and design.changes else design.method
    label = LABELS.get(method, method)
    if design.masks:
        label = f"CR-NeRF-A + {SEGMENTERS.get(design.masks, 'masks made elsewhere')}"
    field = [FIELDS[design.field]] if design.field == "hash" and method != "crossray" else []
    return ", ".join([label, *design.changes, *field])


# -------------------------------------------------------------------------------------------------------------- columns


def columns_of(scores: Iterable[Score]) -> list[Column]:
    """The columns of scores, in the order of scenes, sizes, protocols, fields and budgets."""
    scenes = [*PAPER_SCENES, "landmark"]

    def order(column: Column) -> tuple[object, ...]:
        parts = parts_of(column.protocol)
        place = scenes.index(column.scene) if column.scene in scenes else len(scenes)
        rank = PROTOCOLS.index(parts["name"]) if parts["name"] in PROTOCOLS else len(PROTOCOLS)
        return (
            *(place, column.scene, int(parts["downscale"]), str(column.budget), column.field, column.reference),
            *(sorted(column.photos), rank, column.protocol, column.meaning),
        )

    return sorted({score.column for score in scores}, key=order)


def target(scene: str, downscale: int, rows: Sequence[Wanted], scores: Sequence[Score]) -> Column:
    """The column that repeats the paper's: its scene, size, field and budget, under what it was measured by. Of several
    sets of test photos it has the one that most was scored on."""
    protocol = f"crnerf-full@R{downscale}"
    empty = Column(scene, protocol, meaning_today(protocol), "mlp", PAPER, PAPER_REFERENCE, frozenset())
    found = [score.column for score in scores if any(row.takes(score) for row in rows)]
    alike = [column for column in found if column._replace(photos=frozenset()) == empty]
    return max(alike, key=lambda column: (alike.count(column), sorted(column.photos))) if alike else empty


def siblings(column: Column, columns: Sequence[Column]) -> tuple[str, ...]:
    """The protocols of all columns that the same training fills."""
    same = [c for c in columns if c._replace(protocol="", meaning=()) == column._replace(protocol="", meaning=())]
    return tuple(dict.fromkeys(c.protocol for c in same))


def head_of(column: Column, columns: Sequence[Column], metrics: Sequence[str]) -> Head:
    """What a reader has to know of a column."""
    lines = [PAPER_SCENES.get(column.scene, column.scene), column.protocol, FIELDS[column.field]]
    lines += [*str(column.budget).split(", "), *filter(None, [column.budget.machine])]
    photos = f"{len(column.photos)} photos" if column.photos else "nothing measured yet"
    alike = [c for c in columns if c != column and c[:2] == column[:2] and c.photos != column.photos]
    if column.photos and alike:
        photos += f" from {min(column.photos)}"
    lines.append(photos)
    if any(c != column and c._replace(reference=column.reference) == column for c in columns):
        lines.append(f"references at 1/{column.reference}")
    if column.meaning != meaning_today(column.protocol):
        lines.append("another definition of the protocol")
    return Head("ours", (*lines, " / ".join(map(title_of, metrics))))


def head_published(scene: str, plan: Plan) -> Head:
    """The head of a column of the paper."""
    lines = ("published", PAPER_SCENES[scene], f"R/{plan.downscale}", *str(PAPER).split(", "))
    return Head("published", (*lines, " / ".join(map(title_of, plan.metrics))))


# ---------------------------------------------------------------------------------------------------------------- cells


def entry_published(row: Wanted, scene: str, plan: Plan) -> Entry:
    """The paper's numbers, if it has some."""
    names = (plan.published,) if isinstance(plan.published, str) else plan.published
    if len(names) > 1:  # one table a method
        names = tuple(name for name in names if ("hanerf" in name) == (row.method == "hanerf"))
    found = [published_tables()[name].get(row.published or "", {}).get(scene) for name in names]
    numbers = next((scores for scores in found if scores), None)
    if numbers is None:
        return NONE
    return Entry("published", tuple(Cell(decimal(numbers.get(metric), metric)) for metric in plan.metrics))


class Measured(NamedTuple):
    """A row's numbers in a column: scores of the same design from the same code and settings, one a seed."""

    scores: tuple[Score, ...]
    values: dict[str, list[float]]
    """Metric -> one a photo, the mean over seeds; photos in the order of their names."""
    others: tuple[Source, ...]


def measured(scores: Sequence[Score], metrics: Sequence[str]) -> Measured | None:
    """What a cell is made of; None where there is nothing.

    Scores of different code or settings are never averaged. Of several such sets the one with most seeds is taken, of
    these the one with the fewest settings of its own, then the newest.
    """

    def like(score: Score) -> tuple[str, tuple[str, ...]]:
        return score.source.commit or "", score.source.settings

    sets = [list(group) for _, group in groupby(sorted(scores, key=like), key=like)]
    if not sets:
        return None

    def rank(group: Sequence[Score]) -> tuple[int, int, str]:
        newest = max(score.source.date or "" for score in group)
        return len({score.seed for score in group}), -len(group[0].source.settings), newest

    best: list[Score] = max(sets, key=rank)
    by_seed = {score.seed: score for score in sorted(best, key=lambda s: s.source.date or "")}
    chosen = tuple(by_seed[seed] for seed in sorted(by_seed))
    names = sorted(chosen[0].images)
    values = {
        metric: [float(np.mean([score.images[name][metric] for score in chosen])) for name in names]
        for metric in metrics
        if all(metric in score.images[name] for score in chosen for name in names)
    }
    others = tuple(score.source for score in scores if score not in chosen)
    return Measured(chosen, values, others)


def fill(
    column: Column,
    rows: Sequence[Wanted],
    scores: Sequence[Score],
    metrics: Sequence[str],
    protocols: Sequence[str],
) -> list[Entry]:
    """A column of ours."""
    inside = [score for score in scores if score.column == column]
    found = [measured([score for score in inside if row.takes(score)], metrics) for row in rows]
    best = {metric: best_of([m and m.values.get(metric) for m in found], metric) for metric in metrics}
    entries = []
    for place, (row, numbers) in enumerate(zip(rows, found, strict=True)):
        if numbers is None:
            entries.append(entry_lacking(row, column, protocols or (column.protocol,)))
            continue
        lines = [Cell(shown(numbers.values.get(metric), metric), best[metric] == place) for metric in metrics]
        entries.append(
            Entry(
                "ours",
                (*lines, Cell(effort(numbers), small=True)),
                tuple(s.source for s in numbers.scores),
                numbers.others,
            )
        )
    return entries


def best_of(values: Sequence[list[float] | None], metric: str) -> int | None:
    """Which row is better than every other one beyond what the photos can tell; None where a tie leaves it open, or
    where there is nothing to compare."""
    there = [place for place, row in enumerate(values) if row]
    if len(there) < 2 or metric not in BETTER:
        return None

    def of(place: int) -> list[float]:
        return values[place] or []

    best = BETTER[metric](there, key=lambda place: np.mean(of(place)))
    return None if any(tied(of(best), of(place)) for place in there if place != best) else best


def shown(values: list[float] | None, metric: str) -> str:
    """mean [low, high] over photos; - where there is nothing."""
    if not values:
        return "-"
    found = interval(values)
    inside = "" if found is None else f" [{decimal(found[0], metric, 1)}, {decimal(found[1], metric, 1)}]"
    return decimal(float(np.mean(values)), metric) + inside


def effort(numbers: Measured) -> str:
    """How many seeds, and how many steps each was trained, about."""
    count, steps = len(numbers.scores), float(np.mean([score.steps for score in numbers.scores]))
    return f"{count} seed{'s' if count > 1 else ''}, {steps:,.0f} steps"


# --------------------------------------------------------------------------------------------------- what would fill it


def entry_lacking(row: Wanted, column: Column, protocols: Sequence[str]) -> Entry:
    """A cell that nothing was measured for: with the command that would fill it, or why there is none."""
    if row.method == "crnerf" and column.field == "hash":
        return Entry("none", (Cell("as crossray", small=True),))
    if not possible(row, column):
        return NONE
    return Entry("lacking", command=command(row, column, protocols))


def possible(row: Wanted, column: Column) -> bool:
    """Whether a training can fill a cell."""
    if row.field not in (None, column.field) or column.budget.device == "elsewhere" or row.masks == "unnamed":
        return False
    if row.method not in METHODS or column.meaning != meaning_today(column.protocol):
        return False
    fits = METHODS[row.method].appearance not in ("none", "embedding")
    return fits or parts_of(column.protocol)["suffix"] != "+fit"
