"""Scores of a trained run on its test photos, exactly as a protocol says.

A protocol fixes everything that moves a number, and is always named with its downscale: `crnerf-full@R4`. Pictures and
`metrics.json` go to `<run>/eval/<protocol>/step-<step>/`; metrics.json is written last.

The views of a checkpoint are tasks: `score_views` is a pure function of a `Views`, and a mapper
(pipeline/launch/tasks.py) runs them in this process or on a cluster. However they are split, the numbers are the same.
A lock a checkpoint keeps two processes from evaluating the same one.
"""

from __future__ import annotations

import json
import logging
import os
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from filelock import FileLock, Timeout
from PIL import Image

from model.scene_model import SceneModel
from pipeline.best import lock_of_best, write_best
from pipeline.board import write_evaluation
from pipeline.bootstrap import interval
from pipeline.checkpoint import (
    META,
    MODEL,
    Checkpoint,
    CheckpointError,
    committed,
    digest,
    folder_name,
    read_checkpoint,
)
from pipeline.config import Job
from pipeline.errors import CrossrayError
from pipeline.files import atomic_file, atomic_write
from pipeline.judge import Judge, Shared, depth_picture, lpips_at, lpips_usable
from pipeline.lpips import LPIPS, VARIABLE
from pipeline.metrics import to_8bit
from pipeline.photos import Photos
from pipeline.progress import Progress
from pipeline.protocol import appearance_from, check_protocol, parse_protocol, policy_of, samples_of
from pipeline.provenance import device_name, provenance
from pipeline.runs import checkpoint_of, job_of, model_of, photos_of
from pipeline.truth import truth_of

log = logging.getLogger("crossray")

METRICS = "metrics.json"

Mapper = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]


class CheckpointGone(CheckpointError):
    """The checkpoint was removed, or written anew, while it was being evaluated: nothing is wrong with the run."""


# --------------------------------------------------------------------------------------------------------- tasks


class Views(NamedTuple):
    """A task: some test views of one checkpoint, under protocols that share what is rendered and fitted."""

    job: Job
    step: int
    checkpoint: str  # SHA-256 of its weights
    protocols: tuple[str, ...]
    photos: tuple[int, ...]  # which test photos
    masks: bool  # whether masks are compared with the truth, where it is known
    lpips: tuple[str, ...]  # of the protocols, those under which LPIPS is scored
    weights: Path | None  # of LPIPS, where the environment of whoever asks for the evaluation names them


class Row(NamedTuple):
    """What became of one view under one protocol."""

    metrics: dict[str, Any]  # its name and key, and its scores
    appearance_seconds: float
    render_seconds: float


class Scores(NamedTuple):
    """What became of a task; by protocol."""

    run: Path
    step: int
    rows: dict[str, dict[int, Row]]  # by photo
    masks: dict[str, dict[str, float]]
    seconds: dict[str, float]
    device: str


def score_views(task: Views) -> Scores:
    """Render a task's views and score them; their pictures are written, `metrics.json` is left to the caller.

    Raises:
        CheckpointGone: the checkpoint is not there any more.
        CrossrayError: the checkpoint, the photos or the weights of LPIPS cannot be used on this machine.
    """
    with threads_of(task.job):
        model, photos = loaded(task)
        lpips = lpips_at(task.weights) if task.lpips else None
        judges, shared = {}, Shared()
        for name in task.protocols:
            protocol = parse_protocol(name)[0]
            landmark = truth_of(task.job, photos) if protocol.truth == "clean" else None
            judges[name] = Judge(model, photos, protocol, landmark, shared)
        rows: dict[str, dict[int, Row]] = {name: {} for name in judges}
        seconds = dict.fromkeys(judges, 0.0)
        for index in task.photos:
            for name, judge in judges.items():
                began = time.perf_counter()
                folder = results_folder(task.job.run, name, task.step)
                rows[name][index] = score_view(judge, index, folder, lpips if name in task.lpips else None)
                seconds[name] += time.perf_counter() - began
        masks = {name: judge.masks() for name, judge in judges.items()} if task.masks else {}
        return Scores(task.job.run, task.step, rows, masks, seconds, device_name(next(model.parameters()).device))


