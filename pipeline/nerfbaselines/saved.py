"""A checkpoint of the method, which is all that rendering needs: the same state gives the same bytes.

    job.yaml                the resolved job
    model.safetensors       weights and buffers
    optimiser.safetensors   Adam's state, tensor by tensor (its other settings follow from the job)
    scene.safetensors       the points that depth bounds come from, and the appearance references of all photos
    checkpoint.json         the step, the key `fit`, the scene's scale, which photos and job it is of; written last

nerfbaselines adds its own nb-info.json.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.numpy import load as load_arrays
from safetensors.numpy import save as save_arrays
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor

from pipeline.checkpoint import CheckpointError
from pipeline.config import Job, load_job, save_job
from pipeline.files import atomic_write

FORMAT = 1
MODEL, OPTIMISER, SCENE, JOB, FACTS = (
    "model.safetensors",
    "optimiser.safetensors",
    "scene.safetensors",
    "job.yaml",
    "checkpoint.json",
)
POINTS = "points"


@dataclass(frozen=True)
class KnownScene:
    """What is known of the scene without its photos."""

    points: np.ndarray  # (P, 3) float32, in the data set's units
    references: tuple[np.ndarray, ...]  # of all training photos: uint8 (h, w, 3)
    scale: float  # the data set's units per scene unit
    bounds: tuple[float, float]  # the smallest near and the largest far of the training photos, scene units
    identity: dict[str, Any]  # of photos and job (pipeline/resume.py)


@dataclass(frozen=True)
class Saved:
    """A checkpoint as it is read."""

    job: Job
    step: int
    fits: bool  # whether appearances are fitted further than they are read
    scene: KnownScene
    model: dict[str, Tensor]
    optimiser: dict[str, Tensor]


def write_saved(
    folder: Path,
    job: Job,
    step: int,
    fits: bool,
    scene: KnownScene,
    model: dict[str, Tensor],
    optimiser: torch.optim.Optimizer,
) -> None:
    """Write a checkpoint into `folder`, which may hold other files."""
    (folder / FACTS).unlink(missing_ok=True)  # an older try must not vouch for new files
    save_job(job, folder / JOB)
    atomic_write(folder / MODEL, save_tensors(plain(model)))
    atomic_write(folder / OPTIMISER, save_tensors(plain(moments(optimiser))))
    references = {f"reference.{i:06d}": reference for i, reference in enumerate(scene.references)}
    atomic_write(folder / SCENE, save_arrays({POINTS: scene.points} | references))
    facts = {
        "format": FORMAT,
        "step": step,
        "fit": fits,
        "scale": scene.scale,
        "bounds": list(scene.bounds),
        "identity": scene.identity,
    }
    atomic_write(folder / FACTS, json.dumps(facts, indent=2) + "\n")


def read_saved(folder: Path) -> Saved:
    """Read a checkpoint.

    Raises:
        CheckpointError: it is incomplete, damaged, or of another format.
        JobError: its job cannot be run by this version.
    """
    try:
        facts = json.loads((folder / FACTS).read_text())
        if facts["format"] != FORMAT:
            raise CheckpointError(f"{folder / FACTS}: format {facts['format']}, this version reads {FORMAT}")
        arrays = load_arrays((folder / SCENE).read_bytes())
        scene = KnownScene(
            points=arrays.pop(POINTS),
            references=tuple(arrays[name] for name in sorted(arrays)),
            scale=float(facts["scale"]),
            bounds=(float(facts["bounds"][0]), float(facts["bounds"][1])),
            identity=facts["identity"],
        )
        model = load_tensors((folder / MODEL).read_bytes())
        optimiser = load_tensors((folder / OPTIMISER).read_bytes())
        return Saved(load_job(folder / JOB), int(facts["step"]), bool(facts["fit"]), scene, model, optimiser)
    except FileNotFoundError as error:
        raise CheckpointError(f"{error.filename}: missing; is {folder} a checkpoint of crossray?") from error
    except (OSError, ValueError, KeyError, TypeError, IndexError, SafetensorError) as error:
        raise CheckpointError(f"{folder}: cannot be read ({type(error).__name__}: {error})") from error


def plain(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Tensors as safetensors takes them."""
    return {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}


def moments(optimiser: torch.optim.Optimizer) -> dict[str, Tensor]:
    """The state of each parameter as `<number>.<name>`; a parameter that has had no gradient has none."""
    state = optimiser.state_dict()["state"]
    return {f"{number}.{name}": value for number, of in state.items() for name, value in of.items()}


def load_moments(optimiser: torch.optim.Optimizer, saved: dict[str, Tensor]) -> None:
    """Put back what `moments` gave."""
    parameters = [p for group in optimiser.param_groups for p in group["params"]]
    state: dict[int, dict[str, Tensor]] = {}
    for key, value in saved.items():
        number, _, name = key.partition(".")
        parameter = parameters[int(number)].detach()
        if value.shape == parameter.shape:  # safetensors keeps no strides, and the fused Adam wants the parameter's
            value = torch.empty_like(parameter).copy_(value)
        state.setdefault(int(number), {})[name] = value
    optimiser.load_state_dict({"state": state, "param_groups": optimiser.state_dict()["param_groups"]})
