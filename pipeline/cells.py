"""What stands in a table, as text: metrics and their decimals, and names that come from files made harmless."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import NamedTuple

METRICS = ("psnr", "ssim", "lpips")  # in this order, before all others
BETTER = {"psnr": max, "ssim": max, "lpips": min, "mask_iou": max}  # others are shown, and nothing is called best
DECIMALS = {"psnr": 2, "ssim": 4, "lpips": 4, "seconds": 0, "steps": 0}  # others: 3


class Cell(NamedTuple):
    """A text, and whether it is the best of what it is compared with; `small`: it is beside the point of its cell."""

    text: str
    best: bool = False
    small: bool = False


def title_of(metric: str) -> str:
    """psnr -> PSNR, mask_iou -> mask IoU."""
    return metric.upper() if metric in METRICS else metric.replace("_", " ").replace("iou", "IoU")


def decimal(value: float | None, metric: str, fewer: int = 0) -> str:
    """A number with the metric's decimals, or `fewer` than these; - where there is none."""
    return "-" if value is None else f"{value:.{DECIMALS.get(metric, 3) - fewer}f}"


def bold(cell: Cell) -> str:
    """A cell in Markdown."""
    return f"**{cell.text}**" if cell.best else cell.text


def row_of(cells: Iterable[str]) -> str:
    """A row of a Markdown table."""
    return f"| {' | '.join(cells)} |"


def markdown(text: str) -> str:
    """A text that Markdown shows as it is, on one line, in a table too: what is special there is written as an HTML
    entity. Underscores inside words and brackets that begin no link are not special."""
    special = r"[&<>|*`\\~$]|(?<!\w)_|_(?!\w)|\](?=[(\[:])"
    return re.sub(special, lambda found: f"&#{ord(found[0])};", " ".join(text.split()))


def code(text: str) -> str:
    """A text as code in Markdown, on one line, outside tables; its fence is longer than any run of backticks in it."""
    line = " ".join(text.split())
    fence = "`" * (1 + max((len(run) for run in re.findall("`+", line)), default=0))
    space = " " if line.startswith("`") or line.endswith("`") else ""
    return f"{fence}{space}{line}{space}{fence}"
