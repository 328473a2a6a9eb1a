"""The report of a run: what it was, how well it does, how it learned, what it shows, and where all of it came from.

Whatever is not there (no evaluation, no test photos, an unfinished training, shards that were moved) is said, with the
command that makes it; the rest of the page is as it would be.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from PIL import Image

from model.scene_model import SceneModel
from pipeline.cells import METRICS, title_of
from pipeline.checkpoint import MODEL, Checkpoint, folder_name
from pipeline.config import Job
from pipeline.errors import CrossrayError
from pipeline.landmark import Landmark
from pipeline.photos import Photos
from pipeline.provenance import provenance
from pipeline.report.album import Album
from pipeline.report.blocks import (
    Block,
    Cell,
    Code,
    Facts,
    Note,
    Page,
    Picture,
    Plots,
    Section,
    Shot,
    Slider,
    Sliders,
    Table,
    Tile,
    Tiles,
    write_page,
)
from pipeline.report.dots import Numbers, make_dots
from pipeline.report.gallery import appearance_blocks, mask_blocks, spread
from pipeline.report.plots import Series, make_plot
from pipeline.report.recorded import (
    Evaluations,
    Result,
    interval_of,
    read_curves,
    read_evaluations,
    read_json,
    read_loss_curves,
    timings_beside,
)
from pipeline.report.words import between, count, number, scored, shell, short
from pipeline.runs import checkpoint_of, job_of, model_of, photos_of
from pipeline.status import duration, status_of
from pipeline.timing import TimingRow
from pipeline.truth import truth_of

TRAINED = {"steps", "train_seconds", "ranks", "rays_a_step", "device"}  # what a training.json has
SLIDERS = 6  # a protocol: from the worst view to the best
SIDE = 640  # pixels of a picture under a slider, at most
THUMBNAIL = 112
THUMBNAILS = 60  # rows of a table with pictures, at most

READ = {
    "whole": "reads the test photo's appearance from all of it",
    "left": "reads the test photo's appearance from its left half",
    "elsewhere": "reads the appearance from another view in the same light",
    "nothing": "reads no appearance",
}
HOW_TO_SLIDE = "Drag the line, or use the arrow keys. From each protocol's worst photo to its best."
SCORED = {"whole": "scores the whole picture", "right": "scores the right half"}
TRUTH = {"photo": "against the photo as it was taken", "clean": "against the true view without tourists"}


class Found(NamedTuple):
    """What of a run can be used; where something cannot, `missing` says why."""

    run: Path
    job: Job
    training: dict[str, Any] | None
    evaluations: Evaluations
    checkpoint: Checkpoint | None
    photos: Photos | None
    landmark: Landmark | None
    model: SceneModel | None
    missing: dict[str, str]


def write_run_report(run: Path, out: Path) -> Path:
    """The report of a run as the file `out`; returns its path.

    Raises:
        CrossrayError: `run` is no run, or its job file is wrong.
    """
    found, album = look_at(run), Album()
    results = found.evaluations.newest()
    views = [(result, picture_of(found, result)) for result in results.values()]
    first = hero(views[0], album) if views else None  # before the others: it is the last to be left out for room
    sections = [
        Section("pictures", "Truth and rendering", HOW_TO_SLIDE, picture_blocks(found, views, album)),
        Section("appearances", "Appearances", *appearances(found, album)),
        Section("masks", "What it leaves out", *masks(found, album)),
        Section("scores", "Scores of each photo", "", score_blocks(found, views, album), beside=True),
        Section("curves", "Training", "", curve_blocks(found)),
        Section("timing", "Time", "", timing_blocks(found)),
        Section("provenance", "Where it came from", "", provenance_blocks(found)),
    ]
    page = Page(
        kicker=f"Crossray, report of the run {found.job.name}",
        title=f"{found.job.method} on {found.job.scene.path.name}",
        lead=lead(found),
        summary=headline(found, results),
        sections=[section for section in sections if section.blocks],
        hero=first,
        foot=album.foot,
    )
    return write_page(out, page)


def look_at(run: Path) -> Found:
    """Everything that a run's folder, its shards and its scene give."""
    job = job_of(run)
    missing: dict[str, str] = {}

    def attempt(name: str, get: Callable[[], Any]) -> Any:
        try:
            return get()
        except (CrossrayError, OSError, RuntimeError) as error:  # RuntimeError: weights of another model
            missing[name] = str(error)
            return None

    checkpoint = attempt("checkpoint", lambda: checkpoint_of(run))
    photos = attempt("photos", lambda: photos_of(job, checkpoint)) if checkpoint else None
    landmark = attempt("landmark", lambda: truth_of(job, photos)) if photos else None
    model = attempt("model", lambda: model_of(job, checkpoint)) if checkpoint else None
    training = read_json(run / "training.json") or {}
    if not training.keys() >= TRAINED:
        training = {}
    return Found(run, job, training or None, read_evaluations(run), checkpoint, photos, landmark, model, missing)


