"""What was measured, as records read from files: evaluations of runs, studies, timings.

Each record says where it comes from, so that a cell of a table can be traced. What was not recorded stays None; nothing
is filled in. A file that is damaged, or of no known format, is left out with one warning.
"""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import BaseModel, Field, ValidationError

from model.methods import METHODS
from pipeline.config import BOOKKEEPING, Job, as_dict, flatten, make_job
from pipeline.errors import CrossrayError
from pipeline.evaluate import METRICS as METRICS_FILE
from pipeline.files import resolved
from pipeline.protocol import parse_protocol
from pipeline.records import ELSEWHERE, Budget, Design, Other, Results, Score, Source, Timed
from pipeline.runs import job_of
from pipeline.study import StudyJob, run_job_of
from pipeline.timing import TIMING, Timing, read_timing

log = logging.getLogger("crossray")

MEANING = ("appearance", "scored", "truth", "rounding", "ssim", "mlp_samples")  # keys of a protocol that move scores
SCHEDULE = ("seconds", "epochs", "steps_per_epoch")  # of `train`: they are in the budget
FOREIGN = ("machine", "provenance")  # a JSON file of ours with one of these keys is a record, if not one for us


class Evaluated(BaseModel):
    """What is read of an evaluation: metrics.json, or a run's protocol in study.json."""

    definition: dict[str, Any] | None = None
    images: list[dict[str, Any]] = Field(min_length=1)
    statistics: str | None = None
    device: str | None = None
    provenance: dict[str, Any] = {}


class StudyRun(BaseModel):
    """A run in study.json."""

    run: str
    scene: str
    variant: str
    seed: int
    steps: int
    device: str | None = None
    checkpoint_sha256: str
    source: dict[str, Any] | None = None
    protocols: dict[str, Evaluated]


class Study(BaseModel):
    """study.json."""

    study: StudyJob
    runs: list[StudyRun]


class Trained(BaseModel):
    """What is read of training.json."""

    steps: int
    finished: bool
    device: str | None = None


# ----------------------------------------------------------------------------------------------------------- files


def read_results(runs: Sequence[Path], folders: Sequence[Path]) -> Results:
    """Evaluations and timings of the runs in `runs`, at any depth, and the JSON files in `folders`.

    A checkpoint's score that stands in several files counts once, by the first of: its run, a study.

    Raises:
        CrossrayError: a folder is not there.
    """
    for folder in (*runs, *folders):
        if not folder.is_dir():
            raise CrossrayError(f"{folder}: no such folder")
    scores = [score for path in newest_evaluations(runs) for score in usable(path, score_of_run)]
    times: list[Timed] = []
    others: dict[str, Other] = {}
    for path in json_files(runs, folders):
        for record in usable(path, records_of):
            if isinstance(record, Score):
                scores.append(record)
            elif isinstance(record, Timed):
                times.append(record)
            else:
                others[path.stem] = record
    return Results(tuple(once(scores)), tuple(times), others)


def newest_evaluations(runs: Iterable[Path]) -> list[Path]:
    """The metrics.json of each run and protocol whose step is the highest."""
    newest: dict[Path, Path] = {}
    for root in runs:
        for path in sorted(root.glob(f"**/eval/*/step-*/{METRICS_FILE}")):
            newest[path.parents[1]] = path  # the names of steps sort as their numbers do
    return list(newest.values())


def json_files(runs: Iterable[Path], folders: Iterable[Path]) -> list[Path]:
    """Files that may hold studies and timings."""
    of_runs = [path for root in runs for name in ("study.json", TIMING) for path in sorted(root.glob(f"**/{name}"))]
    return list(dict.fromkeys([*of_runs, *(path for folder in folders for path in sorted(folder.glob("*.json")))]))


def usable(path: Path, read: Any) -> Iterator[Any]:
    """What `read` makes of a file; nothing, and a warning, where it cannot be used."""
    try:
        yield from read(path)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        log.warning("%s: left out of the tables: %s: %s", path, where or "file", first["msg"])
    except (CrossrayError, OSError, ValueError, KeyError, TypeError, ArithmeticError, RecursionError) as error:
        log.warning("%s: left out of the tables: %s", path, error)


def once(scores: Iterable[Score]) -> list[Score]:
    """One score a checkpoint and protocol, the first one."""
    first: dict[tuple[str, str], Score] = {}
    for score in scores:
        first.setdefault((score.checkpoint, score.protocol), score)
    return list(first.values())


def read_json(path: Path) -> dict[str, Any]:
    """A file that holds a mapping.

    Raises:
        ValueError: it does not.
    """
    content = json.loads(path.read_bytes())
    if not isinstance(content, dict):
        raise ValueError("it does not hold a record")
    return content


