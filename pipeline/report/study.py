"""The report of a study: its tables, how the variants differ in each metric, and the same views by each of them."""

from __future__ import annotations

import os
import statistics
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from pydantic import ValidationError

from pipeline.bootstrap import interval
from pipeline.cells import METRICS, title_of
from pipeline.checkpoint import folder_name
from pipeline.errors import CrossrayError
from pipeline.photos import Photos, open_photos
from pipeline.provenance import provenance
from pipeline.report.album import Album
from pipeline.report.blocks import Block, Cell, Code, Dots, Grid, Note, Page, Section, Shot, Table, write_page
from pipeline.report.dots import Numbers, make_dots
from pipeline.report.gallery import spread
from pipeline.report.recorded import read_json
from pipeline.report.run import as_yaml, read_picture
from pipeline.report.words import count, number, scored, shell, short
from pipeline.results import Study
from pipeline.study import Run, StudyJob, expand
from pipeline.study_tables import Table as StudyTable
from pipeline.study_tables import captions, make_tables
from pipeline.truth import truth_of

VIEWS = 4
SIDE = 320  # pixels of a picture, at most
REPORT = "report.html"
OVER_SEEDS = "A dot is a run, the line the mean over seeds, the bar one sample standard deviation on each side."
OVER_PHOTOS = (
    "A dot is a run, the line the mean over seeds, the bar the 95 % interval of the mean over test photos (bootstrap)."
)

Result = dict[str, Any]  # a run in study.json


def write_study_report(folder: Path, out: Path) -> Path:
    """The report of a study's folder as the file `out`; returns its path.

    Raises:
        CrossrayError: its study.json is damaged, or of another version.
    """
    study, results, failures = read_study(folder)
    runs, album = expand(study, str(folder / "study.json")), Album()
    sections = [Section("tables", "Results", " ".join(captions(study)), table_blocks(study, runs, results))]
    sections.append(Section("charts", "How the variants differ", "", chart_blocks(study, results), beside=True))
    pictures = [block for scene in study.scenes for block in picture_blocks(study, scene, folder, results, album)]
    sections.append(
        Section(
            "pictures",
            "The same views by each variant",
            "Of each variant the first seed that is done.",
            pictures or [Note("No run has been evaluated, so there are no pictures.")],
        )
    )
    sections.append(Section("runs", "Runs", "", run_blocks(folder, out, runs, results, failures)))
    record = study.model_dump(mode="json")
    origin: list[Block] = [Code("The study", as_yaml(record)), Code("What made this page", as_yaml(provenance()))]
    sections.append(Section("provenance", "Where it came from", "", origin))
    sizes = [count(len(study.variants), "variant"), count(len(study.scenes), "scene"), count(len(runs), "run")]
    lead = f"{', '.join(sizes)}, {len(results)} done{f', {len(failures)} failed' if failures else ''}."
    return write_page(out, Page("Crossray, report of a study", study.name, lead, [], sections, foot=album.foot))


def read_study(folder: Path) -> tuple[StudyJob, list[Result], dict[str, str]]:
    """What study.json holds: the study, the runs that are done, and why others are not."""
    record = read_json(folder / "study.json")
    try:
        assert record is not None
        study = Study.model_validate(record).study
        assert all(isinstance(run["seconds"], int | float) for run in record["runs"])
        assert all(isinstance(p["mean"], dict) for run in record["runs"] for p in run["protocols"].values())
        return study, list(record["runs"]), dict(record["failures"])
    except (AssertionError, AttributeError, KeyError, TypeError, ValueError, ValidationError) as error:
        raise CrossrayError(
            f"{folder / 'study.json'}: cannot be read ({type(error).__name__}); `crossray run` with the study's job "
            "file writes it anew"
        ) from None


# ------------------------------------------------------------------------------------------------- tables and charts


def table_blocks(study: StudyJob, runs: Sequence[Run], results: Sequence[Result]) -> list[Block]:
    """The study's own tables."""
    return [as_block(table) for table in make_tables(study, runs, results)]