# ------------------------------------------------------------------------------------------------------ the headline


def lead(found: Found) -> str:
    """What was trained, on what, and for how long."""
    words = []
    training, imported = found.training, read_json(found.run / "imported.json")
    if imported is not None and found.checkpoint is not None:
        words.append(
            f"Imported from {imported.get('source', 'a released checkpoint')}, step {found.checkpoint.step:,}."
        )
    elif training is None or not training.get("finished"):
        status = status_of(found.run)
        of = f" of {status.total:,}" if status.total else ""
        words.append(f"Not trained to its end: {status.stage}, step {status.step:,}{of}.")
    if training is not None:
        processes = count(training["ranks"], "process", "processes")
        words.append(
            f"Trained for {duration(training['train_seconds'])}: {count(training['steps'], 'step')} of "
            f"{count(training['rays_a_step'], 'ray')} on {training['device']}, {processes}."
        )
    if found.photos is not None:
        photos = {split: len(found.photos.indices(split)) for split in ("train", "val", "test")}
        words.append(
            f"{count(photos['train'], 'training photo')}, {photos['val']} to validate and {photos['test']} to test, "
            f"at R{found.job.scene.downscale}."
        )
    return " ".join(words)


def headline(found: Found, results: dict[str, Result]) -> list[Block]:
    """Means with their intervals, and how far the photos behind them differ."""
    blocks: list[Block] = []
    if not results:
        return [how_to_evaluate(found)]
    blocks.append(Tiles([tile(result) for result in results.values()]))
    rows = [
        Numbers(
            name,
            [(short(row["name"]), float(row["psnr"])) for row in result["images"]],
            float(result["mean"]["psnr"]),
            interval_of(result, "psnr"),
            f"{number(float(result['mean']['psnr']), 'psnr')} dB",
        )
        for name, result in results.items()
    ]
    caption = "A dot is a test photo, the line their mean, the bar its 95 % interval (bootstrap over photos)."
    dots = make_dots("PSNR of each test photo, dB", caption, rows)
    older = {r["step"] for r in results.values()} - ({found.checkpoint.step} if found.checkpoint else set())
    if older and found.checkpoint:
        blocks.append(
            Note(
                f"Some scores are of an older checkpoint; the newest is of step {found.checkpoint.step:,}.",
                shell("evaluate", found.run, *(w for name in results for w in ("--protocol", name))),
            )
        )
    return blocks + ([dots] if dots else [])


def tile(result: Result) -> Tile:
    """A protocol's means."""
    mean = result["mean"]
    metrics = [m for m in METRICS if m in mean] + [m for m in mean if m not in METRICS]
    first, *others = metrics
    details = [f"95 %: {between(interval_of(result, first), first)}"]
    for metric in others:
        found = interval_of(result, metric)
        details.append(scored(mean[metric], metric) + (f" ({between(found, metric)})" if found else ""))
    details.append(f"{count(len(result['images']), 'photo')}, step {result['step']:,}")
    unit = f"{title_of(first)}, dB" if first == "psnr" else title_of(first)
    return Tile(result["protocol"], number(mean[first], first), unit, "\n".join(details))


