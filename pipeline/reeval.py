"""Re-evaluation: one pass over the committed checkpoints of some runs that lack an evaluation.

A pass does only what is lacking, so it can be made again at any time, on a clock, or by several processes at once:
what another one is evaluating is left to it (`pipeline.evaluate.lock_of`). What ends a pass half-way, kill -9 included,
leaves evaluations that are whole or absent, and the next pass goes on.
"""

from __future__ import annotations

import glob
import logging
import re
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, cast

import yaml
from filelock import FileLock, Timeout
from pydantic import BeforeValidator, Field, ValidationError

from pipeline.checkpoint import CheckpointError, committed, read_checkpoint
from pipeline.config import UNKNOWN, Job, JobError, Section, explain, merge, nearest, parse_setting, parse_yaml
from pipeline.errors import CrossrayError
from pipeline.evaluate import (
    CheckpointGone,
    Evaluation,
    Mapper,
    Scores,
    Views,
    described,
    lock_of,
    prepare,
    recorded,
    score_views,
    update_best,
)
from pipeline.files import resolved
from pipeline.protocol import check_protocol, parse_protocol
from pipeline.runs import job_of

log = logging.getLogger("crossray")

AT_ONCE = 32  # evaluations whose tasks wait together, and that no other pass can take meanwhile
SECONDS = {"s": 1, "m": 60, "h": 3600, "d": 86400}

OneOrMore = Annotated[tuple[str, ...], BeforeValidator(lambda value: (value,) if isinstance(value, str) else value)]


class ReevalJob(Section):
    """Evaluate the checkpoints of runs that lack an evaluation, once or on a clock."""

    kind: Literal["reeval"] = "reeval"
    """What the job does."""
    runs: Annotated[OneOrMore, Field(min_length=1)]
    """Folders of runs, or patterns: `runs/*`; `runs/**` finds those of studies, too."""
    protocols: OneOrMore = ()
    """Protocols to evaluate under, each with its downscale: `crnerf-full@R4`. Empty: those of each run's own job."""
    every: str | None = None
    """How long from the start of one pass to the start of the next: `45s`, `30m`, `2h`, `1d`. null: one pass."""
    gpus: float | None = Field(None, gt=0, le=1)
    """Share of a GPU that a task takes, for runs that use GPUs; null: what each run's `evaluate.gpus` says."""
    launcher: Literal["auto", "local", "ray"] = "auto"
    """`local`: one view after the other in this process. `ray`: tasks on a cluster, or on all of this machine. `auto`:
    ray in a submitted job or where RAY_ADDRESS names a cluster, else local."""


@dataclass
class Summary:
    """What a pass did. Numbers count evaluations: one checkpoint under one protocol."""

    evaluated: int = 0
    there: int = 0
    elsewhere: int = 0
    skipped: list[str] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        others = f", {self.elsewhere} under way in another process" if self.elsewhere else ""
        return (
            f"{self.evaluated} evaluated, {self.there} there already{others}, {len(self.skipped)} skipped, "
            f"{len(self.failed)} failed"
        )


class Lacking(NamedTuple):
    """A committed checkpoint that lacks evaluations."""

    job: Job
    target: Path
    protocols: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.job.run}, {self.target.name}"


# ---------------------------------------------------------------------------------------------------- from the file


def load_reeval(path: Path, settings: Sequence[str] = ()) -> ReevalJob:
    """The re-evaluation in a YAML file of this kind, with `key=value` settings on top.

    Raises:
        CrossrayError: a key or a value is wrong; the message names it.
    """
    try:
        raw = parse_yaml(path.read_text())
    except (yaml.YAMLError, ValueError) as error:
        raise JobError(f"{path}: not a YAML file: {error}") from error
    for setting in settings:
        raw = merge(raw, parse_setting(setting))
    try:
        reeval = ReevalJob.model_validate(raw)
    except ValidationError as error:
        raise JobError("\n".join(f"{path}: {explain_reeval(e)}" for e in error.errors())) from None
    for name in reeval.protocols:
        parse_protocol(name)
    interval(reeval)
    return reeval


