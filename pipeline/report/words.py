"""Numbers and names as a page says them."""

from __future__ import annotations

import math
import shlex
from pathlib import Path
from typing import Any

from pipeline.cells import decimal, title_of

UNITS = {"psnr": "dB"}
LONG = 60  # characters of a photo's name


def number(value: Any, metric: str = "") -> str:
    """A score with its metric's decimals; words for what is not finite."""
    if value is None:
        return "-"
    if math.isnan(value):
        return "not a number"
    return decimal(value, metric) if math.isfinite(value) else ("∞" if value > 0 else "-∞")


def between(pair: tuple[float, float] | None, metric: str) -> str:
    """An interval."""
    return f"{number(pair[0], metric)} to {number(pair[1], metric)}" if pair else "no interval"


def scored(value: Any, metric: str) -> str:
    """PSNR 20.36 dB."""
    return f"{title_of(metric)} {number(value, metric)}{' ' + UNITS[metric] if metric in UNITS else ''}"


def short(name: str) -> str:
    """A name that fits a caption: the middle of a long one is left out."""
    return name if len(name) <= LONG else f"{name[: LONG // 2]}…{name[-LONG // 3 :]}"


def count(n: int, one: str, many: str = "") -> str:
    """1 photo, 2 photos; thousands are parted."""
    return f"{n:,} {one if n == 1 else many or f'{one}s'}"


def shell(*words: str | Path) -> str:
    """A command line of ours."""
    return shlex.join(["crossray", *map(str, words)])