def how_to_evaluate(found: Found) -> Note:
    """Why there are no scores."""
    if found.photos is not None and not found.photos.indices("test"):
        return Note("There are no scores: the scene has no test photos (its split file says which photos are).")
    command = shell("evaluate", found.run, "--protocol", f"crnerf-full@R{found.job.scene.downscale}")
    if found.checkpoint is None:
        return Note(
            f"There are no scores: {found.missing['checkpoint']}. This trains it, or goes on with it:",
            shell("run", found.run / "job.yaml"),
        )
    return Note("The run has not been evaluated yet. This scores it on its test photos:", command)


# ------------------------------------------------------------------------------------------------------ the pictures


Pictures = Callable[[dict[str, Any]], tuple[np.ndarray | None, np.ndarray | None]]


def picture_of(found: Found, result: Result) -> Pictures:
    """A function of an image's row in metrics.json: its truth and its rendering, None where it cannot be had."""
    clean = result.get("definition", {}).get("truth") == "clean"
    folder = found.run / "eval" / result["protocol"] / folder_name(result["step"])
    indices = {r.key: i for i, r in enumerate(found.photos.records)} if found.photos else {}

    def pictures(row: dict[str, Any]) -> tuple[np.ndarray | None, np.ndarray | None]:
        truth, index = None, indices.get(row["key"])
        if index is not None and found.photos is not None and not clean:
            truth = found.photos.image(index)
        elif index is not None and found.landmark is not None and clean:
            truth = found.landmark.truth(row["name"], row["name"])
        return truth, read_picture(folder / f"{Path(row['key']).name}.png")

    return pictures


def read_picture(path: Path) -> np.ndarray | None:
    """A picture file as uint8 (h, w, 3); None where there is none."""
    try:
        with Image.open(path) as picture:
            return np.asarray(picture.convert("RGB"))
    except OSError:
        return None


def ranked(result: Result) -> list[dict[str, Any]]:
    """The images from the worst PSNR to the best; what is not a number comes first."""
    return sorted(result["images"], key=lambda row: (not math.isnan(row["psnr"]), row["psnr"]))