def explain_reeval(error: Any) -> str:
    """One pydantic error of a re-evaluation, as `pipeline.config.explain` puts those of a job."""
    if error["type"] in UNKNOWN:
        key = str(error["loc"][-1])
        return f"{key}: there is no such key{nearest(key, list(ReevalJob.model_fields))}"
    return explain(error)


def interval(reeval: ReevalJob) -> float | None:
    """Seconds from one pass to the next, None for a single one.

    Raises:
        JobError: `every` is not a time.
    """
    if reeval.every is None:
        return None
    match = re.fullmatch(r"([1-9][0-9]{0,5})([smhd])", reeval.every)
    if match is None:
        raise JobError(f"every: {reeval.every!r} is not a time; write 45s, 30m, 2h or 1d, or null for one pass")
    return int(match[1]) * SECONDS[match[2]]


def find_runs(reeval: ReevalJob) -> list[Path]:
    """The runs, each once.

    Raises:
        CrossrayError: a folder is no run; or a pattern matches none and there is no later pass that may find one.
    """
    found: dict[Path, Path] = {}
    for pattern in reeval.runs:
        matches = sorted(glob.glob(pattern, recursive=True))  # noqa: PTH207 (of pathlib's, none takes absolute patterns)
        hits = [path for path in map(Path, matches) if (path / "job.yaml").is_file()]
        if not hits and not glob.has_magic(pattern):
            raise CrossrayError(f"runs: {pattern} is not a run: it has no job.yaml")
        if not hits and reeval.every is None:
            raise CrossrayError(f"runs: nothing matches {pattern} (a run is a folder with a job.yaml)")
        found |= {resolved(path): path for path in hits if resolved(path) not in found}
    return list(found.values())


# -------------------------------------------------------------------------------------------------------- one pass


def one_pass(reeval: ReevalJob, mapper: Mapper) -> Summary:
    """Evaluate every committed checkpoint of the runs that lacks an evaluation; a checkpoint that fails ends nothing.

    Raises:
        CrossrayError: there is no such run.
    """
    summary = Summary()
    todo = [lacking for run in find_runs(reeval) for lacking in look(run, reeval.protocols, summary)]
    for first in range(0, len(todo), AT_ONCE):
        evaluate_all(todo[first : first + AT_ONCE], mapper, summary)
    return summary


def look(run: Path, protocols: tuple[str, ...], summary: Summary) -> list[Lacking]:
    """A run's checkpoints that lack an evaluation under `protocols`, or under its own where there are none; oldest
    first, as curves grow."""
    try:
        job = job_of(run)
    except CrossrayError as error:
        summary.skipped.append(f"{run}: {error}")
        return []
    names = fitting(job, protocols or job.evaluate.protocols, summary)
    targets = committed(job.run / "checkpoints")
    if not targets:
        summary.skipped.append(f"{job.run}: it has no checkpoint yet")
    found = []
    for target in targets if names else []:
        try:
            checkpoint = described(target)
        except CheckpointError as error:
            summary.skipped.append(str(error))
            continue
        missing = tuple(name for name in names if recorded(job.run, name, checkpoint) is None)
        summary.there += len(names) - len(missing)
        if missing:
            found.append(Lacking(job, target, missing))
    for name in names:  # whoever was killed after metrics.json and before this has left it behind
        if (job.run / "eval" / name).is_dir():
            update_best(job.run, name)
    return found


def fitting(job: Job, protocols: Sequence[str], summary: Summary) -> list[str]:
    """Those of `protocols` that the run can be judged by."""
    if not protocols:
        summary.skipped.append(f"{job.run}: neither its job nor this one names a protocol")
    names = []
    for name in dict.fromkeys(protocols):
        try:
            check_protocol(job, name)
            names.append(name)
        except CrossrayError as error:
            summary.skipped.append(f"{job.run}, {name}: {error}")
    return names


class Failure(NamedTuple):
    """A task that has no scores."""

    run: Path
    step: int
    reason: str
    gone: bool = False  # the checkpoint was removed meanwhile


