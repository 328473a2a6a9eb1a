"""Scores of a trained run on its test photos, exactly as a protocol says.

A protocol fixes everything that moves a number, and is always named with its downscale: `crnerf-full@R4`. Pictures and
`metrics.json` go to `<run>/eval/<protocol>/step-<step>/`; metrics.json is written last.

The views of a checkpoint are tasks: `score_views` is a pure function of a `Views`, and a mapper
(pipeline/launch/tasks.py) runs them in this process or on a cluster. However they are split, the numbers are the same.
A lock a checkpoint keeps two processes from evaluating the same one.
"""

from __future__ import annotations

import importlib.metadata
import json
import logging
import os
import platform
import re
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
import yaml
from filelock import FileLock, Timeout
from PIL import Image
from pydantic import BaseModel, ConfigDict

from model.methods import ModelSpec, smallest_side
from model.scene_model import SceneModel
from pipeline.best import write_best
from pipeline.board import write_evaluation
from pipeline.checkpoint import (
    META,
    MODEL,
    Checkpoint,
    CheckpointError,
    committed,
    digest,
    folder_name,
    latest_checkpoint,
    read_checkpoint,
)
from pipeline.config import Job, load_job
from pipeline.errors import CrossrayError
from pipeline.files import atomic_file, atomic_write
from pipeline.fit import FitRecipe, fit_code
from pipeline.landmark import Landmark
from pipeline.lpips import LPIPS, VARIABLE, find_lpips, read_lpips
from pipeline.metrics import psnr, ssim_11, ssim_window3, to_8bit
from pipeline.photos import Photos, open_photos
from pipeline.progress import Progress
from pipeline.render import View, colour_view, read_appearance, render_picture, render_view
from pipeline.train import device_name
from pipeline.truth import check_truth, elsewhere, mask_iou, reduced, truth_of

log = logging.getLogger("crossray")

METRICS = "metrics.json"
LPIPS_SIDE = 31  # pixels; AlexNet has nothing left of a smaller picture
AFFINE = "+affine"  # suffix of the control: colours fitted to the photo's left half by one affine map
MASK_PHOTOS = 32  # training photos over which masks are compared with the truth, at most

Mapper = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]


class CheckpointGone(CheckpointError):
    """The checkpoint was removed, or written anew, while it was being evaluated: nothing is wrong with the run."""


