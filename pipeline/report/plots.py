"""Curves as the geometry of a small SVG: page.html draws it, page.js reads numbers off it."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from matplotlib.ticker import LogLocator, MaxNLocator

WIDTH, HEIGHT = 420, 230  # units of the SVG
LEFT, RIGHT, TOP, BOTTOM = 52, 408, 10, 200  # of what is inside the axes
POINTS = 150  # a line, at most
DECADES = (1.5, 7)  # a positive quantity that spans more has a logarithmic axis, which shows so many at most


class Series(NamedTuple):
    """One line: numbers (n,) over steps (n,)."""

    name: str
    steps: np.ndarray
    values: np.ndarray


class Line(NamedTuple):
    """A line as SVG paths. `band` spans the least and greatest number behind each point; empty where that is one."""

    name: str
    path: str
    band: str
    points: list[tuple[float, float]]
    last: str


@dataclass(frozen=True)
class Plot:
    """A chart. `data` is JSON for page.js: of each line the name and [x, y, step, number] of its points."""

    title: str
    note: str
    lines: list[Line]
    x_ticks: list[tuple[float, str]]
    y_ticks: list[tuple[float, str]]
    data: str


class Thinned(NamedTuple):
    steps: np.ndarray
    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray


def make_plot(title: str, series: Sequence[Series], note: str = "") -> Plot | None:
    """A chart of the lines that have a finite number; None where none has.

    Numbers that are not finite are gaps, and the note counts them.
    """
    gaps = sum(int((~np.isfinite(s.values)).sum()) for s in series)
    drawn = [(s.name, thinned(s.steps, s.values)) for s in series if np.isfinite(s.values).any()]
    if not drawn:
        return None
    low, high = min(float(np.nanmin(t.low)) for _, t in drawn), max(float(np.nanmax(t.high)) for _, t in drawn)
    least = min(float(np.nanmin(t.mean)) for _, t in drawn)
    log = least > 0 and math.log10(high / least) > DECADES[0]
    low = max(least, high / 10 ** DECADES[1]) if log else low
    y_ticks = ticks(low, high, log)
    bottom, top = y_ticks[0], y_ticks[-1]
    first, last = (float(f(f(t.steps) for _, t in drawn)) for f in (min, max))
    x_ticks = [x for x in ticks(first, last, False) if first <= x <= last]

    def x_of(step: np.ndarray) -> np.ndarray:
        return LEFT + (RIGHT - LEFT) * (step - first) / max(last - first, 1e-9)

    def y_of(value: np.ndarray) -> np.ndarray:
        part = (
            (np.log10(np.maximum(value, bottom)) - math.log10(bottom)) / (math.log10(top) - math.log10(bottom))
            if log
            else (value - bottom) / (top - bottom)
        )
        return BOTTOM - (BOTTOM - TOP) * part

    lines, data = [], []
    for name, t in drawn:
        x, y = x_of(t.steps), y_of(t.mean)
        band = "" if np.array_equal(t.low, t.high, equal_nan=True) else band_path(x, y_of(t.low), y_of(t.high))
        there = np.flatnonzero(np.isfinite(t.mean))
        points = [(round(float(x[i]), 1), round(float(y[i]), 1)) for i in there]
        lines.append(Line(name, line_path(x, y), band, points, compact(float(t.mean[there[-1]]))))
        numbers = [[*p, int(t.steps[i]), float(f"{t.mean[i]:.4g}")] for p, i in zip(points, there, strict=True)]
        data.append({"name": name, "points": numbers})
    axis = f"Logarithmic axis{f', cut at {compact(bottom)}' if least < bottom else ''}." if log else ""
    words = [note, f"Not finite, and left out: {gaps} numbers." if gaps else "", axis]
    return Plot(
        title,
        " ".join(filter(None, words)),
        lines,
        [(float(at), compact(x)) for at, x in zip(x_of(np.array(x_ticks)), x_ticks, strict=True)],
        [(float(at), compact(y)) for at, y in zip(y_of(np.array(y_ticks)), y_ticks, strict=True)],
        json.dumps(data, allow_nan=False),
    )


def thinned(steps: np.ndarray, values: np.ndarray, most: int = POINTS) -> Thinned:
    """At most `most` points: of as many equal runs of steps the last step, the mean, the least and the greatest of the
    finite numbers; NaN where a run has none."""
    order = np.argsort(steps, kind="stable")
    steps = np.asarray(steps)[order]
    values = np.where(np.isfinite(values), values, np.nan).astype(np.float64)[order]
    parts = np.array_split(np.arange(len(steps)), min(most, len(steps)))
    empty = [bool(np.isnan(values[p]).all()) for p in parts]
    columns = [
        np.array([np.nan if none else f(values[p]) for p, none in zip(parts, empty, strict=True)])
        for f in (np.nanmean, np.nanmin, np.nanmax)
    ]
    return Thinned(np.array([steps[p[-1]] for p in parts]), *columns)


def ticks(low: float, high: float, log: bool) -> list[float]:
    """Round numbers that enclose [low, high]."""
    if log:
        found = np.asarray(LogLocator(numticks=6).tick_values(low, high))
        below, above = found[found <= low], found[found >= high]
        found = found[(found >= below[-1]) & (found <= above[0])]
    else:
        if high - low < 1e-9 * max(abs(low), abs(high), 1e-9):
            pad = abs(low) / 10 or 1.0
            low, high = low - pad, high + pad
        found = np.asarray(MaxNLocator(nbins=5, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high))
    return [float(x) for x in found]


def line_path(x: np.ndarray, y: np.ndarray) -> str:
    """M and L through the points; a gap where y is NaN."""
    words, pen = [], "M"
    for a, b in zip(x, y, strict=True):
        if np.isnan(b):
            pen = "M"
            continue
        words.append(f"{pen}{a:.1f} {b:.1f}")
        pen = "L"
    return "".join(words)


def band_path(x: np.ndarray, low: np.ndarray, high: np.ndarray) -> str:
    """Polygons between the two lines, one each stretch without a gap."""
    words = []
    there = np.flatnonzero(np.isfinite(low))
    for part in np.split(there, np.flatnonzero(np.diff(there) > 1) + 1):
        up = [f"{x[i]:.1f} {high[i]:.1f}" for i in part]
        down = [f"{x[i]:.1f} {low[i]:.1f}" for i in part[::-1]]
        words.append(f"M{'L'.join(up + down)}Z")
    return "".join(words)


def compact(number: float) -> str:
    """A number as short as it can be read: 12340 -> 12.3k, 0.00042 -> 4.2e-4."""
    size = abs(number)
    for unit, scale in (("G", 1e9), ("M", 1e6), ("k", 1e3)):
        if size >= scale:
            return f"{number / scale:.3g}{unit}"
    if size == 0 or size >= 0.001:
        return f"{number:.3g}"
    mantissa, exponent = f"{number:.2g}".split("e") if "e" in f"{number:.2g}" else f"{number:.1e}".split("e")
    return f"{float(mantissa):g}e{int(exponent)}"