def attempt(task: Views) -> Scores | Failure:
    """`score_views`, of which no error ends the evaluation of other checkpoints."""
    try:
        return score_views(task)
    except CheckpointGone as error:
        return Failure(task.job.run, task.step, str(error), gone=True)
    except CrossrayError as error:
        return Failure(task.job.run, task.step, str(error))
    except Exception as error:
        return Failure(task.job.run, task.step, f"{type(error).__name__}: {error}")


def lost(task: Views, error: CrossrayError) -> Failure:
    """What `attempt` would give if its process had not died."""
    return Failure(task.job.run, task.step, str(error))


@dataclass
class UnderWay:
    """An evaluation that this process holds."""

    evaluation: Evaluation
    tasks: list[Views]
    lock: FileLock
    parts: list[Scores | Failure] = field(default_factory=list)


def evaluate_all(todo: Sequence[Lacking], mapper: Mapper, summary: Summary) -> None:
    """Evaluate checkpoints; each is committed as soon as all of its views are scored."""
    under_way: dict[tuple[Path, int], UnderWay] = {}

    def tasks() -> Iterator[Views]:  # a mapper that takes one at a time leaves later ones to other passes until then
        for lacking in todo:
            mine = take(lacking, summary)
            if mine is not None:
                under_way[mine.evaluation.job.run, mine.evaluation.checkpoint.step] = mine
                yield from mine.tasks

    run = cast(Callable[..., Generator[Scores | Failure, None, None]], mapper)
    try:
        with closing(run(attempt, tasks())) as parts:  # so that what is left of them is cancelled while it is ours
            for part in parts:
                mine = under_way[part.run, part.step]
                mine.parts.append(part)
                if len(mine.parts) == len(mine.tasks):
                    finish(mine, summary)
                    del under_way[part.run, part.step]
                    mine.lock.release()
    finally:
        for mine in under_way.values():
            mine.lock.release()


def take(lacking: Lacking, summary: Summary) -> UnderWay | None:
    """Hold a checkpoint and begin what it still lacks; None where there is nothing to do for this process."""
    lock = lock_of(lacking.job.run, lacking.target.name)
    try:
        lock.acquire(blocking=False)
    except Timeout:
        summary.elsewhere += len(lacking.protocols)
        return None
    taken = None
    try:
        taken = begin(lacking, lock, summary)
    except CheckpointError as error:
        summary.skipped.append(f"{lacking}: {error}")
    except (CrossrayError, OSError) as error:
        summary.failed.append(f"{lacking}: {error}")
    finally:
        if taken is None:
            lock.release()
    return taken


def begin(lacking: Lacking, lock: FileLock, summary: Summary) -> UnderWay | None:
    """What a held checkpoint still lacks: another pass may have been quicker."""
    job, target, protocols = lacking
    checkpoint = described(target)
    missing = [name for name in protocols if recorded(job.run, name, checkpoint) is None]
    summary.there += len(protocols) - len(missing)
    if not missing:
        return None
    evaluation = prepare(job, read_checkpoint(target), missing)
    return UnderWay(evaluation, evaluation.begin(), lock)


def finish(mine: UnderWay, summary: Summary) -> None:
    """Commit an evaluation whose tasks are done."""
    where = f"{mine.evaluation.job.run}, {mine.evaluation.checkpoint.folder.name}"
    scores = [part for part in mine.parts if isinstance(part, Scores)]
    failures = [part for part in mine.parts if isinstance(part, Failure)]
    if any(failure.gone for failure in failures):
        summary.skipped.append(f"{where}: it was removed before it was evaluated")
    elif failures:
        summary.failed.append(f"{where}: {failures[0].reason}")
    else:
        try:
            results = mine.evaluation.commit(scores)
        except OSError as error:
            summary.failed.append(f"{where}: {error}")
            return
        summary.evaluated += len(results)
        for result in results:
            log.info("%s, %s: PSNR %.2f", where, result["protocol"], result["mean"]["psnr"])