def as_block(table: StudyTable) -> Table:
    """A study's table on a page."""
    rows = [[Cell(cell.text, strong=cell.best) for cell in row] for row in table.rows]
    return Table(table.title, table.header, rows, [False, *(True for _ in table.header[1:])])


def chart_blocks(study: StudyJob, results: Sequence[Result]) -> list[Block]:
    """A chart each scene, protocol and metric."""
    blocks: list[Block] = []
    for scene, protocol in pairs(study, results):
        there = [r for r in results if r["scene"] == scene and protocol in r["protocols"]]
        metrics = dict.fromkeys(m for r in there for m in r["protocols"][protocol]["mean"])
        for metric in metrics:
            made = chart(f"{title_of(metric)}, {scene}, {protocol}", study, there, protocol, metric)
            blocks += [made] if made else []
    return blocks or [Note("No run has been evaluated, so nothing can be compared.")]


def pairs(study: StudyJob, results: Sequence[Result]) -> Iterator[tuple[str, str]]:
    """Scenes and the protocols that their runs were evaluated under."""
    for scene in study.scenes:
        for protocol in dict.fromkeys(p for r in results if r["scene"] == scene for p in r["protocols"]):
            yield scene, protocol


def chart(title: str, study: StudyJob, results: Sequence[Result], protocol: str, metric: str) -> Dots | None:
    """A metric of the variants. The bars are all over seeds, or all over photos."""
    by_variant: dict[str, list[Result]] = {name: [] for name in study.variants}
    for result in results:
        if result["protocols"][protocol]["mean"].get(metric) is not None:
            by_variant[result["variant"]].append(result)
    by_variant = {name: found for name, found in by_variant.items() if found}
    seeds = all(len(found) > 1 for found in by_variant.values())
    rows = []
    for name, found in by_variant.items():
        means = [float(r["protocols"][protocol]["mean"][metric]) for r in found]
        mean = float(np.mean(means))
        if seeds:
            deviation = statistics.stdev(means) if np.isfinite(means).all() else 0.0
            bar = (mean - deviation, mean + deviation) if np.isfinite(mean) else None
        else:
            bar = over_photos(found, protocol, metric)
        words = [(f"seed {r['seed']}", m) for r, m in zip(found, means, strict=True)]
        rows.append(Numbers(name, words, mean, bar, number(mean, metric)))
    return make_dots(title, OVER_SEEDS if seeds else OVER_PHOTOS, rows)


def over_photos(found: Sequence[Result], protocol: str, metric: str) -> tuple[float, float] | None:
    """The 95 % interval over photos of the mean over seeds."""
    images = [{row["key"]: row.get(metric) for row in r["protocols"][protocol]["images"]} for r in found]
    keys = [key for key in images[0] if all(one.get(key) is not None for one in images)]
    return interval([float(np.mean([one[key] for one in images])) for key in keys])


# ---------------------------------------------------------------------------------------------------------- pictures


def picture_blocks(study: StudyJob, scene: str, folder: Path, results: Sequence[Result], album: Album) -> list[Block]:
    """A grid each protocol: a column a test view; its photo, the truth where it is another, and each variant's."""
    blocks: list[Block] = []
    for _, protocol in (pair for pair in pairs(study, results) if pair[0] == scene):
        first: dict[str, Result] = {}
        for name in study.variants:
            mine = [r for r in results if (r["scene"], r["variant"]) == (scene, name) and protocol in r["protocols"]]
            first |= {name: min(mine, key=lambda r: r["seed"])} if mine else {}
        images = next(iter(first.values()))["protocols"][protocol]["images"]
        rows = spread(images, VIEWS)
        lines = truth_lines(study, scene, protocol, next(iter(first.values())), rows, album)
        lines += [variant_line(name, result, folder, protocol, rows, album) for name, result in first.items()]
        heads = [Shot(""), *(Shot(short(row["name"])) for row in rows)]
        blocks.append(Grid(f"{scene}, {protocol}", heads, lines))
    return blocks


