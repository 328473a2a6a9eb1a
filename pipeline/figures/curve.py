"""The figure of rays of a study: scores over the number of rays that share their statistics, published ones beside."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pipeline.cells import METRICS, title_of
from pipeline.errors import CrossrayError
from pipeline.figures.draw import axes_at, blank, ticks
from pipeline.figures.layout import COLUMN, TEXT, Box
from pipeline.published import published_tables
from pipeline.study import StudyJob, expand, make_study
from pipeline.study_tables import Spread, spread

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")  # told apart by who sees no red or green, too (Okabe and Ito)
MARKS = "osD^"
ABREAST, HEIGHT = 4, 1.85  # charts in a row; inches of one
ARROWS = {"psnr": "PSNR [dB] ↑", "ssim": "SSIM ↑", "lpips": "LPIPS ↓"}


class Curve(NamedTuple):
    """Scores over numbers of rays, rising; those of others are marked as theirs."""

    name: str
    rays: list[int]
    scores: list[Spread]
    published: bool = False


class Chart(NamedTuple):
    """Axes of one metric."""

    metric: str
    curves: list[Curve]


class Score(NamedTuple):
    """The mean scores of one run, metric -> value."""

    scene: str
    rays: int
    mean: dict[str, float]


class Studied(NamedTuple):
    """A study's folder, read: what was scored under one protocol."""

    study: StudyJob
    protocol: str
    scores: list[Score]
    runs: list[dict[str, str]]  # run, checkpoint_sha256


def read_study(folder: Path) -> Studied:
    """The results of a study, and the protocol that is shown: the first of those that all its runs have in common.

    Raises:
        CrossrayError: no study, nothing evaluated, or no two runs differ in patch.size.
    """
    file = folder / "study.json"
    try:
        record = json.loads(file.read_text())
        study, results = make_study(record["study"], source=str(file)), list(record["runs"])
        rays = rays_of(study)
        protocols = [list(result["protocols"]) for result in results]
        common = [p for p in protocols[0] if all(p in others for others in protocols)] if protocols else []
        scores = [Score(r["scene"], rays[r["variant"]], r["protocols"][p]["mean"]) for p in common[:1] for r in results]
        runs = [{key: r[key] for key in ("run", "checkpoint_sha256")} for r in results]
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise CrossrayError(f"{file}: cannot be read as a study's results ({type(error).__name__}: {error})") from error
    if not scores:
        raise CrossrayError(f"{file}: no protocol under which all its runs were evaluated; run the study to its end")
    if len({score.rays for score in scores}) < 2:
        raise CrossrayError(f"{file}: no two of its runs differ in patch.size; jobs/num_rays.yaml is such a study")
    return Studied(study, common[0], scores, runs)


def rays_of(study: StudyJob) -> dict[str, int]:
    """Variant -> rays that share their statistics: those of one patch."""
    return {run.variant: run.job.patch.size**2 for run in expand(study)}


def charts_of(studied: Studied) -> list[Chart]:
    """A chart each metric, a curve each scene; published numbers of one of these scenes in it as another curve, those
    of other scenes, which are not comparable, in a chart of their own.
    """
    study, charts = studied.study, []
    table = published_tables()[study.published] if study.published else {}
    rays = rays_of(study)
    theirs = [Score(scene, rays[v], mean) for v in rays for scene, mean in table.get(v, {}).items()]
    here = [score for score in theirs if score.scene in study.scenes]
    elsewhere = [score for score in theirs if score.scene not in study.scenes]
    for metric in METRICS:
        ours = curves_of(studied.scores, metric, "{}")
        if ours:
            charts.append(Chart(metric, [*ours, *curves_of(here, metric, "{}, published", True)]))
        beside = curves_of(elsewhere, metric, "{}, published", True)
        if beside:
            charts.append(Chart(metric, beside))
    return charts


def curves_of(scores: Sequence[Score], metric: str, name: str, published: bool = False) -> list[Curve]:
    """A curve each scene that has this metric, over seeds; `name` takes the scene's."""
    values: dict[str, dict[int, list[float]]] = {}
    for score in scores:
        if score.mean.get(metric) is not None:
            values.setdefault(score.scene, {}).setdefault(score.rays, []).append(score.mean[metric])
    curves = []
    for scene, found in values.items():
        spreads = [spread(found[rays]) for rays in sorted(found)]
        curves.append(Curve(name.format(scene), sorted(found), [s for s in spreads if s is not None], published))
    return curves


def draw_charts(charts: Sequence[Chart]) -> Figure:
    """Charts side by side: one in a column's width, more across both, in rows of ABREAST."""
    width, columns = (COLUMN, 1) if len(charts) == 1 else (TEXT, min(ABREAST, len(charts)))
    figure = blank(width, HEIGHT * -(-len(charts) // columns))
    each = width / columns
    for number, chart in enumerate(charts):
        row, column = divmod(number, columns)
        axes = axes_at(figure, Box(column * each + 0.47, row * HEIGHT + 0.2, each - 0.54, HEIGHT - 0.56))
        for place, curve in enumerate(chart.curves):
            colour = COLOURS[place % len(COLOURS)] if not curve.published else "#777777"
            axes.errorbar(
                curve.rays,
                [score.mean for score in curve.scores],
                [score.sd or 0 for score in curve.scores] if any(score.sd for score in curve.scores) else None,
                label=curve.name,
                color=colour,
                marker=MARKS[place % len(MARKS)],
                markerfacecolor="white" if curve.published else colour,
                linestyle="--" if curve.published else "-",
                elinewidth=0.7,
                capsize=1.5,
            )
        axes.set_xlabel("rays that share their statistics")
        axes.set_ylabel(ARROWS.get(chart.metric, title_of(chart.metric)))
        axes.set_xscale("function", functions=(np.sqrt, np.square))  # by the side of a patch
        axes.set_xticks(sorted({rays for curve in chart.curves for rays in curve.rays}))
        axes.yaxis.set_major_locator(ticks(5))
        axes.margins(0.06, 0.12)
        axes.legend(loc="lower left", bbox_to_anchor=(0, 1), borderaxespad=0, ncols=2, handlelength=2)
    return figure
