"""Tables that the paper does not have: many appearances, costs, the race of the presets, flicker, operations.

Each shows a record as a benchmark wrote it; what is not there is not shown.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Any

from pipeline.bootstrap import interval, paired_interval
from pipeline.cells import Cell
from pipeline.paper_tables import LABELS
from pipeline.records import Other, Results, Timed
from pipeline.tables import NONE, Entry, Head, Row, Table, fitted_tables, score_tables
from pipeline.time_tables import common_lines, head_of, label_of, lines_in, place_of, time_tables

log = logging.getLogger("crossray")


def all_tables(found: Results) -> list[Table]:
    """Everything: the paper's seven tables in its order, then those beyond it."""
    return [
        *score_tables(found.scores),
        *time_tables(found.times),
        *fitted_tables(found.scores),
        *beyond_tables(found.times, found.others),
    ]


def beyond_tables(times: Sequence[Timed], others: dict[str, Other]) -> list[Table]:
    """What was measured beyond the paper. A record that is not as its benchmark writes it is left out and warned of."""
    makers: dict[str, Callable[[Other], list[Table]]] = {
        "appearances": bars,
        "race": race,
        "flicker": flicker,
        "overheads": overheads,
    }
    tables = [*appearances(times), *cost(times)]
    for name, make in makers.items():
        if name not in others:
            continue
        try:
            tables += make(others[name])
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            file = others[name].source.file
            log.warning("%s: left out of the tables: %s: %s", file, type(error).__name__, error)
    return [table._replace(title=f"Beyond the paper: {table.title}") for table in tables]


def appearances(times: Sequence[Timed]) -> list[Table]:
    """Images a second against the number of images that share a view."""
    found = [timed for timed in times if timed.row.table == "appearances"]
    places = list(dict.fromkeys(place_of(t.row)._replace(appearances=None) for t in found))
    tables = []
    for place in places:
        here = [t for t in found if place_of(t.row)._replace(appearances=None) == place]
        counts = sorted({t.row.appearances or 1 for t in here})
        rows = []
        for line in lines_in(here):
            entries = [per_second([t for t in here if key_of(t) == (*line, count)]) for count in counts]
            rows.append(Row(label_of(line), True, tuple(entries)))
        heads = heads_of(*(f"{count} image{'s' * (count > 1)}" for count in counts))
        title = f"images a second of one view, R/{place.downscale}, {head_of(place).lines[1]}"
        text = (
            "Each image in another appearance. A single one is what each of many would cost if it were rendered anew. "
            f"{place.width} × {place.height} pixels, {place.precision}."
        )
        tables.append(Table(title, text, heads, tuple(rows), "method"))
    return tables


def key_of(timed: Timed) -> tuple[str, str, int]:
    """Method, field and number of images."""
    return timed.row.method, timed.row.field, timed.row.appearances or 1


def per_second(found: Sequence[Timed]) -> Entry:
    """Images a second, by the newest."""
    if not found:
        return NONE
    *others, chosen = sorted(found, key=lambda timed: timed.source.date or "")
    row = chosen.row
    rate = 1 / row.seconds
    lines = (Cell(f"{rate:,.0f}" if rate >= 100 else f"{rate:.3g}"), Cell(row.how, small=True), *common_lines(row))
    return Entry("ours", lines, (chosen.source,), tuple(timed.source for timed in others))


def cost(times: Sequence[Timed]) -> list[Table]:
    """What a step or an image costs against one thing that differs."""
    found = [timed for timed in times if timed.row.table == "cost"]
    if not found:
        return []
    newest: dict[tuple[object, ...], Timed] = {}
    for timed in sorted(found, key=lambda timed: timed.source.date or ""):
        row = timed.row
        newest[(place_of(row), row.method, row.field, row.varied)] = timed
    rows = []
    for timed in sorted(newest.values(), key=found.index):
        row = timed.row
        pixels = (row.width or 0) * (row.height or 0)
        value = {"rays": row.rays, "photos": row.photos, "pixels": pixels}[row.varied or "rays"] or 0
        seconds = (
            Cell(
                f"{row.seconds:.3g} s {'an' if row.unit == 'image' else 'a'} {row.unit} [{row.low:.3g}, {row.high:.3g}]"
            ),
            *common_lines(row),
        )
        each = Cell(f"{1e6 * row.seconds / (row.rays or pixels):,.0f}") if row.rays or pixels else Cell("-")
        machine = Cell(f"{row.device}, {row.precision}")
        cells = [(Cell(f"{value:,} {row.varied or 'rays'}"),), seconds, (each,), (machine,)]
        entries = tuple(Entry("ours", lines, (timed.source,)) for lines in cells)
        rows.append(Row(label_of((row.method, row.field)), True, entries))
    heads = heads_of("against", "median [quartiles]", "microseconds a ray", "device")
    return [Table("cost against rays, photos, pixels", "One thing differs at a time.", heads, tuple(rows), "method")]


