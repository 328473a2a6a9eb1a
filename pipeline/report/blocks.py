"""What a page is made of: plain values that page.html turns into HTML, escaping every text on the way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, ClassVar

from jinja2 import Environment, StrictUndefined

from pipeline.files import atomic_write
from pipeline.report.plots import Plot


@dataclass(frozen=True)
class Picture:
    """A picture inside the page. `source` is a data URI, empty where the page had no room left for it."""

    source: str
    width: int
    height: int
    alt: str


@dataclass(frozen=True)
class Shot:
    """A picture and the words under it; without a picture, an empty place."""

    caption: str
    picture: Picture | None = None


@dataclass(frozen=True)
class Slider:
    """Two pictures of one size, one over the other; the left one is the truth."""

    title: str
    caption: str
    left: Shot
    right: Shot


@dataclass(frozen=True)
class Tile:
    """One large number."""

    label: str
    value: str
    unit: str = ""
    detail: str = ""


@dataclass(frozen=True)
class DotRow:
    """A row of dots on a common axis; all positions in percent of its length."""

    label: str
    text: str
    dots: list[tuple[float, str]]  # position, what it is
    mean: float | None
    bar: tuple[float, float] | None


@dataclass(frozen=True)
class Cell:
    """A cell of a table. `value` is what it is sorted by; None comes last."""

    text: str = ""
    value: float | str | None = None
    pictures: tuple[Picture, ...] = ()
    strong: bool = False
    href: str = ""


@dataclass(frozen=True)
class Tiles:
    kind: ClassVar[str] = "tiles"
    items: list[Tile]


@dataclass(frozen=True)
class Dots:
    kind: ClassVar[str] = "dots"
    title: str
    caption: str
    ticks: list[tuple[float, str]]
    rows: list[DotRow]


@dataclass(frozen=True)
class Plots:
    kind: ClassVar[str] = "plots"
    items: list[Plot]


@dataclass(frozen=True)
class Table:
    """`numeric` and `sortable` are one a column; `sorted_by` is the column by which the rows come, rising."""

    kind: ClassVar[str] = "table"
    title: str
    columns: list[str]
    rows: list[list[Cell]]
    numeric: Sequence[bool] = ()
    sortable: Sequence[bool] = ()
    sorted_by: int | None = None
    caption: str = ""
    foot: Sequence[list[Cell]] = ()


@dataclass(frozen=True)
class Sliders:
    kind: ClassVar[str] = "sliders"
    items: list[Slider]
    title: str = ""
    intro: str = ""


@dataclass(frozen=True)
class Grid:
    """Rows of pictures under common heads; the first column and `heads` say what is what."""

    kind: ClassVar[str] = "grid"
    title: str
    heads: list[Shot]
    rows: list[list[Shot]]


@dataclass(frozen=True)
class Strip:
    kind: ClassVar[str] = "strip"
    title: str
    shots: list[Shot]


@dataclass(frozen=True)
class Facts:
    kind: ClassVar[str] = "facts"
    items: list[tuple[str, str]]


@dataclass(frozen=True)
class Note:
    """Why something is not there, and the command that makes it."""

    kind: ClassVar[str] = "note"
    text: str
    command: str = ""


@dataclass(frozen=True)
class Code:
    kind: ClassVar[str] = "code"
    summary: str
    text: str


Block = Tiles | Dots | Plots | Table | Sliders | Grid | Strip | Facts | Note | Code


@dataclass(frozen=True)
class Section:
    """A part of the page; `key` is its anchor. `beside`: its blocks stand beside each other where there is room."""

    key: str
    title: str
    intro: str = ""
    blocks: list[Block] = field(default_factory=list)
    beside: bool = False


@dataclass(frozen=True)
class Page:
    """`hero` is the one slider beside the headline; `lead` a sentence under the title."""

    kicker: str
    title: str
    lead: str
    summary: list[Block]
    sections: list[Section]
    hero: Slider | None = None
    foot: str = ""

    @property
    def scripted(self) -> bool:
        """Whether anything on the page moves: a page of pictures alone carries no script."""
        kinds = {block.kind for part in (self.summary, *(s.blocks for s in self.sections)) for block in part}
        return self.hero is not None or not kinds.isdisjoint({"sliders", "plots", "table"})


def write_page(path: Path, page: Page) -> Path:
    """Write the page as one file that needs no other; returns its path."""
    parts = files("pipeline.report")
    style, script = (parts.joinpath(name).read_text() for name in ("style.css", "page.js"))
    atomic_write(path, template().render(page=page, style=style, script=script).lstrip())
    return path


@cache
def template() -> Any:
    """page.html. What is inserted is text, not HTML, unless page.html says otherwise."""
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    return environment.from_string(files("pipeline.report").joinpath("page.html").read_text())
