"""Checkpoints that survive anything: written whole, verified before use, resumed from to the bit.

    checkpoints/step-00012000/model.safetensors   weights and buffers
                              training.pt         optimiser state, plain tensors (loaded weights-only)
                              meta.json           hashes of both, the step, the run's identity; written last

A checkpoint counts once its meta.json is there and its hashes agree. There is no random state in it: draws are a pure
function of (seed, step, rank).
"""

from __future__ import annotations

import hashlib
import io
import json
import logging
import shutil
from collections.abc import Collection
from pathlib import Path
from typing import Any, NamedTuple

import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_safetensors
from safetensors.torch import save as save_safetensors
from torch import Tensor

from pipeline.errors import CrossrayError
from pipeline.files import atomic_write, sha256_of

log = logging.getLogger("crossray")

FORMAT = 2
MODEL, TRAINING, META = "model.safetensors", "training.pt", "meta.json"


class CheckpointError(CrossrayError):
    """No checkpoint can be used."""


class Checkpoint(NamedTuple):
    """A committed checkpoint, read and verified."""

    folder: Path
    step: int
    model: dict[str, Tensor]
    meta: dict[str, Any]

    def optimiser(self) -> dict[str, Any]:
        """The optimiser's state, read when it is needed: evaluation never does.

        Raises:
            CheckpointError: the file holds something else, which is not read.
        """
        path = self.folder / TRAINING
        try:
            return torch.load(path, map_location="cpu", weights_only=True)
        except Exception as error:  # whatever torch meets in a damaged file: UnicodeDecodeError, KeyError, ...
            raise CheckpointError(f"{path}: holds other things than numbers, which are never read: not ours") from error


def save_checkpoint(
    folder: Path, step: int, model: dict[str, Tensor], optimiser: dict[str, Any], meta: dict[str, Any]
) -> Path:
    """Write `folder/step-<step>`; it is committed when this returns, and absent or incomplete if it raises."""
    target = folder / folder_name(step)
    (target / META).unlink(missing_ok=True)  # an older try at the same step must not vouch for new files
    buffer = io.BytesIO()
    torch.save(optimiser, buffer)
    atomic_write(target / MODEL, save_safetensors({k: v.detach().cpu().contiguous() for k, v in model.items()}))
    atomic_write(target / TRAINING, buffer.getvalue())
    record = {"format": FORMAT, "step": step, **meta}
    record["sha256"] = {name: sha256_of(target / name) for name in (MODEL, TRAINING)}
    record["digest"] = digest(record)
    atomic_write(target / META, json.dumps(record, indent=2))
    return target


def digest(record: dict[str, Any]) -> str:
    """SHA-256 of a record without its own digest."""
    content = {key: value for key, value in record.items() if key != "digest"}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def read_checkpoint(target: Path) -> Checkpoint:
    """Read one checkpoint.

    Raises:
        CheckpointError: it is incomplete or damaged; the message says which file.
    """
    try:
        meta = json.loads((target / META).read_text())
        if meta["format"] != FORMAT:
            raise CheckpointError(f"{target / META}: format {meta['format']}, this version reads {FORMAT}")
        if meta["digest"] != digest(meta) or target.name != folder_name(meta["step"]):
            raise CheckpointError(
                f"{target / META}: its content is not what was written: damaged, or the folder renamed"
            )
        for name in (MODEL, TRAINING):
            if sha256_of(target / name) != meta["sha256"][name]:
                raise CheckpointError(f"{target / name}: its content does not agree with {META}: damaged")
        model = load_safetensors((target / MODEL).read_bytes())
        return Checkpoint(target, int(meta["step"]), model, meta)
    except FileNotFoundError as error:
        raise CheckpointError(f"{error.filename}: missing, the checkpoint was not completed") from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError, SafetensorError) as error:
        raise CheckpointError(f"{target}: cannot be read ({type(error).__name__}: {error})") from error


def folder_name(step: int) -> str:
    """The name of a checkpoint's folder."""
    return f"step-{step:08d}"


def committed(folder: Path) -> list[Path]:
    """Checkpoints that say that they are complete, oldest first; their hashes are not yet checked."""
    return sorted(p for p in folder.glob("step-????????") if (p / META).is_file())


def latest_checkpoint(folder: Path) -> Checkpoint | None:
    """The newest checkpoint that is whole, None if there is none at all; damaged ones are passed over with a warning.

    Raises:
        CheckpointError: there are checkpoints, and every one of them is damaged.
    """
    targets = committed(folder)
    for target in reversed(targets):
        try:
            return read_checkpoint(target)
        except CheckpointError as error:
            log.warning("%s; looking at the checkpoint before it", error)
    if targets:
        raise CheckpointError(
            f"{folder}: all {len(targets)} checkpoints are damaged (see the warnings above); remove the folder to "
            "train from the start"
        )
    return None


def prune(folder: Path, keep: int, named: Collection[int] = (), newest: int | None = None) -> None:
    """Remove all but the newest `keep` committed checkpoints and those of the steps in `named`, and the remains of
    older uncommitted ones.

    Args:
        newest: the step that was saved last; what seems newer is damaged, or training would not be here.
    """
    whole = [path for path in committed(folder) if newest is None or path.name <= folder_name(newest)]
    if not whole:
        return
    stale = [p for p in folder.glob("step-????????") if p not in whole and p < whole[-1]]
    spared = {folder_name(step) for step in named}
    for target in [p for p in whole[:-keep] if p.name not in spared] + stale:
        (target / META).unlink(missing_ok=True)  # first, so that a half-removed one never counts
        shutil.rmtree(target, ignore_errors=True)