class Protocol(BaseModel):
    """What is read, what is scored, and how (one file each in pipeline/protocols)."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    appearance: Literal["whole", "left", "elsewhere"]
    scored: Literal["right", "whole"]
    truth: Literal["photo", "clean"]
    rounding: Literal["truncate", "round"]
    ssim: Literal["window3", "window11"]
    mlp_samples: tuple[int, int]
    fit: dict[Literal["mlp", "hash"], FitRecipe]


def parse_protocol(name: str) -> tuple[Protocol, int, bool]:
    """`crnerf-full@R4[+affine]` -> protocol, downscale, whether the affine control is asked for.

    Raises:
        CrossrayError: an unknown name, or one without its downscale.
    """
    known = sorted(
        p.name.removesuffix(".yaml") for p in files("pipeline.protocols").iterdir() if p.name.endswith(".yaml")
    )
    match = re.fullmatch(r"([a-z0-9-]+)@R([1-9][0-9]*)(\+affine)?", name)
    if match is None:
        raise CrossrayError(
            f"protocol {name!r}: write a protocol with its downscale, for example {known[0]}@R4 "
            f"(known: {', '.join(known)}; a trailing {AFFINE} adds the affine control)"
        )
    if match[1] not in known:
        raise CrossrayError(f"protocol {match[1]!r} is not known (known: {', '.join(known)})")
    text = files("pipeline.protocols").joinpath(f"{match[1]}.yaml").read_text()
    protocol, affine = Protocol.model_validate(yaml.safe_load(text)), match[3] is not None
    if affine and protocol.appearance == "elsewhere":
        raise CrossrayError(f"protocol {name}: the affine control looks at the scored photo, which {match[1]} forbids")
    return protocol, int(match[2]), affine


def job_of(run: Path) -> Job:
    """The job of a run's folder. A run that was moved is where it is now; its shards stay where they were.

    Raises:
        CrossrayError: no such run.
    """
    if not (run / "job.yaml").is_file():
        raise CrossrayError(f"{run} is not a run: it has no job.yaml")
    job, folder = load_job(run / "job.yaml"), run.resolve()
    scene = job.scene.model_copy(update={"shards": job.shards})
    return job.model_copy(update={"runs": folder.parent, "name": folder.name, "scene": scene})


def checkpoint_of(run: Path, step: int | None = None) -> Checkpoint:
    """A run's checkpoint of `step`, by default the newest whole one.

    Raises:
        CheckpointError: there is none, or it is damaged.
    """
    if step is None:
        checkpoint = latest_checkpoint(run / "checkpoints")
        if checkpoint is None:
            raise CheckpointError(f"{run / 'checkpoints'}: no committed checkpoint; has the run been trained?")
        return checkpoint
    steps = [int(p.name.removeprefix("step-")) for p in committed(run / "checkpoints")]
    if step not in steps:
        raise CheckpointError(f"{run}: no checkpoint of step {step}; there are {', '.join(map(str, steps)) or 'none'}")
    return read_checkpoint(run / "checkpoints" / folder_name(step))


def model_of(job: Job, checkpoint: Checkpoint, device: torch.device | None = None) -> SceneModel:
    """A checkpoint's model in evaluation mode; by default on the GPU that this process has, if the job wants one."""
    torch.backends.cudnn.allow_tf32 = False  # as in training
    device = device or torch.device("cuda" if torch.cuda.is_available() and job.device != "cpu" else "cpu")
    box = torch.zeros(2, 3)  # the scene's box is one of its buffers
    model = SceneModel(job.model, box, checkpoint.meta["photos"]).to(device).requires_grad_(False)
    model.load_state_dict(checkpoint.model)
    return model.eval()


def load_run(
    run: Path, step: int | None = None, device: torch.device | None = None
) -> tuple[Job, SceneModel, Checkpoint]:
    """A run's job, its model in evaluation mode, and the checkpoint that it was read from (the newest, or `step`).

    Raises:
        CrossrayError: no such run, or no usable checkpoint in it.
    """
    job, checkpoint = job_of(run), checkpoint_of(run, step)
    return job, model_of(job, checkpoint, device), checkpoint


def photos_of(job: Job, checkpoint: Checkpoint) -> Photos:
    """The photos that a checkpoint was trained on.

    Raises:
        CrossrayError: the job's shards hold other ones, or cannot be read.
    """
    photos = open_photos(job.shards)
    if photos.manifest.content_hash != checkpoint.meta["shards"]:
        raise CrossrayError(
            f"{job.shards}: other photos or masks than {job.run} was trained on; --set scene.shards=... in a new run, "
            "or cut the shards again as they were"
        )
    return photos


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


class Scores(NamedTuple):
    """What became of a task; by protocol."""

    run: Path
    step: int
    rows: dict[str, dict[int, dict[str, Any]]]  # photo -> metrics
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
        lpips = None
        if task.lpips:
            lpips = read_lpips(task.weights) if task.weights else find_lpips()
            if lpips is None:
                raise CrossrayError("LPIPS: the weights that were found before are not on this machine")
        judges, shared = {}, Shared()
        for name in task.protocols:
            protocol = parse_protocol(name)[0]
            landmark = truth_of(task.job, photos) if protocol.truth == "clean" else None
            judges[name] = Judge(model, photos, protocol, landmark, shared)
        rows: dict[str, dict[int, dict[str, Any]]] = {name: {} for name in judges}
        seconds = dict.fromkeys(judges, 0.0)
        for index in task.photos:
            for name, judge in judges.items():
                began = time.perf_counter()
                folder = results_folder(task.job.run, name, task.step)
                rows[name][index] = score_view(judge, index, folder, name, lpips if name in task.lpips else None)
                seconds[name] += time.perf_counter() - began
        masks = {name: judge.masks() for name, judge in judges.items()} if task.masks else {}
        return Scores(task.job.run, task.step, rows, masks, seconds, device_name(next(model.parameters()).device))