def hero(view: tuple[Result, Pictures], album: Album) -> Slider | None:
    """The view in the middle of the ranking."""
    rows = ranked(view[0])
    return slider(view, rows[len(rows) // 2], "the median photo", album)


def slider(view: tuple[Result, Pictures], row: dict[str, Any], rank: str, album: Album) -> Slider | None:
    """Truth and rendering of one photo, if both are there."""
    result, pictures = view
    truth, ours = pictures(row)
    if truth is None or ours is None:
        return None
    clean = result.get("definition", {}).get("truth") == "clean"
    left = album.add(truth, f"truth of {row['name']}", SIDE, exact=True)
    right = album.add(ours, f"rendering of {row['name']} under {result['protocol']}", SIDE, exact=True)
    words = ", ".join(scored(row[m], m) for m in METRICS if m in row)
    caption = f"{words}{'; ' + rank if rank else ''}"
    return Slider(short(row["name"]), caption, Shot("truth" if clean else "photo", left), Shot("rendering", right))


def picture_blocks(found: Found, views: list[tuple[Result, Pictures]], album: Album) -> list[Block]:
    """Sliders of some test views, for each protocol."""
    blocks: list[Block] = []
    for view in views:
        result, rows = view[0], ranked(view[0])
        ranks = {0: "worst", len(rows) - 1: "best"} if len(rows) > 1 else {}
        chosen = spread(range(len(rows)), SLIDERS)
        made = [slider(view, rows[i], ranks.get(i, ""), album) for i in chosen]
        sliders = [s for s in made if s is not None]
        if sliders:
            few = len(sliders) < len(rows)
            some = f" {len(sliders)} of {len(rows)} photos; all are in the table below." if few else ""
            blocks.append(Sliders(sliders, result["protocol"], f"{described(result)}.{some}"))
        else:
            reason = (
                found.missing.get("photos") or found.missing.get("landmark") or "its pictures are not in its folder"
            )
            blocks.append(Note(f"No pictures to compare under {result['protocol']}: {reason}"))
    return blocks


def described(result: Result) -> str:
    """What a protocol does, in a sentence."""
    definition = result.get("definition", {})
    parts = [
        READ.get(result.get("appearance_from", ""), ""),
        SCORED.get(definition.get("scored", ""), ""),
        TRUTH.get(definition.get("truth", ""), ""),
    ]
    text = ", ".join(part for part in parts if part)
    return f"{text[0].upper()}{text[1:]}" if text else "not described"


def appearances(found: Found, album: Album) -> tuple[str, list[Block]]:
    """The section of appearances: its intro and its blocks."""
    model = found.model
    if model is None or found.photos is None:
        return "", [not_rendered(found)]
    intro = "Each row is one view: as it was photographed, and in the appearances of the photos at the top."
    try:
        return intro if model.spec.appearance != "none" else "", appearance_blocks(model, found.photos, album)
    except (CrossrayError, ValueError) as error:
        return "", [Note(f"Nothing could be rendered: {error}")]


def masks(found: Found, album: Album) -> tuple[str, list[Block]]:
    """The section of masks: its intro and its blocks."""
    if found.model is None or found.photos is None:
        return "", [not_rendered(found)]
    try:
        blocks = mask_blocks(found.model, found.photos, album)
    except (CrossrayError, ValueError) as error:
        return "", [Note(f"No masks could be made: {error}")]
    shows = any(isinstance(block, Sliders) for block in blocks)
    return "The training photos with most that is taken for transient, marked in pink." if shows else "", blocks


def not_rendered(found: Found) -> Note:
    """Why nothing was rendered for the page."""
    if found.checkpoint is None:
        return Note(f"Nothing to render with: {found.missing['checkpoint']}", shell("run", found.run / "job.yaml"))
    return Note(f"Nothing could be rendered: {found.missing.get('photos') or found.missing['model']}")


# -------------------------------------------------------------------------------------------------------- the tables


def score_blocks(found: Found, views: list[tuple[Result, Pictures]], album: Album) -> list[Block]:
    """A table each protocol, a row each photo, the worst first."""
    blocks: list[Block] = [score_table(*view, album) for view in views]
    for path in found.evaluations.damaged:
        name = path.parents[1].name
        blocks.append(
            Note(f"{path}: cannot be read, and is left out.", shell("evaluate", found.run, "--protocol", name))
        )
    return blocks


def score_table(result: Result, pictures: Pictures, album: Album) -> Table:
    """One protocol's photos."""
    rows = ranked(result)
    metrics = [m for m, value in rows[0].items() if isinstance(value, int | float)]
    lines = []
    for position, row in enumerate(rows):
        shown = pictures(row) if position < THUMBNAILS else (None, None)
        words = ("truth", "rendering")
        thumbs: tuple[Picture, ...] = tuple(
            album.add(p, f"{word} of {row['name']}", THUMBNAIL)
            for word, p in zip(words, shown, strict=True)
            if p is not None
        )
        values = [row.get(m) for m in metrics]
        lines.append(
            [
                Cell(pictures=thumbs),
                Cell(short(row["name"]), row["name"]),
                *(Cell(number(v, m), sort_key(v)) for v, m in zip(values, metrics, strict=True)),
            ]
        )
    numeric = [False, False, *(True for _ in metrics)]
    caption = f"{THUMBNAILS} of {len(rows)} photos are shown with pictures." if len(rows) > THUMBNAILS else ""
    titles = ["truth, rendering", "photo", *(title_of(m) + (", dB" if m == "psnr" else "") for m in metrics)]
    mean, sortable = result["mean"], [False, *(True for _ in titles[1:])]
    spans = [interval_of(result, m) for m in metrics]
    foot = [
        [Cell(), Cell("mean"), *(Cell(number(mean.get(m), m)) for m in metrics)],
        [Cell(), Cell("95 % interval"), *(Cell(between(s, m)) for s, m in zip(spans, metrics, strict=True))],
    ]
    by = titles.index("PSNR, dB")
    return Table(result["protocol"], titles, lines, numeric, sortable, by, caption, foot)


def sort_key(value: Any) -> float | str | None:
    """A number as page.js sorts it; None for what is no number."""
    if value is None or math.isnan(value):
        return None
    return float(value) if math.isfinite(value) else ("Infinity" if value > 0 else "-Infinity")


# -------------------------------------------------------------------------------------------------------- the curves


def curve_blocks(found: Found) -> list[Block]:
    """Losses of every step, and what TensorBoard has; evaluations where there is more than one."""
    curves, losses = read_curves(found.run), read_loss_curves(found.run)
    gradient = losses.pop("gradient_norm", None) or curves.get("train/gradient_norm")
    terms = list(losses.values()) or [s for t, s in curves.items() if t.startswith("loss/") and t != "loss/total"]
    psnr = [
        curves[tag]._replace(name=name)
        for tag, name in (("train/psnr", "training rays"), ("view/psnr", "a fixed view"))
        if tag in curves
    ]
    rates = [s for tag, s in curves.items() if tag.startswith("learning_rate/")]
    one = {"train/mask_share": "Share of rays taken for transient", "memory/resident_MiB": "Memory of a process, MiB"}
    plots = [
        make_plot("PSNR in training, dB", psnr),
        make_plot("Losses", terms, "Mean of neighbouring steps; the band is from least to greatest." if losses else ""),
        *evaluation_plots(found.evaluations),
        make_plot("Rays a second", [curves["speed/rays_per_second"]]) if "speed/rays_per_second" in curves else None,
        make_plot("Learning rates", rates),
        make_plot("Gradient norm", [gradient]) if gradient else None,
        *(make_plot(title, [curves[tag]]) for tag, title in one.items() if tag in curves),
    ]
    drawn = [plot for plot in plots if plot is not None]
    if not drawn and (found.run / "imported.json").is_file():
        return [Note("An imported checkpoint has no curves.")]
    if not drawn:
        return [Note("No step has been recorded. This trains the run:", shell("run", found.run / "job.yaml"))]
    return [Plots(drawn)]


def evaluation_plots(evaluations: Evaluations) -> list[Any]:
    """Means over steps, a chart each metric, where some protocol scored more than one checkpoint."""
    by_protocol = evaluations.by_protocol
    if all(len(steps) < 2 for steps in by_protocol.values()):
        return []
    metrics = dict.fromkeys(m for steps in by_protocol.values() for result in steps.values() for m in result["mean"])
    plots = []
    for metric in metrics:
        series = []
        for name, steps in by_protocol.items():
            means = {s: r["mean"][metric] for s, r in steps.items() if r["mean"].get(metric) is not None}
            if means:
                series.append(Series(name, np.array(list(means)), np.array(list(means.values()), np.float64)))
        plots.append(make_plot(f"{title_of(metric)} on test photos", series))
    return plots


# ----------------------------------------------------------------------------------------------- timing, provenance


def timing_blocks(found: Found) -> list[Block]:
    """How long training and evaluation took; rows of the timing harness."""
    facts = []
    if training := found.training:
        steps, seconds = max(training["steps"], 1), training["train_seconds"]
        facts += [
            ("training", f"{duration(seconds)}, {count(training['steps'], 'step')}"),
            ("a step", f"{1000 * seconds / steps:.1f} ms for {count(training['rays_a_step'], 'ray')}"),
            ("writing checkpoints", f"{training.get('checkpoint_seconds', 0.0):.2f} s"),
            ("trained on", f"{training['device']}, ranks: {training['ranks']}"),
        ]
        if training.get("parameters"):
            facts.append(("parameters that learn", f"{training['parameters']:,}"))
    for name, result in found.evaluations.newest().items():
        photos = len(result["images"])
        text = f"{result.get('seconds', 0.0):.2f} s for {count(photos, 'photo')} on {result.get('device', '?')}"
        for key, what in (("appearance_seconds", "for the appearance"), ("render_seconds", "to render")):
            if isinstance(result.get(key), int | float):
                text += f"; {result[key]:.3f} s a photo {what}"
        facts.append((f"evaluation, {name}", text))
    blocks: list[Block] = [Facts(facts)] if facts else [Note("No time has been recorded: the training has not ended.")]
    rows = timings_beside(found.run, found.job.method, found.job.model.field)
    return [*blocks, timing_table(rows)] if rows else blocks


def timing_table(rows: list[TimingRow]) -> Table:
    """What the timing harness measured of this method."""
    titles = ["what", "picture", "appearances", "samples", "seconds", "quartiles", "peak memory, MiB", "on"]
    lines = []
    for row in rows:
        size = f"{row.width} × {row.height}" if row.width else "-"
        what = f"{row.table}, {row.how}"
        unit = "an image" if row.unit == "image" else "a step"
        lines.append(
            [
                Cell(what, what),
                Cell(size, (row.width or 0) * (row.height or 0)),
                Cell(str(row.appearances or "-"), row.appearances),
                Cell(" + ".join(map(str, row.samples))),
                Cell(f"{row.seconds:.4g} {unit}", row.seconds),
                Cell(f"{row.low:.4g} to {row.high:.4g}"),
                Cell("-" if row.peak_memory_MiB is None else f"{row.peak_memory_MiB:.0f}"),
                Cell(f"{row.device}, {row.precision}"),
            ]
        )
    sortable = [True, True, True, False, True, False, False, False]
    numeric = [False, False, True, False, True, True, True, False]
    return Table("Measured by the timing harness", titles, lines, numeric, sortable)


def provenance_blocks(found: Found) -> list[Block]:
    """The job, the checkpoint, and what made each number."""
    facts = [("run", str(found.run)), ("method", f"{found.job.method}: {axes(found.job)}")]
    if found.checkpoint is not None:
        facts += [
            ("checkpoint", f"step {found.checkpoint.step:,}, SHA-256 {found.checkpoint.meta['sha256'][MODEL]}"),
            ("photos", f"content hash {found.checkpoint.meta['shards']}"),
        ]
    else:
        facts.append(("checkpoint", found.missing["checkpoint"]))
    blocks: list[Block] = [Facts(facts)]
    if source := read_json(found.run / "source.json"):
        blocks.append(Code("What started the run", as_yaml(source)))
    for name, result in found.evaluations.newest().items():
        keys = ("protocol", "step", "checkpoint_sha256", "samples", "statistics", "device", "versions", "python")
        record = {k: result[k] for k in keys if k in result} | result.get("provenance", {})
        blocks.append(
            Code(f"What made the scores under {name}", as_yaml(record | {"definition": result.get("definition")}))
        )
    blocks.append(Code("The job, every key as it was resolved", as_yaml(found.job.model_dump(mode="json"))))
    blocks.append(Code("What made this page", as_yaml(provenance())))
    return blocks


def axes(job: Job) -> str:
    """The choices that make the method."""
    spec = job.model
    return (
        f"field {spec.field}, colour {spec.colour}, appearance {spec.appearance}, fused {spec.fused}, "
        f"transient {spec.transient}"
    )


def as_yaml(value: dict[str, Any]) -> str:
    """A record for people."""
    return yaml.safe_dump(value, sort_keys=False, allow_unicode=True)
