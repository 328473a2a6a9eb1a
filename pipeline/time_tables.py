"""The paper's two tables of times, published numbers beside ours.

A column of ours is one device, precision and sample counts; a row is a method on its field.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

from model.methods import METHODS
from pipeline.cells import Cell
from pipeline.paper_tables import FIELDS, LABELS
from pipeline.published import published_times
from pipeline.records import Timed
from pipeline.tables import NONE, Entry, Head, Row, Table
from pipeline.timing import TimingRow

SINGLE = "single"
TITLES = {SINGLE: "a single image", "multiple": "multiple images"}
COUNTED = ("as trained", "as the reference evaluates")
Line = tuple[str, str]  # method, field

INFERENCE = (
    'The paper\'s table "inferencetime": seconds an image on Brandenburg Gate, on one TITAN Xp; it does not say how '
    "many samples a ray, nor how many images the multiple ones are. Ours: the median and its quartiles, without the "
    "reading of the appearance, warm-up left out. Multiple images are of one view, each in another appearance."
)
TRAINING = (
    'The paper\'s table "trainingtime": 20 epochs of 17,200 iterations on 8 TITAN Xp, of 8 × 1,024 rays '
    "each. Ours: as many steps as a column says, extrapolated from measured ones (median and quartiles); with fewer "
    "ranks they see fewer rays in all."
)


class Place(NamedTuple):
    """What the times in a column of ours have in common."""

    device: str
    threads: int
    memory_of: str
    ranks: int
    precision: str
    samples_as: str
    width: int | None
    height: int | None
    downscale: int | None
    appearances: int | None
    photos: int | None
    rays: int | None
    steps: int | None


def time_tables(times: Sequence[Timed]) -> list[Table]:
    """The paper's two tables of times."""
    return [inference(times), training(times)]


def inference(times: Sequence[Timed]) -> Table:
    """Seconds an image."""
    published = published_times()["inference"]
    rows = ["hanerf", "crnerf"]
    columns = [f"{count}-R{size}" for count in TITLES for size in (4, 2)]
    heads = [
        head_published(TITLES[c.split("-")[0]], c.split("-")[1].replace("R", "R/"), "one TITAN Xp") for c in columns
    ]
    entries = [[published_seconds(published.get(row, {}).get(column)) for row in rows] for column in columns]
    ours = [timed for timed in times if timed.row.table == "inference"]
    return with_ours(
        "6. Inference time", INFERENCE, heads, rows, entries, ours, "crossray timing inference", image_lines
    )


def training(times: Sequence[Timed]) -> Table:
    """Minutes of the schedule."""
    published = published_times()["training"]
    rows = ["nerfw", "hanerf", "crnerf"]
    titles = {"epochs": "epochs", "iterations": "iterations an epoch", "minutes": "minutes"}
    heads = [head_published(title, "8 TITAN Xp") for title in titles.values()]
    entries = [[Entry("published", (Cell(f"{published[row][key]:g}"),)) for row in rows] for key in titles]
    ours = [timed for timed in times if timed.row.table == "training"]
    return with_ours("7. Training time", TRAINING, heads, rows, entries, ours, "crossray timing training", step_lines)


def with_ours(
    title: str,
    text: str,
    heads: Sequence[Head],
    rows: Sequence[str],
    published: Sequence[Sequence[Entry]],
    ours: Sequence[Timed],
    command: str,
    lines_of: Callable[[TimingRow], list[Cell]],
) -> Table:
    """Published columns, then ours; rows of ours that the paper does not have are below."""
    wanted = [(row, "mlp") for row in rows]
    lines = [*wanted, *(line for line in lines_in(ours) if line not in wanted)]
    if ("crossray", "hash") not in lines:
        lines.append(("crossray", "hash"))
    places = list(dict.fromkeys(place_of(timed.row) for timed in ours))
    columns = [[*entries, *[NONE] * (len(lines) - len(rows))] for entries in published]
    for place in places:
        there = [timed for timed in ours if place_of(timed.row) == place]
        columns.append([time_entry(line, place, there, lines_of, command) for line in lines])
    all_heads = [*heads, *(head_of(place) for place in places)]
    if not places:
        all_heads.append(Head("ours", ("this machine", "nothing measured yet")))
        columns.append([Entry("lacking", command=command) for _ in lines])
    made = [
        Row(label_of(line), line not in wanted, tuple(column[i] for column in columns)) for i, line in enumerate(lines)
    ]
    return Table(title, text, tuple(all_heads), tuple(made), "method")


def lines_in(times: Sequence[Timed]) -> list[Line]:
    """Methods and fields, in their order."""
    return list(dict.fromkeys((timed.row.method, timed.row.field) for timed in times))


def label_of(line: Line) -> str:
    """A method, with its field where that is not the paper's."""
    method, field = line
    label = LABELS.get(method, method)
    return f"{label}, {FIELDS[field]}" if field == "hash" and method != "crossray" else label


