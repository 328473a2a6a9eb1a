"""Scores of a trained run on its test photos, exactly as a protocol says.

A protocol fixes everything that moves a number, and is always named with its downscale: `crnerf-full@R4`. Pictures and
`metrics.json` go to `<run>/eval/<protocol>/step-<step>/`; metrics.json is written last.
"""

from __future__ import annotations

import importlib.metadata
import json
import logging
import platform
import re
import time
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import yaml
from PIL import Image
from pydantic import BaseModel, ConfigDict

from model.methods import smallest_side
from model.scene_model import SceneModel
from pipeline.checkpoint import (
    MODEL,
    Checkpoint,
    CheckpointError,
    committed,
    folder_name,
    latest_checkpoint,
    read_checkpoint,
)
from pipeline.config import Job, load_job
from pipeline.errors import CrossrayError
from pipeline.files import atomic_file, atomic_write
from pipeline.fit import FitRecipe, fit_code
from pipeline.landmark import Landmark
from pipeline.lpips import LPIPS, find_lpips
from pipeline.metrics import psnr, ssim_11, ssim_window3, to_8bit
from pipeline.photos import Photos, open_photos
from pipeline.progress import Progress
from pipeline.render import View, read_appearance, render_picture
from pipeline.train import device_name
from pipeline.truth import check_truth, elsewhere, mask_iou, reduced, truth_of

log = logging.getLogger("crossray")

LPIPS_SIDE = 31  # pixels; AlexNet has nothing left of a smaller picture
AFFINE = "+affine"  # suffix of the control: colours fitted to the photo's left half by one affine map
MASK_PHOTOS = 32  # training photos over which masks are compared with the truth, at most

# Appearance codes that were fitted: of a checkpoint and a recipe, (photo, what it was read from) -> code.
Codes = dict[tuple[str, FitRecipe], dict[tuple[int, str], torch.Tensor]]


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


def load_run(
    run: Path, step: int | None = None, device: torch.device | None = None
) -> tuple[Job, SceneModel, Checkpoint]:
    """A run's job, its model in evaluation mode, and the checkpoint that it was read from (the newest, or `step`).

    Raises:
        CrossrayError: no such run, or no usable checkpoint in it.
    """
    if not (run / "job.yaml").is_file():
        raise CrossrayError(f"{run} is not a run: it has no job.yaml")
    job = load_job(run / "job.yaml")
    folder = run.resolve()
    scene = job.scene.model_copy(update={"shards": job.shards})  # which stay where they were if the run is moved
    job = job.model_copy(update={"runs": folder.parent, "name": folder.name, "scene": scene})
    if step is None:
        checkpoint = latest_checkpoint(run / "checkpoints")
        if checkpoint is None:
            raise CheckpointError(f"{run / 'checkpoints'}: no committed checkpoint; has the run been trained?")
    else:
        steps = [int(p.name.removeprefix("step-")) for p in committed(run / "checkpoints")]
        if step not in steps:
            raise CheckpointError(
                f"{run}: no checkpoint of step {step}; there are {', '.join(map(str, steps)) or 'none'}"
            )
        checkpoint = read_checkpoint(run / "checkpoints" / folder_name(step))
    torch.backends.cudnn.allow_tf32 = False  # as in training
    device = device or torch.device("cuda" if torch.cuda.is_available() and job.device != "cpu" else "cpu")
    box = torch.zeros(2, 3)  # the scene's box is one of its buffers
    if "photos" not in checkpoint.meta:
        raise CheckpointError(f"{checkpoint.folder}: written by an older version of crossray; train the run again")
    model = SceneModel(job.model, box, checkpoint.meta["photos"]).to(device).requires_grad_(False)
    model.load_state_dict(checkpoint.model)
    return job, model.eval(), checkpoint


def evaluate_run(run: Path, protocol_name: str, step: int | None = None, codes: Codes | None = None) -> dict[str, Any]:
    """Evaluate a run's checkpoint on its test photos; returns what metrics.json holds.

    Args:
        codes: appearance codes fitted before, for other protocols; new ones are added.

    Raises:
        CrossrayError: the run, the protocol or the shards cannot be used.
    """
    protocol, downscale, affine = parse_protocol(protocol_name)
    job, model, checkpoint = load_run(run, step)
    check_downscale(job, protocol_name, downscale)
    torch.set_num_threads(max(job.threads, torch.get_num_threads()))
    photos = open_photos(job.shards)
    if photos.manifest.content_hash != checkpoint.meta["shards"]:
        raise CrossrayError(
            f"{job.shards}: other photos or masks than {run} was trained on; --set scene.shards=... in a new run, or "
            "cut the shards again as they were"
        )
    indices = photos.indices("test")
    if not indices:
        raise CrossrayError(f"{job.shards}: no test photos, so there is nothing to evaluate; see the split table")
    out = run / "eval" / protocol_name / checkpoint.folder.name
    lpips = usable_lpips(photos, indices, protocol)
    judge = Judge(model, photos, protocol, truth_of(job, photos) if protocol.truth == "clean" else None)
    if codes is not None:
        judge.codes = codes.setdefault((checkpoint.meta["sha256"][MODEL], judge.recipe), judge.codes)

    began = time.perf_counter()
    progress = Progress(f"evaluating {run.name} under {protocol_name}")
    rows = []
    for done, index in enumerate(indices):
        view, picture = judge.render(index)
        if affine:
            picture = fit_colours(picture, photos.image(index))
        prediction = to_8bit(picture, protocol.rounding)
        rows.append(judge.score(prediction, index, lpips))
        save_png(out / f"{photos.records[index].key}.png", prediction)
        save_png(out / f"{photos.records[index].key}.depth.png", depth_picture(view))
        progress.update((done + 1) / len(indices), f"PSNR {np.mean([r['psnr'] for r in rows]):.2f}")
    progress.close()
    result = {
        "protocol": protocol_name,
        "definition": protocol.model_dump(mode="json"),
        "step": checkpoint.step,
        "checkpoint_sha256": checkpoint.meta["sha256"][MODEL],
        "method": job.method,
        "samples": list(samples_of(model, protocol) or ()) or "as in training",
        "appearance_from": judge.appearance_from,
        "mean": {k: float(np.mean([r[k] for r in rows])) for k in rows[0] if k not in ("name", "key")} | judge.masks(),
        "images": rows,
        "seconds": time.perf_counter() - began,
        "device": device_name(next(model.parameters()).device),
        "versions": {p: importlib.metadata.version(p) for p in ("torch", "numpy", "pillow", "scikit-image")},
        "python": platform.python_version(),
    }
    atomic_write(out / "metrics.json", json.dumps(result, indent=2))
    return result


