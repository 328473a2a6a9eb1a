"""Rows of dots on one axis: how much the numbers behind a mean differ."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from pipeline.report.blocks import DotRow, Dots
from pipeline.report.plots import compact, ticks


class Numbers(NamedTuple):
    """A row: named numbers, their mean, an interval around it, and all of that in words."""

    label: str
    numbers: list[tuple[str, float]]
    mean: float
    bar: tuple[float, float] | None
    text: str


def make_dots(title: str, caption: str, rows: Sequence[Numbers]) -> Dots | None:
    """The rows on one axis; numbers that are not finite have no place on it. None where none is finite."""
    found = [n for row in rows for n in (row.mean, *(row.bar or ()), *(v for _, v in row.numbers)) if math.isfinite(n)]
    if not found:
        return None
    marks = ticks(min(found), max(found), log=False)

    def place(number: float) -> float:
        return 100 * (number - marks[0]) / (marks[-1] - marks[0])

    drawn = [
        DotRow(
            row.label,
            row.text,
            [(place(v), f"{name}: {compact(v)}") for name, v in row.numbers if math.isfinite(v)],
            place(row.mean) if math.isfinite(row.mean) else None,
            (place(row.bar[0]), place(row.bar[1])) if row.bar else None,
        )
        for row in rows
    ]
    return Dots(title, caption, [(place(mark), compact(mark)) for mark in marks], drawn)