def race(other: Other) -> list[Table]:
    """The fast preset in a fiftieth of the faithful one's time (benchmarks/race.py)."""
    runs = {name: other.content[name] for name in ("crnerf", "crossray") if isinstance(other.content.get(name), dict)}
    rows = []
    for name, run in runs.items():
        budget = f"{run['seconds']:,.0f} s on {run['training']['ranks']} cores"
        texts = [budget, f"{run['training']['steps']:,}", mean_of(run["images"])]
        rows.append(Row(LABELS[name], True, entries_of([*texts, f"step {run['best_step']:,}"], other)))
    heads = heads_of("training", "steps", "best validation PSNR", "reached at")
    text = "Landmark, 8 validation photos against the clean truth (`benchmarks/race.py`)."
    if len(runs) == 2:
        found = paired_interval(runs["crossray"]["images"], runs["crnerf"]["images"])
        if found is not None:
            text += f" crossray less CR-NeRF, photo by photo: between {found[0]:.2f} and {found[1]:.2f} dB (95 %)."
    title = "the fast preset against the faithful one"
    return [Table(title, text, heads, tuple(rows), "method")]


def overheads(other: Other) -> list[Table]:
    """What operations cost (benchmarks/overheads.py), as it is recorded."""
    kept = {key: value for key, value in other.content.items() if key not in ("machine", "provenance")}
    rows = [
        Row(name, True, entries_of([number(value)], other))
        for name, value in flat(kept)
        if isinstance(value, int | float)
    ]
    text = "What the operations cost (`benchmarks/overheads.py`)."
    return [Table("operations", text, heads_of("measured"), tuple(rows), "what")]


def bars(other: Other) -> list[Table]:
    """Many appearances and both presets, side by side in one run (benchmarks/appearances.py)."""
    rows = []
    for bar in other.content["bars"]:
        texts = (f"{bar['measured']:.3g}", str(bar["wanted"]), "met" if bar["met"] else "missed")
        rows.append(Row(str(bar["bar"]), True, entries_of(texts, other)))
    text = "Side by side in one run, on one thread (`benchmarks/appearances.py`)."
    return [Table("many appearances, and the presets", text, heads_of("measured", "wanted", ""), tuple(rows), "what")]


def flicker(other: Other) -> list[Table]:
    """How steady a colour is along a camera path, by statistics policy (benchmarks/flicker.py)."""
    runs = other.content["runs"]
    drifts = list(dict.fromkeys(key for run in runs for key in run["truth"]))
    protocols = list(dict.fromkeys(name for run in runs for name in run["psnr"]))
    rows = []
    for run in runs:
        for policy, drift in {**run["flicker"], "truth": run["truth"]}.items():
            psnr = [run["psnr"].get(name, {}).get(policy) for name in protocols]
            texts = [number(drift.get(key)) for key in drifts] + [mean_of(values) for values in psnr]
            label = f"{run['run']}, " + ("the truth itself" if policy == "truth" else f"statistics: {policy}")
            rows.append(Row(label, True, entries_of(texts, other)))
    text = (
        "How a surface point's colour drifts along a camera path in one appearance, in 8-bit levels "
        "(`benchmarks/flicker.py`): from frame to frame, and the standard deviation of a point; less is steadier."
    )
    heads = heads_of(*(f"drift: {key}" for key in drifts), *(f"PSNR, {name}" for name in protocols))
    return [Table("flicker by statistics policy", text, heads, tuple(rows), "run")]


def mean_of(values: Sequence[float] | None) -> str:
    """PSNR: mean [interval]; - where there is none."""
    if not values:
        return "-"
    found = interval(values)
    return f"{sum(values) / len(values):.2f}" + ("" if found is None else f" [{found[0]:.1f}, {found[1]:.1f}]")


def heads_of(*titles: str) -> tuple[Head, ...]:
    """Heads of columns of ours."""
    return tuple(Head("ours", (title,)) for title in titles)


def entries_of(texts: Sequence[str], other: Other) -> tuple[Entry, ...]:
    """Cells of one record."""
    return tuple(Entry("ours", (Cell(text),), (other.source,)) for text in texts)


def flat(value: Any, prefix: str = "") -> list[tuple[str, Any]]:
    """The leaves of nested records, by readable names."""
    if isinstance(value, dict):
        return [leaf for key, inner in value.items() for leaf in flat(inner, f"{prefix}{str(key).replace('_', ' ')}, ")]
    if isinstance(value, list):
        return [leaf for inner in value for leaf in flat(inner, f"{prefix}{named(inner)}")]
    return [(prefix.removesuffix(", "), value)]


def named(value: Any) -> str:
    """What a record in a list calls itself."""
    return f"{value['method']}, " if isinstance(value, dict) and "method" in value else ""


def number(value: Any) -> str:
    """A number with four digits, or what there is instead; - for nothing."""
    if isinstance(value, float):
        return f"{value:.4g}"
    if value is None:
        return "-"
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else str(value)
