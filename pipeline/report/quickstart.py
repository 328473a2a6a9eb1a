"""The report of the quick start: its scores, and its views beside the truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.report.album import Album
from pipeline.report.blocks import Block, Page, Section, Shot, Slider, Sliders, Strip, Tile, Tiles, write_page

SIDE = 640  # pixels of a picture, at most


@dataclass(frozen=True)
class Row:
    """One view: a title and named uint8 pictures, (h, w, 3) or (h, w).

    `compare` names the two that are laid one over the other: the truth, and what is compared with it.
    """

    title: str
    pictures: dict[str, np.ndarray]
    compare: tuple[str, str] | None = None


def write_report(path: Path, title: str, scores: list[tuple[str, str, str]], rows: list[Row], lead: str = "") -> Path:
    """Write the page; returns its path.

    Args:
        title: the heading.
        scores: name, value, and what it is.
        rows: the pictures; the first row that compares two stands beside the scores.
        lead: a sentence under the heading.
    """
    album = Album()
    shots = [
        {name: Shot(name, album.add(p, f"{row.title}: {name}", SIDE, exact=True)) for name, p in row.pictures.items()}
        for row in rows
    ]
    sliders = [
        Slider(row.title, "", made[row.compare[0]], made[row.compare[1]])
        for row, made in zip(rows, shots, strict=True)
        if row.compare is not None
    ]
    strips: list[Block] = [Strip(row.title, list(made.values())) for row, made in zip(rows, shots, strict=True)]
    sections = [Section("views", "Every view", "", strips)]
    if len(sliders) > 1:
        blocks: list[Block] = [Sliders(sliders[1:])]
        sections.insert(0, Section("compare", "Truth and rendering", "Drag the line, or use the arrow keys.", blocks))
    tiles: list[Block] = [Tiles([Tile(name, value, "", text) for name, value, text in scores])]
    hero = sliders[0] if sliders else None
    return write_page(path, Page("Crossray, report of the quick start", title, lead, tiles, sections, hero, album.foot))