def variant_line(
    name: str, result: Result, folder: Path, protocol: str, rows: Sequence[dict[str, Any]], album: Album
) -> list[Shot]:
    """A variant's pictures with their scores."""
    scores = {row["key"]: row for row in result["protocols"][protocol]["images"]}
    pictures = folder / run_name(result) / "eval" / protocol / folder_name(result["steps"])
    shots = [Shot(name)]
    for row in rows:
        picture, mine = read_picture(pictures / f"{Path(row['key']).name}.png"), scores.get(row["key"], {})
        words = ", ".join(scored(mine[m], m) for m in METRICS[:1] if m in mine)
        alt = f"{row['name']} by {name}"
        shots.append(Shot(words, album.add(picture, alt, SIDE)) if picture is not None else Shot("no picture"))
    return shots


def truth_lines(
    study: StudyJob, scene: str, protocol: str, result: Result, rows: Sequence[dict[str, Any]], album: Album
) -> list[list[Shot]]:
    """The photos, and the views without tourists where these are scored against; nothing where they are not at hand."""
    job = next(run.job for run in expand(study) if run.scene == scene)
    try:
        photos = open_photos(job.shards)
    except (CrossrayError, OSError):
        return []
    indices = {record.key: i for i, record in enumerate(photos.records)}
    lines = [[Shot("photo"), *(photo_shot(photos, indices.get(row["key"]), album) for row in rows)]]
    if result["protocols"][protocol].get("definition", {}).get("truth") != "clean":
        return lines
    try:
        landmark = truth_of(job, photos)
    except (CrossrayError, OSError):
        return lines
    clean = [landmark.truth(row["name"], row["name"]) for row in rows]
    shots = [Shot("", album.add(p, f"truth of {row['name']}", SIDE)) for p, row in zip(clean, rows, strict=True)]
    return [*lines, [Shot("truth"), *shots]]


def photo_shot(photos: Photos, index: int | None, album: Album) -> Shot:
    """A photo, if the shards have it."""
    if index is None:
        return Shot("not in the shards")
    return Shot("", album.add(photos.image(index), f"photo {photos.records[index].name}", SIDE))


# -------------------------------------------------------------------------------------------------------------- runs


def run_name(result: Result) -> str:
    """The folder of a run in its study."""
    return f"{result['scene']}.{result['variant']}.seed{result['seed']}"


def run_blocks(
    folder: Path, out: Path, runs: Sequence[Run], results: Sequence[Result], failures: dict[str, str]
) -> list[Block]:
    """Every run: what it took, or why it is not done; a link to its own report where that is there."""
    done = {run_name(result): result for result in results}
    lines, unreported = [], None
    for run in runs:
        name = run.job.name
        result, report = done.get(name), folder / name / REPORT
        if result is not None and not report.is_file():
            unreported = unreported or folder / name
        href = quote(os.path.relpath(report, out.parent)) if report.is_file() else ""
        state = "done" if result else failures.get(name, "not done")
        numbers = [result["steps"], result["seconds"]] if result else [None, None]
        lines.append(
            [
                Cell(name, name, href=href),
                Cell(state, state),
                Cell(number(numbers[0], "steps"), numbers[0]),
                Cell(number(numbers[1], "seconds"), numbers[1]),
                Cell(result["device"] if result else "-", result["device"] if result else None),
            ]
        )
    titles = ["run", "state", "steps", "training seconds", "on"]
    blocks: list[Block] = [Table("", titles, lines, [False, False, True, True, False], [True] * len(titles))]
    if len(done) < len(runs):
        blocks.append(Note("Not every run is done. Running the study's job file again goes on with them."))
    if unreported:
        blocks.append(Note("A run's own report is linked here once it is made:", shell("report", unreported)))
    return blocks