def place_of(row: TimingRow) -> Place:
    """The column that a time belongs into."""
    return Place(
        row.device,
        row.threads,
        row.memory_of,
        row.ranks,
        row.precision,
        row.samples_as,
        row.width,
        row.height,
        row.downscale,
        row.appearances,
        row.photos,
        row.rays,
        row.steps,
    )


def head_of(place: Place) -> Head:
    """What a reader has to know of a column of ours."""
    unit = f", {place.threads} thread{'s' * (place.threads > 1)}" if place.memory_of == "host" else ""
    lines = [f"{place.device}{unit}", place.precision]
    if place.downscale is not None:
        count = place.appearances or 1
        lines.insert(0, f"{'a single image' if count == 1 else f'{count} images of a view'}, R/{place.downscale}")
        lines.append(f"{place.width} × {place.height}")
        lines.append(f"samples {COUNTED[place.samples_as == 'evaluated']}")
    else:
        ranks = f"{place.ranks} rank{'s' * (place.ranks > 1)}"
        lines = [f"{ranks} × {place.rays or 0:,} rays", f"{place.steps or 0:,} steps", *lines, f"{place.photos} photos"]
    return Head("ours", tuple(lines))


def head_published(*lines: str) -> Head:
    """The head of a column of the paper."""
    return Head("published", ("published", *lines))


def published_seconds(value: float | None) -> Entry:
    """The paper's seconds, if it has some."""
    return NONE if value is None else Entry("published", (Cell(f"{value:.2f} s"),))


def time_entry(
    line: Line, place: Place, there: Sequence[Timed], lines_of: Callable[[TimingRow], list[Cell]], command: str
) -> Entry:
    """A cell of ours: the newest of its times."""
    found = sorted(
        (timed for timed in there if (timed.row.method, timed.row.field) == line), key=lambda t: t.source.date or ""
    )
    if not found:
        one_count = line[1] == "hash" and place.samples_as == "evaluated"  # of samples, on the fast field
        known = METHODS.get(line[0])
        one_image = known is not None and known.appearance == "none" and (place.appearances or 1) > 1
        fits = known is not None and known.field == line[1] and not one_count and not one_image
        return Entry("lacking", command=filling(command, line[0], place)) if fits else NONE
    *others, chosen = found
    cells = lines_of(chosen.row)
    notes = [text for text in (chosen.row.extrapolated, chosen.row.note) if text]
    source = replace(chosen.source, notes=(*chosen.source.notes, *notes))
    return Entry("ours", tuple(cells), (source,), tuple(timed.source for timed in others))


def filling(command: str, method: str, place: Place) -> str:
    """The command that times a method as the others of a column were."""
    settings = [f"name=timing-{method}", f"device={'cpu' if place.memory_of == 'host' else 'cuda'}"]
    settings.append(f"precision=[{place.precision}]")
    if place.memory_of == "host":
        settings.append(f"threads={place.threads}")
    if place.downscale is not None:
        count = place.appearances or 1
        many = [f"inference.images={count}", *(["inference.appearances=[1]"] if count == 1 else [])]
        settings += [
            *(f"inference.methods=[{method}]", f"inference.samples=[{place.samples_as}]"),
            *(f"inference.downscales=[{place.downscale}]", *many),
            *(f"width={(place.width or 0) * place.downscale}", f"height={(place.height or 0) * place.downscale}"),
        ]
    else:
        settings += [f"training.methods=[{method}]", f"training.ranks={place.ranks}", f"training.rays={place.rays}"]
        settings.append(f"training.photos={place.photos}")
    return shlex.join([*command.split(), *(word for setting in settings for word in ("--set", setting))])


def image_lines(row: TimingRow) -> list[Cell]:
    """Seconds an image, and how."""
    first = f"{row.seconds:.3g} s [{row.low:.3g}, {row.high:.3g}]"
    how = f"{row.how}, {row.samples[0]} + {row.samples[1]} samples"
    return [Cell(first), Cell(how, small=True), *common_lines(row)]


def step_lines(row: TimingRow) -> list[Cell]:
    """Minutes of the schedule, and a step."""
    minutes = "-" if row.minutes is None else f"{row.minutes:,.0f} min"
    step = f"{row.seconds:.3g} s a step [{row.low:.3g}, {row.high:.3g}]"
    return [Cell(minutes), Cell(step, small=True), *common_lines(row)]


def common_lines(row: TimingRow) -> list[Cell]:
    """Whether it is extrapolated, and memory."""
    memory = (
        [] if row.peak_memory_MiB is None else [Cell(f"{row.peak_memory_MiB:,.0f} MiB ({row.memory_of})", small=True)]
    )
    return [*([Cell("extrapolated")] if row.extrapolated else []), *memory]
