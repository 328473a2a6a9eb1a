"""What a run looks like: report.html, one self-contained page for a browser or a phone, and its pictures as a PNG."""

from __future__ import annotations

import base64
import html
import io
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
from PIL import Image

from pipeline.files import atomic_file, atomic_write

matplotlib.use("Agg")
from matplotlib import pyplot as plt

STYLE = """
:root { color-scheme: light dark; --line: #8884; }
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 1500px; padding: 0 1rem; }
h1 { font-size: 1.5rem; margin-bottom: 0; } h2 { font-size: 1rem; margin: 1.6rem 0 .4rem; font-weight: 600; }
table { border-collapse: collapse; margin: 1rem 0; } td, th { padding: .2rem .9rem .2rem 0; text-align: left; }
tr { border-bottom: 1px solid var(--line); } td:nth-child(2) { font-variant-numeric: tabular-nums; font-weight: 600; }
.row { display: grid; grid-template-columns: repeat(auto-fit, minmax(150px, 1fr)); gap: .5rem; }
figure { margin: 0; } img { width: 100%; image-rendering: pixelated; border-radius: 3px; display: block; }
figcaption { font-size: .8rem; opacity: .75; padding: .15rem 0; }
"""


@dataclass(frozen=True)
class Row:
    """One view: a title and named uint8 pictures, (h, w, 3) or (h, w)."""

    title: str
    pictures: dict[str, np.ndarray]


def write_report(path: Path, title: str, scores: list[tuple[str, str, str]], rows: list[Row]) -> Path:
    """Write the page; returns its path.

    Args:
        title: the heading.
        scores: name, value, and what it is.
        rows: the pictures.
    """
    table = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in line) + "</tr>" for line in scores)
    views = "".join(
        f"<h2>{html.escape(row.title)}</h2><div class=row>"
        + "".join(figure(caption, picture) for caption, picture in row.pictures.items())
        + "</div>"
        for row in rows
    )
    page = (
        "<!doctype html><html lang=en><meta charset=utf-8>"
        "<meta name=viewport content='width=device-width, initial-scale=1'>"
        f"<title>{html.escape(title)}</title><style>{STYLE}</style>"
        f"<h1>{html.escape(title)}</h1><table>{table}</table>{views}</html>"
    )
    atomic_write(path, page)
    return path


def write_overview(path: Path, rows: list[Row]) -> Path:
    """The pictures of the rows as one PNG, a column each kind; returns its path."""
    titles = list(rows[0].pictures)
    shape = (len(rows), len(titles))
    figure, axes = plt.subplots(*shape, figsize=(2 * shape[1], 1.6 * shape[0]), squeeze=False, layout="constrained")
    for row, line in zip(rows, axes, strict=True):
        for axis, picture in zip(line, row.pictures.values(), strict=True):
            axis.imshow(picture, cmap="gray", vmin=0, vmax=255)
            axis.set_axis_off()
    for axis, title in zip(axes[0], titles, strict=True):
        axis.set_title(title, fontsize=10)
    with atomic_file(path) as file:
        figure.savefig(file, format="png", dpi=100)
    plt.close(figure)
    return path


def figure(caption: str, picture: np.ndarray) -> str:
    """A captioned picture, its bytes inside the page."""
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, format="PNG", optimize=True)
    data = base64.b64encode(buffer.getvalue()).decode()
    text = html.escape(caption)
    return f"<figure><img alt='{text}' src='data:image/png;base64,{data}'><figcaption>{text}</figcaption></figure>"