class Judge:
    """One model under one protocol: what it may see of a test photo, and what its picture is compared with.

    Args:
        landmark: the truth behind the photos, for a protocol that scores against it.
    """

    def __init__(self, model: SceneModel, photos: Photos, protocol: Protocol, landmark: Landmark | None) -> None:
        self.model, self.photos, self.protocol, self.landmark = model, photos, protocol, landmark
        self.codes: dict[tuple[int, str], torch.Tensor] = {}  # (photo, what it was read from) -> fitted code

    @property
    def appearance_from(self) -> str:
        """What appearances are read from. A learned code is fitted, which on scored pixels would be training on them:
        so it sees the left half where others see the whole photo."""
        if self.model.spec.appearance == "none":
            return "nothing"
        fitted = self.model.embedding is not None and self.protocol.appearance == "whole"
        return "left" if fitted else self.protocol.appearance

    def render(self, index: int) -> tuple[View, np.ndarray]:
        """A test photo's view in the appearance that the protocol lets the model see."""
        samples = samples_of(self.model, self.protocol)
        return render_picture(self.model, self.photos.records[index], self.appearance(index), samples)

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
        key = (index, self.appearance_from)
        if key not in self.codes:
            columns = left_half(image).shape[1] if self.appearance_from == "left" else image.shape[1]
            camera = self.photos.records[source]
            self.codes[key] = fit_code(self.model, image, camera, columns, self.recipe, seed=index)
        return self.codes[key]

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


def left_half(picture: np.ndarray) -> np.ndarray:
    """The left half of (h, w, ...), with the middle column where the width is odd."""
    return picture[:, : picture.shape[1] - picture.shape[1] // 2]


def usable_lpips(photos: Photos, indices: tuple[int, ...], protocol: Protocol) -> LPIPS | None:
    """LPIPS where its weights are found and all pictures are large enough; else None, and the log says why."""
    lpips = find_lpips()
    if lpips is None:
        warn_once("LPIPS is left out: no weights found; CROSSRAY_LPIPS=/path/to/lpips_alex.npz names them")
        return None
    for record in (photos.records[i] for i in indices):
        width = record.width // 2 if protocol.scored == "right" else record.width
        if min(record.height, width) < LPIPS_SIDE:
            warn_once(f"LPIPS is left out: what is scored of {record.name} has a side under {LPIPS_SIDE} pixels")
            return None
    return lpips


@cache
def warn_once(text: str) -> None:
    """A warning that several evaluations share."""
    log.warning(text)


def samples_of(model: SceneModel, protocol: Protocol) -> tuple[int, int] | None:
    """Sample counts of the rendering; None keeps those of training (the protocols only speak of the MLP field)."""
    return protocol.mlp_samples if model.spec.field == "mlp" else None


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


def check_protocols(job: Job) -> None:
    """CrossrayError for a protocol that could only be refused after the training."""
    for name in job.evaluate.protocols:
        protocol, downscale, _ = parse_protocol(name)
        check_downscale(job, name, downscale)
        if protocol.truth == "clean":
            check_truth(job)


def run_protocols(job: Job) -> list[dict[str, Any]]:
    """Every protocol that the job asks for; what this checkpoint was scored under before is read, not done again."""
    newest = load_run(job.run)[2]
    codes: Codes = {}
    return [
        recorded(job.run, name, newest) or evaluate_run(job.run, name, codes=codes) for name in job.evaluate.protocols
    ]


def recorded(run: Path, protocol_name: str, checkpoint: Checkpoint) -> dict[str, Any] | None:
    """An evaluation of just this checkpoint under just this definition of the protocol, if it was made before."""
    path = run / "eval" / protocol_name / checkpoint.folder.name / "metrics.json"
    if not path.is_file():
        return None
    result = json.loads(path.read_text())
    definition = parse_protocol(protocol_name)[0].model_dump(mode="json")
    same = result["checkpoint_sha256"] == checkpoint.meta["sha256"][MODEL] and result["definition"] == definition
    return result if same else None