def score_view(judge: Judge, index: int, folder: Path, name: str, lpips: LPIPS | None) -> dict[str, Any]:
    """One view under one protocol: its pictures in `folder`, its metrics."""
    view, picture = judge.render(index)
    if parse_protocol(name)[2]:
        picture = fit_colours(picture, judge.photos.image(index))
    prediction, key = to_8bit(picture, judge.protocol.rounding), judge.photos.records[index].key
    row = judge.score(prediction, index, lpips)
    save_png(folder / f"{key}.png", prediction)
    save_png(folder / f"{key}.depth.png", depth_picture(view))
    return row


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
        _latest[key] = model_of(task.job, checkpoint), photos_of(task.job, checkpoint)
    return _latest[key]


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
        mean = {k: float(np.mean([r[k] for r in rows])) for k in rows[0] if k not in ("name", "key")}
        for part in parts:
            mean |= part.masks.get(name, {})
        return {
            "protocol": name,
            "definition": protocol.model_dump(mode="json"),
            "step": self.checkpoint.step,
            "checkpoint_sha256": self.checkpoint.meta["sha256"][MODEL],
            "method": self.job.method,
            "samples": list(samples_of(spec, protocol) or ()) or "as in training",
            "appearance_from": appearance_from(spec, protocol),
            "mean": mean,
            "images": rows,
            "seconds": sum(part.seconds.get(name, 0.0) for part in parts),
            "device": ", ".join(sorted({part.device for part in parts})),
            "versions": {p: importlib.metadata.version(p) for p in ("torch", "numpy", "pillow", "scikit-image")},
            "python": platform.python_version(),
        }


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
            psnrs = [row["psnr"] for p in parts for row in p.rows.get(first, {}).values()]
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
    with lock_of(run, "best"):
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


@dataclass
class Shared:
    """What the protocols of one checkpoint need not do twice."""

    codes: dict[tuple[FitRecipe, int, str], torch.Tensor] = field(default_factory=dict)
    """(recipe, photo, what it was read from) -> fitted code."""
    views: dict[tuple[int, tuple[int, int] | None], View] = field(default_factory=dict)
    """(photo, samples) -> view, of the latest photo alone: it takes as much memory as all else."""