def score_view(judge: Judge, index: int, folder: Path, lpips: LPIPS | None) -> Row:
    """One view under one protocol: its pictures in `folder`, its metrics."""
    judged = judge.render(index)
    prediction, key = to_8bit(judged.picture, judge.protocol.rounding), judge.photos.records[index].key
    metrics = judge.score(prediction, index, lpips)
    save_png(folder / f"{key}.png", prediction)
    save_png(folder / f"{key}.depth.png", depth_picture(judged.view))
    return Row(metrics, judged.appearance_seconds, judged.render_seconds)


@contextmanager
def threads_of(job: Job) -> Iterator[None]:
    """The job's torch threads, or those that the process has if they are more."""
    before = torch.get_num_threads()
    torch.set_num_threads(max(job.threads, before))
    try:
        yield
    finally:
        torch.set_num_threads(before)


_latest: dict[tuple[Path, str], tuple[SceneModel, Photos]] = {}  # of the task before: the next one is mostly alike


def loaded(task: Views) -> tuple[SceneModel, Photos]:
    """A task's model and photos, read once a process as long as its tasks are of one checkpoint."""
    key = (task.job.run, task.checkpoint)
    if key not in _latest:
        _latest.clear()
        folder = task.job.run / "checkpoints" / folder_name(task.step)
        try:
            checkpoint = read_checkpoint(folder)
        except CheckpointError as error:
            if (folder / META).exists():
                raise
            raise CheckpointGone(f"{folder}: it was removed before it was evaluated") from error
        if checkpoint.meta["sha256"][MODEL] != task.checkpoint:
            raise CheckpointGone(f"{folder}: it was written anew while it was being evaluated")
        model = model_of(task.job, checkpoint)
        check_finite(model, folder)
        _latest[key] = model, photos_of(task.job, checkpoint)
    return _latest[key]


def check_finite(model: SceneModel, folder: Path) -> None:
    """CrossrayError where a weight is NaN or infinite: what it would render is nothing, or nothing that says why."""
    for name, value in model.state_dict().items():
        if not value.isfinite().all():
            raise CrossrayError(
                f"{folder}: {name} holds values that are not finite, so nothing can be scored; evaluate an earlier "
                "checkpoint (--step), and see the run's losses for when that began"
            )


# ---------------------------------------------------------------------------------------------------- evaluations


