"""A released CR-NeRF checkpoint -> a run of ours, which can be evaluated, rendered and trained further.

The file (PyTorch Lightning's layout: `state_dict`, `epoch`, `global_step`, `hyper_parameters`, `callbacks`, ...) is
read as data; nothing in it is executed (`pipeline/torch_file.py`). Its numbers fill the released networks exactly, or
are refused with every name that does not fit.

The optimiser starts afresh: the released one's state belongs to parameters in another order. E5 and S serve training
only and may be missing. The released code keeps no running averages of the content statistics; the run has none.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from operator import attrgetter
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from model.fields.nerf import NeRFField
from model.released import load_crnerf, split_crnerf
from model.scene_model import SceneModel
from pipeline.checkpoint import CheckpointError, save_checkpoint
from pipeline.config import Job, save_job
from pipeline.errors import CrossrayError
from pipeline.files import atomic_write, sync_folder
from pipeline.photos import Photos, open_photos
from pipeline.resume import run_identity
from pipeline.torch_file import StoredTensor, TorchFile, printable, read_bytes
from pipeline.train import build_model, build_optimiser, epoch_length

log = logging.getLogger("crossray")

RELEASED: dict[str, tuple[Any, ...]] = {  # the choices and sizes of the released networks
    "field": ("mlp",),
    "colour": ("decoder",),
    "appearance": ("crossray",),
    "fused": ("ray",),
    "transient": ("segmenter", "none"),
    "channels": (64,),
    "encoder": ("released",),
    "transform": ("learned",),
    "segmenter": ("cgnet",),
    "pixel_center": (0.0,),
    "mlp.width": (256,),
    "mlp.xyz_frequencies": (15,),
    "mlp.dir_frequencies": (4,),
}
USED = ("state_dict", "global_step", "epoch")  # entries of the file
MOST_STEPS = 10**8  # the folder of a checkpoint has eight digits for its step


def import_checkpoint(file: Path, job: Job) -> Path:
    """Write the run `job.run` with the networks of a released checkpoint; returns its folder, which is whole or absent.

    Raises:
        CrossrayError: a job of other networks, a run that is there already, shards that are missing or of another
            size, or a file that is no released CR-NeRF checkpoint.
    """
    check_networks(job)
    if job.run.exists() and any(job.run.iterdir()):
        raise CrossrayError(f"{job.run}: holds a run already; choose another name (--set name=...), or remove it")
    photos = photos_of(job)
    data = read_bytes(file)
    saved = TorchFile(data, str(file))
    state = state_dict(saved)
    step = global_step(saved)
    model = build_model(job, photos, torch.device("cpu"))
    parts = networks(model)
    try:
        fresh = load_crnerf(parts, state)
    except ValueError as error:
        raise CheckpointError(f"{file}: {error}") from None
    check_finite(model, file)

    record = {
        "source": file.name,
        "sha256": hashlib.sha256(data).hexdigest(),
        "global_step": step,
        "epoch": plain(saved.content.get("epoch")),
        "entries_not_used": sorted(printable(str(key)) for key in saved.content if key not in USED),
        "networks_not_used": [prefix.rstrip(".") for prefix in split_crnerf(state)[0] if prefix not in parts],
        "networks_not_in_the_file": [prefix.rstrip(".") for prefix in fresh],
        "objects_not_made": saved.named,
    }
    meta = run_identity(job, photos, epoch_length(job, photos.sizes("train"), job.ranks)) | {
        "seconds": 0.0,
        "finished": True,
        "world_size": job.ranks,
        "skipped": [],
        "photos": len(photos.indices("train")),
    }
    optimiser = build_optimiser(model, job.train).state_dict()
    with whole_folder(job.run) as folder:
        save_job(job, folder / "job.yaml")
        save_checkpoint(folder / "checkpoints", step, model.state_dict(), optimiser, meta)
        atomic_write(folder / "imported.json", json.dumps(record, indent=2))
    report(record)
    return job.run


def check_networks(job: Job) -> None:
    """CrossrayError, with every key of the job's model that is not as in the released networks."""
    differs = [
        f"model.{key}: {attrgetter(key)(job.model)}, but the released networks have {' or '.join(map(str, wanted))}"
        for key, wanted in RELEASED.items()
        if attrgetter(key)(job.model) not in wanted
    ]
    if differs:
        raise CrossrayError("\n".join([*differs, "A job with method: crnerf and no sizes of its own fits"]))


