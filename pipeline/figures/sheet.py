"""What a figure of pictures is made of: rows of panels, in the terms of pictures and words alone."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Panel:
    """One picture; `dots` (n, 2) are columns and rows of its pixels that are marked at their centres."""

    picture: np.ndarray  # uint8 (h, w, 3)
    head: str = ""  # the words above it
    dots: np.ndarray | None = None
    stretched: float | None = None  # width over height at which it is shown, where its pixels are not square

    @property
    def ratio(self) -> float:
        """Width over height on paper."""
        return self.stretched or self.picture.shape[1] / self.picture.shape[0]


@dataclass(frozen=True)
class Bar:
    """The colour bar of a row: what is shown from `low` to `high` by one of matplotlib's colormaps."""

    title: str
    low: float
    high: float
    colours: str


@dataclass(frozen=True)
class Row:
    """Panels side by side; None is an empty place. `label` stands at the left, upwards."""

    label: str
    panels: tuple[Panel | None, ...]
    bar: Bar | None = None
    tall: float = 1.5  # in even columns, no picture is higher than so many widths of its column


@dataclass(frozen=True)
class Sheet:
    """A figure: rows of as many panels each.

    `even`: all columns are as wide, and each row as high as its pictures need, which suits rows of one view each.
    Otherwise all rows are as high, and each column as wide as its pictures need, which suits columns of one photo each.
    """

    rows: tuple[Row, ...]
    even: bool

    def __post_init__(self) -> None:
        if not self.rows or len({len(row.panels) for row in self.rows}) != 1:
            raise ValueError("a sheet is made of rows of as many panels each")


@dataclass(frozen=True)
class Composed:
    """A figure before it is drawn: its sheet, a caption that says what is what, and what the record is to tell."""

    sheet: Sheet
    caption: str
    about: dict[str, Any] = field(default_factory=dict)


def coloured(values: np.ndarray, bar: Bar, shown: np.ndarray | None = None) -> np.ndarray:
    """Numbers (h, w) in a bar's colours, uint8 (h, w, 3); white where `shown` (h, w) is False."""
    from matplotlib import colormaps

    share = (values - bar.low) / (bar.high - bar.low)
    picture = colormaps[bar.colours](share.clip(0, 1), bytes=True)[..., :3].copy()
    if shown is not None:
        picture[~shown] = 255
    return picture