def records_of(path: Path) -> list[Score | Timed | Other]:
    """What a JSON file of results holds.

    Raises:
        ValueError: it is none.
        CrossrayError: it is a timing, but a damaged one.
    """
    content = read_json(path)
    if content.keys() >= {"study", "runs"}:
        return list(scores_of_study(path, content))
    if content.keys() >= {"format", "rows"}:
        timing = read_timing(path)
        return [Timed(row, source_of_timing(path, timing)) for row in timing.rows]
    if any(isinstance(content.get(key), dict) for key in FOREIGN):
        where = as_dict(content.get("provenance")) or as_dict(content["machine"])
        return [Other(content, origin(path, None, where))]
    raise ValueError("it is neither a study nor a timing")


# ---------------------------------------------------------------------------------------------------------- scores


def score_of_run(path: Path) -> Iterator[Score]:
    """The score in a run's metrics.json; none, and a warning, where the run's training did not end at that step."""
    run, content = path.parents[3], read_json(path)
    evaluated, job = Evaluated.model_validate(content), job_of(run)
    step, imported = int(content["step"]), (run / "imported.json").is_file()
    trained = None if imported else Trained.model_validate(read_json(run / "training.json"))
    if trained is not None and not (trained.finished and trained.steps == step):
        log.warning("%s: left out of the tables: step %d is not the end of the training", path, step)
        return
    started = read_json(run / "source.json") if (run / "source.json").is_file() else {}
    device = evaluated.device if trained is None else trained.device
    where = origin(path, str(run), started, evaluated.provenance or content, device=device)
    budget = ELSEWHERE if imported else budget_of(job, device, evaluated.provenance or started)
    about = Trainee(job, job.name, job.patch.seed, step, str(content["checkpoint_sha256"]), budget)
    yield score_of(about, content["protocol"], evaluated, where)


def scores_of_study(path: Path, content: dict[str, Any]) -> Iterator[Score]:
    """The scores of all runs of a study. Their jobs are made again from the study's own keys."""
    study = Study.model_validate(content)
    for run in study.runs:
        job = run_job_of(study.study, run.scene, run.variant, run.seed, f"{path}: {run.run}")
        budget = budget_of(job, run.device, run.source or {})
        about = Trainee(job, run.variant, run.seed, run.steps, run.checkpoint_sha256, budget)
        for protocol, evaluated in run.protocols.items():
            where = origin(path, run.run, run.source or {}, evaluated.provenance, device=run.device)
            yield score_of(about, protocol, evaluated, where)


class Trainee(NamedTuple):
    """A checkpoint, and how it came to be."""

    job: Job
    label: str  # the run's name or the study's variant
    seed: int
    steps: int
    checkpoint: str
    budget: Budget


def score_of(about: Trainee, protocol: str, evaluated: Evaluated, source: Source) -> Score:
    """A score as the tables take it.

    Raises:
        CrossrayError: the protocol is none.
    """
    job = about.job
    meaning = meaning_today(protocol)
    if evaluated.definition is not None:
        meaning = meaning_of(evaluated.definition)
    notes = ["the protocol's definition is not recorded"] if evaluated.definition is None else []
    if evaluated.definition is not None and fitted_otherwise(job, protocol, evaluated.definition):
        notes.append("fitted to the test photo by another recipe than today's")
    design, settings = design_of(job, about.label)
    if evaluated.statistics not in (None, "none"):
        settings = (*settings, f"statistics={evaluated.statistics}")
    usual = usual_job(design.method, job.model.field).patch
    return Score(
        scene=job.scene.path.name or resolved(job.scene.path).name,
        protocol=protocol,
        meaning=meaning,
        design=design,
        rays=job.patch.size**2,
        usual_patch=job.patch.model_copy(update={"seed": usual.seed}) == usual,
        reference=job.scene.reference_downscale,
        budget=about.budget,
        seed=about.seed,
        steps=about.steps,
        images={str(row["name"]): numbers(row) for row in evaluated.images},
        checkpoint=about.checkpoint,
        source=replace(source, settings=settings, notes=tuple(notes)),
    )


def meaning_of(definition: dict[str, Any]) -> tuple[str, ...]:
    """What of a protocol's definition moves scores."""
    return tuple(f"{key}: {definition.get(key)}" for key in MEANING)


def fitted_otherwise(job: Job, protocol: str, definition: dict[str, Any]) -> bool:
    """Whether something was fitted to the test photo, by a recipe that the protocol does not have any more."""
    key = "fit" if job.model.appearance == "embedding" else "fit_read" if protocol.endswith("+fit") else None
    if key is None:
        return False
    was = as_dict(as_dict(definition.get(key)).get(job.model.field))
    now = parse_protocol(protocol)[0].model_dump(mode="json")[key][job.model.field]
    return any(now.get(name) != value for name, value in was.items())


@cache
def meaning_today(protocol: str) -> tuple[str, ...]:
    """A protocol's definition as it is now.

    Raises:
        CrossrayError: there is no such protocol.
    """
    return meaning_of(parse_protocol(protocol)[0].model_dump(mode="json"))


