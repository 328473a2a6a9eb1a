"""Where everything of a sheet goes on paper; lengths in inches, y downwards from the top."""

from __future__ import annotations

from typing import NamedTuple

from pipeline.errors import CrossrayError
from pipeline.figures.sheet import Panel, Row, Sheet

COLUMN, TEXT = 3.25, 6.875  # widths of one column and of both, of a paper in two columns
PAGE = 9.0  # no figure is higher
DPI = 300
GAP = 0.04  # between pictures
LABEL = 0.15  # strip at the left for the labels of rows
HEAD = 0.135  # for a line of words above a picture
BAR = 0.42  # strip at the right for colour bars with their numbers
EDGE = 0.05  # around everything
HIGHEST = 2.2  # in even rows no picture is higher
NARROW = 0.9  # a figure fits one column where its pictures are as wide as this there


class Box(NamedTuple):
    """A rectangle: left, top, width, height."""

    x: float
    y: float
    w: float
    h: float


class Layout(NamedTuple):
    """A sheet on paper: its size, a box for each panel (row, column), for each row, and where columns are."""

    width: float
    height: float
    panels: dict[tuple[int, int], Box]
    rows: list[Box]  # from the first to the last column, without words
    columns: list[tuple[float, float]]  # left, width


def lay_out(sheet: Sheet) -> Layout:
    """The places of all panels, each at its picture's own ratio, in a figure of width COLUMN or TEXT.

    Raises:
        CrossrayError: it does not fit a page.
    """
    count = len(sheet.rows[0].panels)
    for width in (COLUMN, TEXT):
        room = width - side(sheet, "left") - side(sheet, "right") - (count - 1) * GAP
        widths, heights = even_columns(sheet, room) if sheet.even else even_rows(sheet, room)
        if width == TEXT or min(widths) >= NARROW:
            break
    boxes: dict[tuple[int, int], Box] = {}
    rows: list[Box] = []
    left = side(sheet, "left") + (room - sum(widths)) / 2
    columns = [(left + sum(widths[:j]) + j * GAP, widths[j]) for j in range(count)]
    y = EDGE
    for i, (row, height) in enumerate(zip(sheet.rows, heights, strict=True)):
        y += HEAD if any(panel and panel.head for panel in row.panels) else 0
        for j, (panel, (x, column)) in enumerate(zip(row.panels, columns, strict=True)):
            if panel is not None:
                w = min(column, height * panel.ratio)
                boxes[i, j] = Box(x + (column - w) / 2, y, w, w / panel.ratio)
        rows.append(Box(left, y, sum(widths) + (count - 1) * GAP, height))
        y += height + GAP
    total = y - GAP + EDGE
    if total > PAGE:
        raise CrossrayError(
            f"the figure would be {total:.1f} inches high, and a page has {PAGE:g}; name fewer --views, or make more "
            "--columns"
        )
    return Layout(width, total, boxes, rows, columns)


def side(sheet: Sheet, where: str) -> float:
    """Room beside the panels: labels at the left, colour bars at the right."""
    needed: dict[str, tuple[bool, float]] = {
        "left": (any(row.label for row in sheet.rows), LABEL),
        "right": (any(row.bar for row in sheet.rows), BAR),
    }
    there, room = needed[where]
    return EDGE + (room if there else 0)


def even_columns(sheet: Sheet, room: float) -> tuple[list[float], list[float]]:
    """Widths of columns, all as wide, and heights of rows."""
    columns = len(sheet.rows[0].panels)
    width = room / columns
    heights = [max((min(row.tall, 1 / panel.ratio) * width for panel in there(row)), default=0) for row in sheet.rows]
    return [width] * columns, heights


def even_rows(sheet: Sheet, room: float) -> tuple[list[float], list[float]]:
    """Widths of columns and heights of rows, all as high."""
    columns = zip(*(row.panels for row in sheet.rows), strict=True)
    ratios = [max((panel.ratio for panel in column if panel is not None), default=1) for column in columns]
    height = min(HIGHEST, room / sum(ratios))
    return [height * ratio for ratio in ratios], [height] * len(sheet.rows)


def there(row: Row) -> list[Panel]:
    """The row's panels, without empty places."""
    return [panel for panel in row.panels if panel is not None]