@dataclass(frozen=True)
class Evaluation:
    """One checkpoint under some protocols: its tasks, and what their scores add up to.

    Whoever runs the tasks holds the checkpoint (`lock_of`) from before `begin` until after `commit`.
    """

    job: Job
    checkpoint: Checkpoint
    protocols: tuple[str, ...]
    photos: Photos

    @property
    def indices(self) -> tuple[int, ...]:
        """Which photos are scored."""
        return self.photos.indices("test")

    def folder(self, name: str) -> Path:
        """Where the results under a protocol go."""
        return results_folder(self.job.run, name, self.checkpoint.step)

    def begin(self) -> list[Views]:
        """The tasks. Results of another checkpoint of this step must not vouch for new pictures: they go."""
        definitions = {name: parse_protocol(name)[0] for name in self.protocols}
        for name in self.protocols:
            if recorded(self.job.run, name, self.checkpoint) is None:
                (self.folder(name) / METRICS).unlink(missing_ok=True)
        named = os.environ.get(VARIABLE)
        task = Views(
            job=self.job,
            step=self.checkpoint.step,
            checkpoint=self.checkpoint.meta["sha256"][MODEL],
            protocols=self.protocols,
            photos=(),
            masks=False,
            lpips=tuple(n for n, p in definitions.items() if lpips_usable(self.photos, self.indices, p)),
            weights=Path(named).absolute() if named else None,
        )
        tasks = [task._replace(photos=(index,)) for index in self.indices]
        clean = tuple(name for name, protocol in definitions.items() if protocol.truth == "clean")
        return tasks + ([task._replace(protocols=clean, lpips=(), masks=True)] if clean else [])

    def commit(self, parts: Sequence[Scores]) -> list[dict[str, Any]]:
        """Record the scores of all tasks: curves, then metrics.json, then the pointer to the best checkpoint; returns
        what each protocol's metrics.json holds."""
        results = []
        for name in self.protocols:
            folder, result = self.folder(name), self.result(name, parts)
            for stray in folder.glob(".*.tmp"):  # of tasks that were killed
                stray.unlink(missing_ok=True)
            with Image.open(folder / f"{result['images'][0]['key']}.png") as picture:
                board = self.job.run / "tensorboard" / "eval"
                write_evaluation(board, self.checkpoint.step, name, result["mean"], np.asarray(picture))
            atomic_write(folder / METRICS, json.dumps(result, indent=2))
            update_best(self.job.run, name)
            results.append(result)
        return results

    def result(self, name: str, parts: Sequence[Scores]) -> dict[str, Any]:
        """What metrics.json holds of one protocol."""
        protocol, spec = parse_protocol(name)[0], self.job.model
        found = {index: row for part in parts for index, row in part.rows.get(name, {}).items()}
        rows = [found[index] for index in self.indices]
        images = [row.metrics for row in rows]
        values = {k: [image[k] for image in images] for k in images[0] if k not in ("name", "key")}
        mean = {metric: float(np.mean(of)) for metric, of in values.items()}
        for part in parts:
            mean |= part.masks.get(name, {})
        origin = provenance()
        return {
            "protocol": name,
            "definition": protocol.model_dump(mode="json"),
            "step": self.checkpoint.step,
            "checkpoint_sha256": self.checkpoint.meta["sha256"][MODEL],
            "method": self.job.method,
            "samples": list(samples_of(spec, protocol) or ()) or "as in training",
            "appearance_from": appearance_from(spec, protocol),
            "statistics": policy_of(spec),
            "mean": mean,
            "interval": {metric: as_list(interval(values.get(metric, ()))) for metric in mean},
            "images": images,
            "seconds": sum(part.seconds.get(name, 0.0) for part in parts),
            "appearance_seconds": float(np.mean([row.appearance_seconds for row in rows])),
            "render_seconds": float(np.mean([row.render_seconds for row in rows])),
            "device": ", ".join(sorted({part.device for part in parts})),
            "versions": origin["versions"],
            "python": origin["python"],
            "provenance": origin,
        }


def as_list(found: tuple[float, float] | None) -> list[float] | None:
    """As JSON gives it back."""
    return None if found is None else list(found)


def prepare(job: Job, checkpoint: Checkpoint, protocols: Sequence[str]) -> Evaluation:
    """An evaluation that is not begun.

    Raises:
        CrossrayError: a protocol, or the shards, cannot be used.
    """
    for name in protocols:
        check_protocol(job, name)
    photos = photos_of(job, checkpoint)
    if not photos.indices("test"):
        raise CrossrayError(f"{job.shards}: no test photos, so there is nothing to evaluate; see the split table")
    for name in protocols:
        if parse_protocol(name)[0].truth == "clean":
            truth_of(job, photos)
    return Evaluation(job, checkpoint._replace(model={}), tuple(dict.fromkeys(protocols)), photos)


def evaluate_run(run: Path, protocol: str, step: int | None = None) -> dict[str, Any]:
    """Like evaluate_protocols, for one."""
    return evaluate_protocols(run, [protocol], step)[0]


def evaluate_protocols(
    run: Path, protocols: Sequence[str], step: int | None = None, mapper: Mapper = map
) -> list[dict[str, Any]]:
    """Evaluate a run's checkpoint (the newest, or `step`) on its test photos, also if that was done before; returns
    what each protocol's metrics.json holds.

    Raises:
        CrossrayError: the run, a protocol or the shards cannot be used.
    """
    for name in protocols:
        parse_protocol(name)
    evaluation = prepare(job_of(run), checkpoint_of(run, step), protocols)
    with alone(evaluation.checkpoint):
        return carry_out(evaluation, mapper)


