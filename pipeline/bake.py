"""`crossray bake`: an appearance that a photo has, or one between two, folded into a trained field (model/bake.py).

    <run>/baked/<name>/baked.safetensors   the field and the shift of its colours
                       preview.png         a few views, side by side
                       baked.json          what it is, and hashes; written last

A baked appearance has one set of content statistics for all views (`pipeline.appearances.fixed_statistics`).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from PIL import Image
from pydantic import TypeAdapter, ValidationError
from safetensors import SafetensorError
from safetensors.torch import load as load_safetensors
from safetensors.torch import save as save_safetensors

from model.bake import Baked, bake, blank, check_bakeable
from model.methods import ModelSpec
from pipeline.appearances import find_appearance, fixed_statistics
from pipeline.board import PICTURE_SIDE
from pipeline.checkpoint import MODEL, digest
from pipeline.errors import CrossrayError
from pipeline.files import atomic_file, atomic_write, sha256_of
from pipeline.metrics import to_8bit
from pipeline.photos import Photos
from pipeline.provenance import provenance
from pipeline.render import interpolated, render_baked
from pipeline.runs import load_run, photos_of

FORMAT = 1
WEIGHTS, RECORD, PREVIEW = "baked.safetensors", "baked.json", "preview.png"
PREVIEWED = 4  # views of the preview, at most


class BakedAppearance(NamedTuple):
    """A folder of `crossray bake`, opened."""

    model: Baked
    record: dict[str, Any]


def bake_run(
    run: Path,
    appearance: str,
    towards: str | None = None,
    share: float | None = None,
    out: Path | None = None,
    step: int | None = None,
) -> Path:
    """Bake an appearance of a run's checkpoint (the newest, or `step`); returns the folder, `<run>/baked/<name>` or
    `out`.

    Args:
        appearance: the name of a photo of the scene, or the path of any image file.
        towards: another one; the appearance is then `share` of the way from the first to it, by default 0.5.

    Raises:
        CrossrayError: the run, its photos, an appearance or the folder cannot be used, or the method cannot be baked.
    """
    if towards is None and share is not None:
        raise CrossrayError(f"--share {share:g}: how far to go to a second photo; --towards names it")
    share = 0.5 if share is None else share
    job, model, checkpoint = load_run(run, step)
    try:
        check_bakeable(job.model)
    except ValueError as error:
        raise CrossrayError(f"{run}: method {job.method}: {error}") from None
    photos = photos_of(job, checkpoint)
    chosen = [find_appearance(model, photos, name) for name in (appearance, towards) if name is not None]
    F, other = chosen[0].F, chosen[-1].F
    if towards is not None and F is not None and other is not None:
        F = interpolated(F, other, share)
    about = {"appearances": [c.source for c in chosen], "share": share if len(chosen) > 1 else None}
    folder = out or run / "baked" / folder_name([appearance, *([] if towards is None else [towards])], share)
    claim(folder, about)
    content, taken = fixed_statistics(model, photos)
    baked = bake(model, model.colour_map(content, F))
    record = {
        "format": FORMAT,
        "method": job.method,
        "spec": asdict(job.model),
        **about,
        "statistics": taken,
        "run": job.name,
        "step": checkpoint.step,
        "checkpoint_sha256": checkpoint.meta["sha256"][MODEL],
        "provenance": provenance(),
    }
    write_baked(folder, baked, record, preview(baked, photos))
    return folder


def folder_name(names: Sequence[str], share: float) -> str:
    """`name`, or `first-second-0.5` of two."""
    stems = [Path(name).stem for name in names]
    return "-".join([*stems, f"{share:g}"] if len(stems) > 1 else stems)


def claim(folder: Path, about: dict[str, Any]) -> None:
    """CrossrayError where the folder holds something else: other files, or another appearance than `about` says."""
    if not folder.exists():
        return
    strange = sorted(
        p.name for p in folder.iterdir() if p.name not in (WEIGHTS, RECORD, PREVIEW) and p.suffix != ".tmp"
    )
    if strange:
        raise CrossrayError(f"{folder} holds {strange[0]}, which is no baked appearance; --out names another folder")
    try:
        found = json.loads((folder / RECORD).read_text())
        same = all(found[key] == value for key, value in about.items())
    except (OSError, ValueError, KeyError, TypeError):
        return  # not completed, or damaged: it is written anew
    if not same:
        raise CrossrayError(f"{folder} holds another baked appearance; --out names another folder")


# --------------------------------------------------------------------------------------------------------- files


def preview(baked: Baked, photos: Photos) -> np.ndarray:
    """A few views of the scene side by side, uint8 (h, w, 3), each at most about PICTURE_SIDE pixels a side."""
    indices = (photos.indices("test") + photos.indices("val") + photos.indices("train"))[:PREVIEWED]
    pictures = []
    for camera in (photos.records[i] for i in indices):
        stride = max(1, round(max(camera.width, camera.height) / PICTURE_SIDE))
        pictures.append(to_8bit(render_baked(baked, camera, stride=stride)[1], "round"))
    height = max(len(p) for p in pictures)
    return np.concatenate([np.pad(p, ((0, height - len(p)), (0, 0), (0, 0))) for p in pictures], axis=1)


def write_baked(folder: Path, baked: Baked, record: dict[str, Any], picture: np.ndarray) -> None:
    """Write a baked appearance; it is there once its record is, which is written last."""
    (folder / RECORD).unlink(missing_ok=True)  # an older one must not vouch for new files
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in baked.state_dict().items()}
    atomic_write(folder / WEIGHTS, save_safetensors(tensors))
    with atomic_file(folder / PREVIEW) as file:
        Image.fromarray(picture).save(file, format="PNG")
    record = record | {"sha256": {name: sha256_of(folder / name) for name in (WEIGHTS, PREVIEW)}}
    atomic_write(folder / RECORD, json.dumps(record | {"digest": digest(record)}, indent=2) + "\n")


def load_baked(folder: Path, device: torch.device | None = None) -> BakedAppearance:
    """Open a folder of `crossray bake`, on `device` (by default the CPU).

    Raises:
        CrossrayError: there is none, it was not completed, or it is damaged; the message says which file.
    """
    try:
        record = json.loads((folder / RECORD).read_text())
        if record["format"] != FORMAT:
            raise CrossrayError(f"{folder / RECORD}: format {record['format']}, this version reads {FORMAT}")
        if record["digest"] != digest(record):
            raise CrossrayError(f"{folder / RECORD}: its content is not what was written: damaged")
        content = (folder / WEIGHTS).read_bytes()
        if hashlib.sha256(content).hexdigest() != record["sha256"][WEIGHTS]:
            raise CrossrayError(f"{folder / WEIGHTS}: its content does not agree with {RECORD}: damaged")
        baked = blank(TypeAdapter(ModelSpec).validate_python(record["spec"]))
        baked.load_state_dict(load_safetensors(content))
    except FileNotFoundError as error:
        raise CrossrayError(f"{error.filename}: missing; `crossray bake` makes a baked appearance") from error
    except (OSError, ValueError, KeyError, TypeError, RuntimeError, ValidationError, SafetensorError) as error:
        raise CrossrayError(f"{folder}: cannot be read ({type(error).__name__}: {error})") from error
    return BakedAppearance(baked.to(device or "cpu"), record)