def numbers(row: dict[str, Any]) -> dict[str, float]:
    """The metrics of a photo's row."""
    return {key: float(value) for key, value in row.items() if isinstance(value, int | float)}


# ---------------------------------------------------------------------------------------------------- what was trained


def budget_of(job: Job, device: str | None, where: dict[str, Any]) -> Budget:
    """What a job's training was given; `device` is the name of what it ran on, `where` the provenance."""
    gpus = as_dict(where.get("hardware")).get("gpus", [])
    kind = job.device if job.device != "auto" else "cuda" if device in gpus or "NVIDIA" in (device or "") else "cpu"
    threads, train = job.threads if kind == "cpu" else 1, job.train
    if train.seconds is not None:
        return Budget(train.seconds, None, None, job.ranks, threads, kind, device or "")
    return Budget(None, train.epochs, train.steps_per_epoch, job.ranks, threads, kind)


def design_of(job: Job, label: str) -> tuple[Design, tuple[str, ...]]:
    """What was trained, and the settings of losses, patches and training that its recipe does not have.

    Whose content statistics an evaluation took is no part of the design: the evaluation says it.
    """
    spec = job.model
    method = method_of(job)
    usual = flatten(usual_job(method, spec.field).model_dump(mode="json"))
    differs = {key: value for key, value in flatten(job.model_dump(mode="json")).items() if usual.get(key) != value}
    model = {key.removeprefix("model."): value for key, value in differs.items() if key.startswith("model.")}
    model.pop("statistics", None)
    kept = {f"train.{key}" for key in (*BOOKKEEPING, *SCHEDULE)} | {"patch.seed"}
    others = {k: v for k, v in differs.items() if k.startswith(("losses.", "patch.", "train.")) and k not in kept}
    masks = next((kind for kind in ("deeplabv3", "maskrcnn") if kind in label), "unnamed")
    design = Design(method, spec.field, settings_of(model), masks if spec.transient == "fixed" else "")
    return design, settings_of(others)


def method_of(job: Job) -> str:
    """The method that has the job's choices, whatever the field; the job's own where none has them."""
    choices = {key: value for key, value in asdict(job.model).items() if key in CHOICES}
    for name, method in METHODS.items():
        if {key: value for key, value in method.axes().items() if key in CHOICES} == choices:
            return "crossray" if name == "crnerf" and job.model.field == "hash" else name
    return job.method


CHOICES = ("colour", "appearance", "fused", "transient")


@cache
def usual_job(method: str, on: str) -> Job:
    """The job that a method's recipe on the field `on` is, if nothing else is said."""
    return make_job({"name": "usual", "method": method, "scene": {"path": "."}, "model": {"field": on}})


def settings_of(mapping: dict[str, Any]) -> tuple[str, ...]:
    """key=value, as the command line takes them, in the order of the keys."""
    return tuple(setting(key, mapping[key]) for key in sorted(mapping))


def setting(key: str, value: Any) -> str:
    """key=value whose value YAML reads as what it is."""
    text = str(value)
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    plain = isinstance(value, str) and re.fullmatch(r"[A-Za-z][\w./-]*", text) and text not in ("null", "true", "false")
    return f"{key}={text if plain else json.dumps(value)}"


# ------------------------------------------------------------------------------------------------------- provenance


def origin(path: Path, run: str | None, *where: dict[str, Any], device: str | None = None) -> Source:
    """The source that provenances tell of, the first of them that knows; `device` where none knows the hardware."""

    def first(key: str) -> Any:
        return next((found[key] for found in where if found.get(key)), None)

    commit, hardware = first("commit"), first("hardware")
    if isinstance(hardware, dict):
        machine = hardware_of(hardware)
        if device and device not in machine:  # whoever recorded it need not be who computed it
            machine = f"{device}; recorded on {machine}"
    else:
        processor = device or first("processor") or first("device")
        machine = ", ".join(str(part) for part in (processor, first("machine"), cores_of(first("cores"))) if part)
    return Source(str(path), run, text_of(first("command")), text_of(commit), text_of(first("date")), machine or None)


def text_of(value: Any) -> str | None:
    """A value as text; None stays."""
    return None if value is None else str(value)


def hardware_of(hardware: dict[str, Any]) -> str:
    """Processor, cores, memory and GPUs in one line."""
    memory, gpus = hardware.get("memory_GiB"), hardware.get("gpus") or []
    parts = [hardware.get("processor"), cores_of(hardware.get("cores")), f"{memory} GiB" if memory else None]
    return ", ".join(str(part) for part in [*parts, *gpus] if part)


def cores_of(cores: Any) -> str | None:
    """2 -> 2 cores."""
    return None if cores is None else f"{cores} core{'' if cores == 1 else 's'}"


def source_of_timing(path: Path, timing: Timing) -> Source:
    """Where a timing's rows come from."""
    return origin(path, None, timing.provenance)
