"""`crossray figure`: a figure of the paper for a trained run.

    OUT/<kind>.png    300 dots an inch       (or OUT, where it is the name of a PNG or PDF: both lie beside each other)
        <kind>.pdf    for print: vector text, pictures at their own pixels
        <kind>.json   what it shows: run, step, checkpoint, photos with hashes, a caption; and hashes of both files

The same run and options give the same bytes of PNG and PDF.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from pipeline.checkpoint import MODEL, digest
from pipeline.config import nearest
from pipeline.errors import CrossrayError
from pipeline.figures.appearance import interpolation, transfer, unseen
from pipeline.figures.curve import Studied, charts_of, draw_charts, read_study
from pipeline.figures.depth import depth
from pipeline.figures.draw import draw_sheet, saved, styled
from pipeline.figures.grids import grids
from pipeline.figures.masks import masks
from pipeline.figures.sheet import Composed
from pipeline.files import atomic_write
from pipeline.painter import Painter
from pipeline.provenance import provenance

FORMAT = 1
MOST = 12  # photos, views or columns of a figure
OTHER_FORMATS = (".jpg", ".jpeg", ".svg", ".eps", ".ps", ".webp", ".tif", ".tiff", ".gif")


@dataclass(frozen=True)
class Order:
    """What the user may say of a figure; a field each option of `crossray figure`."""

    photos: tuple[str, ...] = ()
    views: tuple[str, ...] = ()
    appearance: tuple[str, ...] = ()
    columns: int | None = None
    step: int | None = None


class Kind(NamedTuple):
    """How a figure is composed, which fields of an order it has a use for, and of what `columns` is the number where
    the user names none of these.
    """

    compose: Callable[[Painter, Order], Composed]
    takes: tuple[str, ...]
    counted: str | None = None


KINDS = {
    "transfer": Kind(
        lambda p, o: transfer(p, o.photos, o.views, o.columns, o.appearance),
        ("photos", "views", "appearance", "columns", "step"),
        "photos",
    ),
    "unseen": Kind(
        lambda p, o: unseen(p, o.photos, o.views, o.columns), ("photos", "views", "columns", "step"), "photos"
    ),
    "interpolation": Kind(
        lambda p, o: interpolation(p, o.photos, o.views, o.columns), ("photos", "views", "columns", "step")
    ),
    "masks": Kind(lambda p, o: masks(p, o.photos, o.columns), ("photos", "columns", "step"), "photos"),
    "depth": Kind(lambda p, o: depth(p, o.photos, o.views, o.columns), ("photos", "views", "columns", "step"), "views"),
    "rays": Kind(lambda p, o: grids(p, o.columns), ("columns", "step")),
}


def make_figure(kind: str, run: Path, out: Path, order: Order = Order()) -> list[Path]:
    """Make a figure of a run, or `rays` of a study's folder; returns the PNG, the PDF, and the record.

    Args:
        kind: one of KINDS.
        out: a folder, or a file that ends with .png or .pdf.

    Raises:
        CrossrayError: the kind, an option, the run, a photo or `out` cannot be used, the method has no such figure, or
            it does not fit a page. Nothing was written.
    """
    if kind not in KINDS:
        raise CrossrayError(f"figure {kind}: there is no figure of this name{nearest(kind, list(KINDS))}")
    study = kind == "rays" and (run / "study.json").is_file()
    check_order(kind, order, KINDS[kind]._replace(takes=()) if study else KINDS[kind])
    files = files_of(kind, out)
    claim(files, kind)
    with styled():
        if study:
            studied = read_study(run)
            figure = draw_charts(charts_of(studied))
            whose, about = of_study(run, studied)
        else:
            painter = Painter(run, order.step)
            composed = KINDS[kind].compose(painter, order)
            figure = draw_sheet(composed.sheet)
            whose, about = of_run(painter, composed)
        png, pdf = saved(figure, {"Title": f"crossray figure {kind}", "Subject": whose})
    size = [round(float(side), 3) for side in figure.get_size_inches()]
    write(files, {"format": FORMAT, "figure": kind, **about, "inches": size, "provenance": provenance()}, png, pdf)
    return list(files)


def check_order(name: str, order: Order, kind: Kind) -> None:
    """CrossrayError for an option that this figure has no use for, or more pictures than a figure takes."""
    for option, value in vars(order).items():
        if value not in ((), None) and option not in kind.takes:
            use = f"; it takes {', '.join(f'--{t}' for t in kind.takes)}" if kind.takes else ", of a study"
            raise CrossrayError(f"--{option}: figure {name} has no use for it{use}")
    if order.columns is not None and not 1 <= order.columns <= MOST:
        raise CrossrayError(f"--columns {order.columns}: a figure has 1 to {MOST}")
    if order.columns is not None and kind.counted is not None and getattr(order, kind.counted):
        raise CrossrayError(f"--columns {order.columns}: --{kind.counted} names them already; give one of both")
    for what, count in (("views", len(order.views)), ("photos", len(order.photos) + len(order.appearance))):
        if count > MOST:
            raise CrossrayError(f"{count} {what}: a figure takes {MOST}, and is never cut into pages; name fewer")


# ---------------------------------------------------------------------------------------------------------- records


def of_run(painter: Painter, composed: Composed) -> tuple[str, dict[str, Any]]:
    """In words and for the record: which checkpoint a figure is of, and what is on it."""
    sha256 = painter.checkpoint.meta["sha256"][MODEL]
    about = {
        "run": painter.job.name,
        "method": painter.job.method,
        "step": painter.checkpoint.step,
        "checkpoint_sha256": sha256,
        "caption": composed.caption,
        **composed.about,
    }
    return f"run {painter.job.name}, step {painter.checkpoint.step}, checkpoint {sha256}", about


def of_study(folder: Path, studied: Studied) -> tuple[str, dict[str, Any]]:
    """The same of a study."""
    published, protocol = studied.study.published, studied.protocol
    caption = (
        "Scores over the number of rays that share their statistics, mean over seeds with their sample standard "
        f"deviation, under {protocol}."
    )
    if published:
        caption += f" Open marks: published numbers, for their own scenes ({published} in pipeline/published.yaml)."
    about = {
        "study": folder.name,
        "protocol": protocol,
        "published": published,
        "runs": studied.runs,
        "caption": caption,
    }
    return f"study {folder.name}, {protocol}", about


# ------------------------------------------------------------------------------------------------------------ files


class Files(NamedTuple):
    png: Path
    pdf: Path
    record: Path


def files_of(kind: str, out: Path) -> Files:
    """Where a figure's files are."""
    if out.suffix.lower() in OTHER_FORMATS:
        raise CrossrayError(f"--out {out}: a figure is a PNG and a PDF; name one of these, or a folder")
    name = out if out.suffix.lower() in (".png", ".pdf") else out / f"{kind}.png"
    return Files(name.with_suffix(".png"), name.with_suffix(".pdf"), name.with_suffix(".json"))


def claim(files: Files, kind: str) -> None:
    """CrossrayError where one of the files is there and is not of a figure of this kind; one of them is made anew."""
    folder = next(path for path in files.png.parents if path.exists())
    if not folder.is_dir():
        raise CrossrayError(f"--out: {folder} is a file; name a folder, or a PNG or PDF")
    there = next((path for path in files if path.exists()), None)
    if there is None:
        return
    try:
        ours = json.loads(files.record.read_text())["figure"] == kind
    except (OSError, ValueError, KeyError, TypeError):
        ours = False
    if not ours:
        raise CrossrayError(f"{there} is there, and is no figure {kind} of ours; --out names another place")


def write(files: Files, record: dict[str, Any], png: bytes, pdf: bytes) -> None:
    """Write a figure; the record first, so that what is written after it is known to be ours."""
    hashes = {path.name: hashlib.sha256(b).hexdigest() for path, b in ((files.png, png), (files.pdf, pdf))}
    record = record | {"sha256": hashes}
    atomic_write(files.record, json.dumps(record | {"digest": digest(record)}, indent=2) + "\n")
    atomic_write(files.png, png)
    atomic_write(files.pdf, pdf)