class Judge:
    """One model under one protocol: what it may see of a test photo, and what its picture is compared with.

    Args:
        landmark: the truth behind the photos, for a protocol that scores against it.
        shared: with the judges of the same model under other protocols.
    """

    def __init__(
        self,
        model: SceneModel,
        photos: Photos,
        protocol: Protocol,
        landmark: Landmark | None,
        shared: Shared | None = None,
    ) -> None:
        self.model, self.photos, self.protocol, self.landmark = model, photos, protocol, landmark
        self.shared = shared or Shared()
        self.appearance_from = appearance_from(model.spec, protocol)

    def render(self, index: int) -> tuple[View, np.ndarray]:
        """A test photo's view in the appearance that the protocol lets the model see."""
        camera, appearance = self.photos.records[index], self.appearance(index)
        samples = samples_of(self.model.spec, self.protocol)
        if self.model.coded:  # the field itself reads the appearance: another view for each
            return render_picture(self.model, camera, appearance, samples)
        key = (index, samples)
        if key not in self.shared.views:
            self.shared.views.clear()
            self.shared.views[key] = render_view(self.model, camera, samples=samples)
        view = self.shared.views[key]
        return view, colour_view(self.model, view, appearance)

    def appearance(self, index: int) -> torch.Tensor | None:
        """F^a of a test photo."""
        if self.model.spec.appearance == "none":
            return None
        source, image, reference = index, self.photos.image(index), self.photos.reference(index)
        if self.protocol.appearance == "elsewhere":
            source = elsewhere(self.photos, index)
            image = self.clean(source, index)
            reference = reduced(image, self.photos.manifest.reference_downscale)
        if self.appearance_from == "left":
            reference = left_half(reference)
        if self.model.embedding is None:
            self.check_reference(reference, index)
            return read_appearance(self.model, reference)
        codes, key = self.shared.codes, (self.recipe, index, self.appearance_from)
        if key not in codes:
            columns = left_half(image).shape[1] if self.appearance_from == "left" else image.shape[1]
            camera = self.photos.records[source]
            codes[key] = fit_code(self.model, image, camera, columns, self.recipe, seed=index)
        return codes[key]

    def check_reference(self, reference: np.ndarray, index: int) -> None:
        """CrossrayError where what may be seen of a photo is too small for the appearance network."""
        least, (height, width) = smallest_side(self.model.spec), reference.shape[:2]
        if min(height, width) < least:
            raise CrossrayError(
                f"{self.photos.records[index].name}: {width} x {height} pixels of its reference may be read "
                f"({self.appearance_from}), and model.encoder: released reads no side under {least}; cut the shards "
                "with a smaller scene.reference_downscale"
            )

    @property
    def recipe(self) -> FitRecipe:
        """How codes are fitted."""
        return self.protocol.fit[self.model.spec.field]

    def clean(self, view: int, light: int) -> np.ndarray:
        """The landmark in the view of one photo and the light of another, nobody there."""
        assert self.landmark is not None
        return self.landmark.truth(self.photos.records[view].name, self.photos.records[light].name)

    def score(self, prediction: np.ndarray, index: int, lpips: LPIPS | None) -> dict[str, Any]:
        """The metrics of one 8-bit prediction."""
        truth = self.photos.image(index) if self.protocol.truth == "photo" else self.clean(index, index)
        name, key = self.photos.records[index].name, self.photos.records[index].key
        return {"name": name, "key": key, **score(prediction, truth, self.protocol, lpips, name)}

    def masks(self) -> dict[str, float]:
        """Where the truth is known: how well the model's masks agree with it, on training photos. Masks that were
        given to the model are none of its own."""
        if self.landmark is None or self.model.spec.transient == "fixed":
            return {}
        train = self.photos.indices("train")
        iou = mask_iou(self.model, self.photos, self.landmark, train[:: -(-len(train) // MASK_PHOTOS)])
        return {} if iou is None else {"mask_iou": iou}


def appearance_from(spec: ModelSpec, protocol: Protocol) -> str:
    """What appearances are read from. A learned code is fitted, which on scored pixels would be training on them: so it
    sees the left half where others see the whole photo."""
    if spec.appearance == "none":
        return "nothing"
    fitted = spec.appearance == "embedding" and protocol.appearance == "whole"
    return "left" if fitted else protocol.appearance


def left_half(picture: np.ndarray) -> np.ndarray:
    """The left half of (h, w, ...), with the middle column where the width is odd."""
    return picture[:, : picture.shape[1] - picture.shape[1] // 2]


def lpips_usable(photos: Photos, indices: tuple[int, ...], protocol: Protocol) -> bool:
    """Whether the weights of LPIPS are found and all pictures are large enough; if not, the log says why."""
    if find_lpips() is None:
        warn_once(f"LPIPS is left out: no weights found; {VARIABLE}=/path/to/lpips_alex.npz names them")
        return False
    for record in (photos.records[i] for i in indices):
        width = record.width // 2 if protocol.scored == "right" else record.width
        if min(record.height, width) < LPIPS_SIDE:
            warn_once(f"LPIPS is left out: what is scored of {record.name} has a side under {LPIPS_SIDE} pixels")
            return False
    return True


@cache
def warn_once(text: str) -> None:
    """A warning that several evaluations share."""
    log.warning(text)


def samples_of(spec: ModelSpec, protocol: Protocol) -> tuple[int, int] | None:
    """Sample counts of the rendering; None keeps those of training (the protocols only speak of the MLP field)."""
    return protocol.mlp_samples if spec.field == "mlp" else None


def score(
    prediction: np.ndarray, truth: np.ndarray, protocol: Protocol, lpips: LPIPS | None, name: str
) -> dict[str, float]:
    """The metrics of one 8-bit prediction against the 8-bit truth, both (h, w, 3); `name` is for messages."""
    start = truth.shape[1] // 2 if protocol.scored == "right" else 0
    prediction, truth = np.ascontiguousarray(prediction[:, start:]), np.ascontiguousarray(truth[:, start:])
    ssim, least = (ssim_window3, 3) if protocol.ssim == "window3" else (ssim_11, 11)
    if min(truth.shape[:2]) < least:
        raise CrossrayError(
            f"{name}: its scored part is {truth.shape[1]} x {truth.shape[0]} pixels, smaller "
            f"than the SSIM window of {least}; evaluate at a smaller downscale"
        )
    scores = {"psnr": psnr(prediction, truth), "ssim": ssim(prediction, truth)}
    return scores if lpips is None else scores | {"lpips": lpips.distance(prediction, truth)}


def fit_colours(picture: np.ndarray, photo: np.ndarray) -> np.ndarray:
    """`picture` (h, w, 3) in [0, 1] through the affine colour map that fits the photo's left half best.

    The honest control for every appearance model: least squares over the left half, 12 numbers, nothing learned.
    """
    left = photo.shape[1] - photo.shape[1] // 2
    ones = np.ones((*picture.shape[:2], 1))
    inputs = np.concatenate([picture, ones], axis=-1)
    target = photo[:, :left].reshape(-1, 3) / 255
    solution, *_ = np.linalg.lstsq(inputs[:, :left].reshape(-1, 4), target, rcond=None)
    return np.clip(inputs @ solution, 0, 1)


def depth_picture(view: View) -> np.ndarray:
    """Depth as uint8 (h, w): near is bright, nothing is black."""
    depth = view.depth / view.accumulation.clamp(min=1e-3)
    near, far = torch.quantile(depth.flatten()[:1_000_000], torch.tensor([0.01, 0.99], device=depth.device))
    bright = (1 - 0.85 * ((depth - near) / (far - near).clamp(min=1e-6)).clamp(0, 1)) * view.accumulation.clamp(0, 1)
    return (255 * bright).round().byte().cpu().numpy()


def save_png(path: Path, picture: np.ndarray) -> None:
    """A uint8 picture as PNG."""
    with atomic_file(path) as file:
        Image.fromarray(picture).save(file, format="PNG")


def check_downscale(job: Job, protocol_name: str, downscale: int) -> None:
    """CrossrayError where a protocol's pictures are not of the size of the job's photos."""
    if downscale != job.scene.downscale:
        raise CrossrayError(
            f"protocol {protocol_name}: the photos of {job.name} are at R{job.scene.downscale}; "
            f"evaluate under {protocol_name.split('@')[0]}@R{job.scene.downscale}, or train at R{downscale}"
        )


def check_protocol(job: Job, name: str) -> None:
    """CrossrayError where a job's runs cannot be evaluated under a protocol."""
    protocol, downscale, _ = parse_protocol(name)
    check_downscale(job, name, downscale)
    if protocol.truth == "clean":
        check_truth(job)


def check_protocols(job: Job) -> None:
    """CrossrayError for a protocol that could only be refused after the training."""
    for name in job.evaluate.protocols:
        check_protocol(job, name)


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