def photos_of(job: Job) -> Photos:
    """The photos of the job's shards: a run belongs to its photos.

    Raises:
        CrossrayError: no shards, with the command that cuts them, or shards of another size.
    """
    scene = job.scene
    if not (job.shards / "manifest.json").is_file():
        raise CrossrayError(
            f"{job.shards}: no shards, but a run belongs to its photos. Cut them first: crossray shard {scene.path} "
            f"--out {job.shards} --downscale {scene.downscale} --reference-downscale {scene.reference_downscale}"
        )
    photos = open_photos(job.shards)
    for key in ("downscale", "reference_downscale"):
        if getattr(photos.manifest, key) != getattr(scene, key):
            raise CrossrayError(
                f"scene.{key}: the job says {getattr(scene, key)}, but the shards in {job.shards} were cut with "
                f"{getattr(photos.manifest, key)}; --set scene.shards=FOLDER names other ones"
            )
    return photos


def state_dict(saved: TorchFile) -> dict[str, Tensor]:
    """The tensors of a Lightning checkpoint, by name.

    Raises:
        CheckpointError: there is no state dict, or something in it is no tensor.
    """
    entries = saved.content.get("state_dict") if isinstance(saved.content, dict) else None
    if not isinstance(entries, dict) or not entries:
        found = ", ".join(printable(str(key)) for key in saved.content) if isinstance(saved.content, dict) else ""
        raise CheckpointError(f"{saved.source}: no Lightning checkpoint: it has no state_dict (it has: {found or '-'})")
    odd = [
        printable(str(name))
        for name, value in entries.items()
        if not isinstance(name, str) or printable(name) != name or not isinstance(value, StoredTensor)
    ]
    if odd:
        raise CheckpointError(f"{saved.source}: in its state_dict these are no tensors with a name: {', '.join(odd)}")
    return {name: saved.tensor(value) for name, value in entries.items()}


def global_step(saved: TorchFile) -> int:
    """Steps that the checkpoint was trained for, 0 if it does not say; CheckpointError for what is no such number."""
    step = saved.content.get("global_step", 0)
    if not is_number(step) or not 0 <= step < MOST_STEPS:
        raise CheckpointError(f"{saved.source}: its global_step is no number of steps under {MOST_STEPS}")
    return step


def plain(value: Any) -> int | None:
    """A number to be recorded; None for anything else."""
    return value if is_number(value) and abs(value) < 2**63 else None


def is_number(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def networks(model: SceneModel) -> dict[str, nn.Module]:
    """The parts of a model that a released checkpoint fills, by their names there."""
    assert isinstance(model.field, NeRFField)
    parts = {
        "nerf_coarse.": model.field.coarse,
        "nerf_fine.": model.field.fine,
        "enc_a.": model.encoder,
        "enc_cont.": model.content_encoder,
        "decoder.multi_net.": model.transform,
        "decoder.decoder.": model.decoder,
        "implicit_mask.": model.segmenter,
    }
    return {prefix: part for prefix, part in parts.items() if part is not None}


def check_finite(model: SceneModel, file: Path) -> None:
    """CheckpointError for a checkpoint of a training that had gone wrong."""
    bad = [name for name, value in model.state_dict().items() if not bool(value.isfinite().all())]
    if bad:
        raise CheckpointError(f"{file}: has numbers that are not finite (in our names: {', '.join(bad)})")


@contextmanager
def whole_folder(target: Path) -> Iterator[Path]:
    """A folder that appears as `target` when the block ends, and not at all if the block raises."""
    temporary = target.parent / f".{target.name}.{os.getpid()}.tmp"
    temporary.mkdir(parents=True)
    try:
        yield temporary
        temporary.rename(target)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    sync_folder(target.parent)


def report(record: dict[str, Any]) -> None:
    """What the user should know of an import, as far as there is something to say."""
    if record["networks_not_in_the_file"]:
        log.warning(
            "not in %s: %s. They serve training only and keep their initial weights",
            record["source"],
            ", ".join(record["networks_not_in_the_file"]),
        )
    for key, what in (
        ("networks_not_used", "networks that the job's model does not have"),
        ("entries_not_used", "entries that are not used"),
        ("objects_not_made", "classes and functions that it names, neither imported nor called"),
    ):
        if record[key]:
            log.info("%s: %s: %s", record["source"], what, ", ".join(record[key]))