def run_protocols(job: Job, mapper: Mapper = map) -> list[dict[str, Any]]:
    """Every protocol that the job asks for, for its newest checkpoint; what that was scored under before is read, not
    done again."""
    if not job.evaluate.protocols:
        return []
    newest = checkpoint_of(job.run)
    with alone(newest):
        done = {name: recorded(job.run, name, newest) for name in job.evaluate.protocols}
        lacking = [name for name, result in done.items() if result is None]
        if lacking:
            fresh = carry_out(prepare(job_of(job.run), newest, lacking), mapper)
            done |= {result["protocol"]: result for result in fresh}
    return [result for result in done.values() if result is not None]


def carry_out(evaluation: Evaluation, mapper: Mapper) -> list[dict[str, Any]]:
    """Run an evaluation's tasks, with a progress line, and commit it."""
    first, *others = evaluation.protocols
    more = f" and {len(others)} more" if others else ""
    progress = Progress(f"evaluating {evaluation.job.name} under {first}{more}")
    parts: list[Scores] = []
    try:
        for part in mapper(score_views, evaluation.begin()):
            parts.append(part)
            psnrs = [row.metrics["psnr"] for p in parts for row in p.rows.get(first, {}).values()]
            progress.update(len(psnrs) / len(evaluation.indices), f"PSNR {np.mean(psnrs):.2f}" if psnrs else "")
    finally:
        progress.close()
    return evaluation.commit(parts)


def results_folder(run: Path, protocol_name: str, step: int) -> Path:
    """Where pictures and metrics.json of a checkpoint under a protocol are."""
    return run / "eval" / protocol_name / folder_name(step)


def lock_of(run: Path, name: str) -> FileLock:
    """Held by whoever evaluates the checkpoint of this name; whoever dies lets go of it."""
    folder = run / ".evaluating"
    folder.mkdir(parents=True, exist_ok=True)
    return FileLock(folder / f"{name}.lock")


@contextmanager
def alone(checkpoint: Checkpoint) -> Iterator[None]:
    """Wait until nobody else evaluates this checkpoint, and hold it."""
    run, name = checkpoint.folder.parents[1], checkpoint.folder.name
    lock = lock_of(run, name)
    try:
        lock.acquire(timeout=1)
    except Timeout:
        log.info("%s, %s: another process is evaluating it; waiting for that", run, name)
        lock.acquire()
    try:
        yield
    finally:
        lock.release()


def update_best(run: Path, protocol_name: str) -> None:
    """Point `best.json` of a protocol to the best checkpoint that is there."""
    with lock_of_best(run):
        results = []
        for target in committed(run / "checkpoints"):
            try:
                results.append(recorded(run, protocol_name, described(target)))
            except CheckpointError:
                continue
        write_best(run / "eval" / protocol_name, [result for result in results if result is not None])


def described(target: Path) -> Checkpoint:
    """What a checkpoint says of itself: its tensors are neither read nor verified.

    Raises:
        CheckpointError: it is not there, or its description is damaged.
    """
    try:
        meta = json.loads((target / META).read_text())
        if meta["digest"] != digest(meta) or target.name != folder_name(meta["step"]):
            raise CheckpointError(f"{target / META}: its content is not what was written: damaged")
        return Checkpoint(target, int(meta["step"]), {}, meta)
    except FileNotFoundError as error:
        raise CheckpointGone(f"{target}: it was removed before it was evaluated") from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise CheckpointError(f"{target}: cannot be read ({type(error).__name__}: {error})") from error


# --------------------------------------------------------------------------------------------------------- judging


def save_png(path: Path, picture: np.ndarray) -> None:
    """A uint8 picture as PNG."""
    with atomic_file(path) as file:
        Image.fromarray(picture).save(file, format="PNG")


def recorded(run: Path, protocol_name: str, checkpoint: Checkpoint) -> dict[str, Any] | None:
    """An evaluation of just this checkpoint under just this definition of the protocol, if it was made before. One that
    cannot be read was not."""
    try:
        result = json.loads((results_folder(run, protocol_name, checkpoint.step) / METRICS).read_text())
        of, defined, _ = result["checkpoint_sha256"], result["definition"], float(result["mean"]["psnr"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
    definition = parse_protocol(protocol_name)[0].model_dump(mode="json")
    return result if (of, defined) == (checkpoint.meta["sha256"][MODEL], definition) else None
