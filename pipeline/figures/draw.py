"""Figures on paper: one small sans font, vector text, pictures at their own pixels; the same bytes each time."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.figures.layout import BAR, DPI, GAP, HEAD, LABEL, Box, lay_out
from pipeline.figures.sheet import Bar, Panel, Sheet

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

POINT = 1 / 72  # inch
SIZE = 6.5  # points, of all words
INK = "#222222"
DOT = 0.4  # width of a mark, of the way from one marked pixel to the next
BIGGEST = 2.2  # points across, of a mark
FONT = "DejaVu Sans"  # comes with matplotlib, so that figures are the same everywhere
STYLE: dict[str, Any] = {
    "font.family": FONT,
    "font.size": SIZE,
    "text.color": INK,
    "text.parse_math": False,  # names of files are no formulas
    "text.hinting": "none",
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.labelsize": SIZE,
    "axes.linewidth": 0.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.labelsize": SIZE,
    "ytick.labelsize": SIZE,
    "xtick.major.size": 2,
    "ytick.major.size": 2,
    "xtick.major.width": 0.5,
    "ytick.major.width": 0.5,
    "legend.fontsize": SIZE,
    "legend.frameon": False,
    "lines.linewidth": 1,
    "lines.markersize": 3.5,
    "pdf.fonttype": 42,  # TrueType, as publishers ask for
    "savefig.facecolor": "white",
}


@contextmanager
def styled() -> Iterator[None]:
    """Everything of a figure, its saving too, happens inside this."""
    import matplotlib

    defaults: dict[Any, Any] = dict(matplotlib.rcParamsDefault)  # whatever the user's matplotlibrc says
    with matplotlib.rc_context(defaults | STYLE | {"backend": "Agg"}):
        yield


def saved(figure: Figure, about: dict[str, str]) -> tuple[bytes, bytes]:
    """The figure as PNG (DPI dots an inch) and as PDF, with `Title` and `Subject` of `about` inside.

    In the PDF pictures have their own pixels. In the PNG they are enlarged without blur, and reduced with it.
    """
    png, pdf = io.BytesIO(), io.BytesIO()
    for axes in figure.axes:
        for image in axes.images:
            own = image.get_size()[1]
            printed = axes.get_position().width * figure.get_figwidth() * DPI
            image.set_interpolation("nearest" if printed >= own else "hanning")
    figure.savefig(png, format="png", dpi=DPI, metadata={"Title": about["Title"], "Description": about["Subject"]})
    for axes in figure.axes:
        for image in axes.images:
            image.set_interpolation("none")
    figure.savefig(pdf, format="pdf", dpi=DPI, metadata={**about, "CreationDate": None})
    return png.getvalue(), pdf.getvalue()


def blank(width: float, height: float) -> Figure:
    """An empty figure of whole dots; in inches."""
    from matplotlib.figure import Figure

    return Figure(figsize=(round(width * DPI) / DPI, round(height * DPI) / DPI))


def draw_sheet(sheet: Sheet) -> Figure:
    """Panels, words, and colour bars. CrossrayError where they do not fit a page."""
    layout = lay_out(sheet)
    figure = blank(layout.width, layout.height)
    for (i, j), box in layout.panels.items():
        panel = sheet.rows[i].panels[j]
        assert panel is not None
        draw_panel(figure, panel, box)
        if panel.head:
            x, room = layout.columns[j]
            write(figure, panel.head, x + room / 2, box.y - 0.3 * HEAD, room, va="baseline")
    for row, box in zip(sheet.rows, layout.rows, strict=True):
        if row.label:
            x, y = box.x - LABEL / 2, box.y + box.h / 2
            write(figure, row.label, x, y, box.h, rotation=90, va="center")
        if row.bar is not None:
            draw_bar(figure, row.bar, Box(box.x + box.w + GAP, box.y, BAR - GAP, box.h))
    return figure


def draw_panel(figure: Figure, panel: Panel, box: Box) -> None:
    """A picture, and what is marked on it."""
    axes = axes_at(figure, box)
    axes.set_axis_off()
    axes.imshow(panel.picture, aspect="auto")
    if panel.dots is not None:
        draw_dots(axes, panel, box)


def draw_dots(axes: Axes, panel: Panel, box: Box) -> None:
    """Marks at pixels, small enough to see the picture between them."""
    assert panel.dots is not None
    columns = np.unique(panel.dots[:, 0])
    apart = np.ptp(columns) / max(1, len(columns) - 1) / panel.picture.shape[1] * box.w / POINT
    across = min(BIGGEST, DOT * apart)
    axes.scatter(
        panel.dots[:, 0],
        panel.dots[:, 1],
        s=across**2,
        c="#ffe14d",
        edgecolors="black",
        linewidths=0.1 * across,
        clip_on=False,
    )
    height, width = panel.picture.shape[:2]
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))


def draw_bar(figure: Figure, bar: Bar, box: Box) -> None:
    """A colour bar, as high as its row, its title along its numbers."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    half = SIZE * POINT / 2  # of a number: it stays beside its own row
    axes = axes_at(figure, Box(box.x, box.y + half, 0.07, box.h - 2 * half))
    drawn = figure.colorbar(ScalarMappable(Normalize(bar.low, bar.high), bar.colours), cax=axes)
    drawn.outline.set_linewidth(0.4)
    drawn.locator = ticks(5 if box.h > 0.6 else 2)
    drawn.update_ticks()
    axes.tick_params(pad=1.5)
    write(figure, bar.title, box.x + box.w - 0.045, box.y + box.h / 2, box.h, rotation=90, va="center")


def ticks(most: int) -> Any:
    """Where round numbers are."""
    from matplotlib.ticker import MaxNLocator

    return MaxNLocator(most, steps=[1, 2, 5, 10])


def axes_at(figure: Figure, box: Box) -> Axes:
    """Axes that fill a box."""
    width, height = figure.get_size_inches()
    return figure.add_axes((box.x / width, 1 - (box.y + box.h) / height, box.w / width, box.h / height))


def write(figure: Figure, words: str, x: float, y: float, room: float, rotation: float = 0, va: str = "top") -> None:
    """Words in the middle of (x, y), cut in their middle where they are longer than `room`; in inches."""
    width, height = figure.get_size_inches()
    figure.text(
        x / width, 1 - y / height, fitted(words, room), ha="center", va=va, rotation=rotation, rotation_mode="default"
    )


def fitted(words: str, room: float) -> str:
    """Words on one line that need no more than `room` inches, with ... in their middle where something was left out;
    characters that the font does not have are boxes.
    """
    words = "".join(c if has(c) else "□" for c in " ".join(words.split()))
    kept, short = len(words), words
    while kept > 2 and length(short) > room:
        kept -= 1
        short = f"{words[: (kept + 1) // 2]}…{words[len(words) - kept // 2 :]}"
    return short


def font() -> Any:
    """The font of all words."""
    from matplotlib.font_manager import findfont, get_font

    return get_font(findfont(FONT))


def has(character: str) -> bool:
    """Whether the font has it."""
    return font().get_char_index(ord(character)) != 0


def length(words: str) -> float:
    """Inches from the first to the last letter."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import text_to_path

    return text_to_path.get_text_width_height_descent(words, FontProperties(family=FONT, size=SIZE), False)[0] * POINT
