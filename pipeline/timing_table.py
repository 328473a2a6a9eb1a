"""A timing's rows for a terminal: the paper's two tables in their own rows and columns, then those beyond it.

Published numbers stand beside these in `crossray tables`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from rich.table import Table

from pipeline.timing import TimingRow

LEGEND = (
    "~ extrapolated: an image from some of its rays, a schedule from some of its steps. Seconds are medians; an image "
    "is 8-bit on the host, and the reading of its appearance is beside it. Of peak: counted matrix operations a second "
    "against those of a large matrix product in the same precision, measured in the same run."
)

Line = tuple[str, str, tuple[int, int], str]  # method, how, samples, precision


def tables(rows: Sequence[TimingRow]) -> list[Table]:
    """A table each kind of rows that is there."""
    makers = {"inference": inference, "training": training, "appearances": appearances, "cost": cost}
    chosen = {name: [row for row in rows if row.table == name] for name in makers}
    return [makers[name](some) for name, some in chosen.items() if some]


def inference(rows: Sequence[TimingRow]) -> Table:
    """Seconds an image: a single image and multiple images of one view, at each size."""
    many = max(row.appearances or 1 for row in rows)
    sizes = list(dict.fromkeys(row.downscale for row in rows))
    columns = [(count, size) for count in dict.fromkeys((1, many)) for size in sizes]
    titles = [f"{'a single image' if count == 1 else f'{many} images'}, R/{size}" for count, size in columns]
    table = Table("method", "samples", "precision", *titles, "reading an appearance", "of peak", "peak memory")
    table.title = f"Inference: seconds an image ({where(rows)})"
    for line in dict.fromkeys((r.method, r.samples, r.precision) for r in rows):
        found = {(r.appearances, r.downscale): r for r in rows if (r.method, r.samples, r.precision) == line}
        cells = [seconds(found[column]) if column in found else "-" for column in columns]
        largest = found[1, min(size for size in sizes if size)]
        encode = "-" if largest.encode_seconds is None else f"{largest.encode_seconds:.3g} s"
        method, samples, precision = line
        table.add_row(method, plus(samples), precision, *cells, encode, share(largest), memory(largest))
    return table


def training(rows: Sequence[TimingRow]) -> Table:
    """Minutes of the schedule, and the step that they are made of."""
    table = Table("method", "rays", "ranks", "precision", "s a step (quartiles)", "rays a second", "minutes")
    table.add_column("of peak")
    table.add_column("peak memory")
    table.title = f"Training ({where(rows)})"
    for row in rows:
        speed = f"{(row.rays or 0) * row.ranks / row.seconds:,.0f}"
        minutes = "-" if row.minutes is None else f"~{row.minutes:,.0f}"
        step = f"{row.seconds:.3g} ({row.low:.3g} to {row.high:.3g})"
        texts = (str(row.rays), str(row.ranks), row.precision, step, speed, minutes, share(row), memory(row))
        table.add_row(row.method, *texts)
    notes = dict.fromkeys(f"{row.method}: {row.note}." for row in rows if row.note)
    sentences = dict.fromkeys(f"Minutes: {row.extrapolated}." for row in rows[:1] if row.extrapolated)
    table.caption = " ".join([*sentences, *notes]) or None
    return table


def appearances(rows: Sequence[TimingRow]) -> Table:
    """Images a second against the number of images that share a view; rendering each anew is the column of 1."""
    counts = list(dict.fromkeys(row.appearances for row in rows))
    table = Table("method", "an image more is", "samples", "precision", *(f"{count}" for count in counts))
    table.title = f"Images a second of one view, R/{rows[0].downscale}, by their number ({where(rows)})"
    for line in dict.fromkeys((r.method, r.samples, r.precision) for r in rows):
        some = [r for r in rows if (r.method, r.samples, r.precision) == line]
        found = {r.appearances: mark(r) + f"{1 / r.seconds:.3g}" for r in some}
        method, samples, precision = line
        table.add_row(method, some[-1].how, plus(samples), precision, *(found.get(count, "-") for count in counts))
    return table


def cost(rows: Sequence[TimingRow]) -> Table:
    """What a step or an image costs against the one thing that differs."""
    table = Table("method", "against", "value", "of", "seconds (quartiles)", "microseconds a ray", "peak memory")
    table.title = f"Cost ({where(rows)})"
    for row in rows:
        pixels = (row.width or 0) * (row.height or 0)
        value = {"rays": row.rays, "photos": row.photos, "pixels": pixels}[row.varied or "rays"] or 0
        times = f"{mark(row)}{row.seconds:.3g} ({row.low:.3g} to {row.high:.3g})"
        each = f"{1e6 * row.seconds / (row.rays or pixels):.3g}"
        table.add_row(
            row.method, row.varied, f"{value:,}", f"a{'n' * (row.unit == 'image')} {row.unit}", times, each, memory(row)
        )
    return table


def where(rows: Iterable[TimingRow]) -> str:
    """On what the rows were measured."""
    found = dict.fromkeys(
        f"{row.device}, {row.threads} thread{'s' * (row.threads > 1)}" if row.memory_of == "host" else row.device
        for row in rows
    )
    return "; ".join(found)


def seconds(row: TimingRow) -> str:
    """Median and a mark where it is extrapolated."""
    return f"{mark(row)}{row.seconds:.3g} s"


def mark(row: TimingRow) -> str:
    """~ for what was not measured whole."""
    return "~" if row.extrapolated else ""


def plus(samples: tuple[int, int]) -> str:
    """64 + 64."""
    return f"{samples[0]} + {samples[1]}"


def share(row: TimingRow) -> str:
    """Of the measured peak, in per cent."""
    return "-" if row.of_peak is None else f"{100 * row.of_peak:.0f} %"


def memory(row: TimingRow) -> str:
    """Peak memory, whose."""
    return "-" if row.peak_memory_MiB is None else f"{row.peak_memory_MiB:,.0f} MiB"
