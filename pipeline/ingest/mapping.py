"""Poses from matches, and doubts about them.

COLMAP's mapper often returns models that look healthy and are wrong. So settings are tried in a fixed order, all models
of each try are looked at, cameras that cannot be are taken out where the rest is sound, and only a sound model is used.
Of few photos a sound one can be inexact, so there two tries have to agree.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import median
from typing import Any, Literal, NamedTuple

import numpy as np

from pipeline.colmap import import_pycolmap
from pipeline.errors import CrossrayError
from pipeline.files import atomic_write
from pipeline.ingest.agreement import differences, read_rotations
from pipeline.scene import SceneError, check_model, depth_bounds

# name, seed, options of the mapper
TRIES: tuple[tuple[str, int, dict[str, bool]], ...] = (
    ("default", 0, {}),
    ("seed-1", 1, {}),
    ("fixed-distortion", 0, {"ba_refine_extra_params": False}),
    ("strict", 0, {"structure_less_registration_fallback": False}),
    ("strict-fixed-distortion", 1, {"ba_refine_extra_params": False, "structure_less_registration_fallback": False}),
    ("seed-2", 2, {}),
)
Adjusted = Literal["all", "but distortion"]
ENOUGH = 0.95  # share of the photos that can be registered: no further try
FEW = 50  # photos: up to so many, a second try has to agree
SHARED = 0.5  # share of its photos that a model must have in common with one that it is compared with
AGREE = 1.0  # degrees, the median over photos, within which two tries agree
MOST_BAD = 0.25  # share of the cameras of a model that may be dropped for the rest to be believed
LEAST_PHOTOS = 3
STRONG = 30  # inliers of a pair: what the mapper needs to register a photo


@dataclass(frozen=True)
class Model:
    """One model of a try: `photos` are those that stay, `bad` those that were dropped -> why; `unsound` why it cannot
    be used, or empty.
    """

    folder: str
    photos: list[str]
    points: int
    error: float  # mean reprojection error, pixels
    bad: dict[str, str] = field(default_factory=dict)
    unsound: str = ""


@dataclass(frozen=True)
class Try:
    """A try and the models that came out of it, the best first."""

    name: str
    folder: Path
    models: list[Model]

    @property
    def best(self) -> Model | None:
        """The sound model with most photos."""
        return next((m for m in self.models if not m.unsound), None)

    def told(self) -> str:
        """How it ended, in words."""
        return f"{self.name}: " + ("; ".join(told(m) for m in self.models) or "no model")


def told(model: Model) -> str:
    """A model in words."""
    bad = (
        f", {len(model.bad)} bad camera{'s' * (len(model.bad) > 1)} dropped" if model.bad and not model.unsound else ""
    )
    return f"{len(model.photos)} photos{bad}, {model.unsound or f'sound, {model.points} points'}"


class Found(NamedTuple):
    """What is used of all tries."""

    tried: Try
    model: Model
    tries: list[Try]
    apart: dict[str, float]  # photo -> degrees from its pose in the try that agrees best; empty: there is no other

    @property
    def median(self) -> float:
        """Degrees between the two tries; infinite where there is one alone."""
        return median(self.apart.values()) if self.apart else float("inf")


def find_poses(folder: Path, wanted: int, run: Callable[[int, Path], None], tries: tuple = TRIES) -> Found:
    """Try settings until a sound model has nearly all of the `wanted` photos and, where these are few, a second one
    agrees with it. Tries that are in `folder` already are read.

    Raises:
        CrossrayError: no try gave a sound model; the message tells each.
    """
    done: list[Try] = []
    found = None
    for index, (name, _, _) in enumerate(tries):
        path = folder / f"{index}-{name}"
        if not (path / "verdict.json").exists():
            run(index, path)
        done.append(read_try(path))
        found = choose(done)
        enough = found is not None and len(found.model.photos) >= ENOUGH * wanted
        if found and enough and (len(found.model.photos) > FEW or found.median <= AGREE):
            break
    if found is None:
        lines = "".join(f"\n  {t.told()}" for t in done)
        raise CrossrayError(
            f"no sound model of the photos was found. Photos need to overlap and be taken from different places; more "
            f"of them help. Tried:{lines}"
        )
    return found


def choose(tries: list[Try]) -> Found | None:
    """Of the sound models with nearly the most photos, the one that another try agrees with best; None: none is
    sound.
    """
    sound = [(t, t.best) for t in tries if t.best]
    if not sound:
        return None
    most = max(len(model.photos) for _, model in sound)
    rotations = [read_rotations(t.folder / model.folder) for t, model in sound] if len(sound) > 1 else []
    choices = []
    for i, (tried, model) in enumerate(sound):
        if len(model.photos) >= ENOUGH * most:
            others = (differences(rotations[i], other) for j, other in enumerate(rotations) if j != i)
            shared = (d for d in others if len(d) >= SHARED * len(model.photos))
            apart = min(shared, key=lambda d: median(d.values()), default={})
            choices.append(Found(tried, model, tries, apart))
    return min(choices, key=lambda found: (found.median, -len(found.model.photos)))


def read_try(folder: Path) -> Try:
    """A try that was completed."""
    record = json.loads((folder / "verdict.json").read_text())
    return Try(record["name"], folder, [Model(**m) for m in record["models"]])


def run_try(database: str, photos: str, folder: str, index: int) -> None:
    """Map with the settings of one try and judge every model; `folder` appears when all is there."""
    pycolmap = import_pycolmap()
    name, seed, settings = TRIES[index]
    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = LEAST_PHOTOS
    options.random_seed = seed
    for key, value in settings.items():
        setattr(options, key, value)
    scratch = Path(folder).with_name(f".{Path(folder).name}.tmp")
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir(parents=True)
    pycolmap.set_random_seed(seed)
    found = pycolmap.incremental_mapping(database, photos, scratch, options)
    models = []
    adjusted: Adjusted = "all" if settings.get("ba_refine_extra_params", True) else "but distortion"
    for number, reconstruction in sorted(found.items()):
        kept = scratch / f"model-{number}"
        models.append(judge(reconstruction, kept.name, adjusted=adjusted))
        kept.mkdir()
        reconstruction.write_binary(kept)
        shutil.rmtree(scratch / str(number), ignore_errors=True)
    models.sort(key=lambda m: (bool(m.unsound), -len(m.photos)))
    atomic_write(scratch / "verdict.json", json.dumps({"name": name, "models": [asdict(m) for m in models]}, indent=1))
    shutil.rmtree(folder, ignore_errors=True)
    scratch.rename(folder)


def judge(model: Any, folder: str, *, adjusted: Adjusted | None = "all") -> Model:
    """Take the cameras out of `model` (a `pycolmap.Reconstruction`) that cannot be, and say whether the rest can.

    Args:
        adjusted: what bundle adjustment may change once cameras are out; None: nothing, poses and lenses are given.
    """
    before = [model.images[i].name for i in model.reg_image_ids()]
    bad: dict[str, str] = {}
    for _ in range(3):  # a point may have been seen by the bad cameras alone, a camera have seen such points alone
        found = bad_cameras(model)
        bad |= found
        for image in [i for i in model.images.values() if i.name in found]:
            model.deregister_frame(image.frame_id)
        if not found:
            break
        if adjusted and len(model.reg_image_ids()) >= LEAST_PHOTOS and model.points3D:
            adjust(model, adjusted)  # the bad ones had bent the others
    names = sorted(model.images[i].name for i in model.reg_image_ids())
    unsound = ""
    if len(bad) > MOST_BAD * len(before):
        unsound = f"{len(bad)} of {len(before)} cameras cannot be ({next(iter(bad.values()))})"
    elif len(names) < LEAST_PHOTOS:
        unsound = f"fewer than {LEAST_PHOTOS} photos"
    else:
        try:
            check_model(model)
        except SceneError as wrong:
            unsound = str(wrong).partition(": reconstruct")[0]
    error = float(model.compute_mean_reprojection_error()) if model.points3D else 0.0
    return Model(folder, names, len(model.points3D), error, bad, unsound)


def adjust(model: Any, what: Adjusted) -> None:
    """Bundle adjustment of all that is in `model`."""
    pycolmap = import_pycolmap()
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_extra_params = what == "all"
    pycolmap.bundle_adjustment(model, options)


def bad_cameras(model: Any) -> dict[str, str]:
    """Photo -> what is wrong with its camera, of the registered ones whose camera cannot be."""
    found = {}
    points = np.array([p.xyz for p in model.points3D.values()]).reshape(-1, 3)
    for image in (model.images[i] for i in model.reg_image_ids()):
        try:
            check_model(model, [image])
            depth_bounds(points, image.cam_from_world().matrix(), image.name)
        except SceneError as error:
            found[image.name] = str(error).partition(": reconstruct")[0]
    return found


def components(names: list[str], pairs: dict[tuple[str, str], int]) -> list[set[str]]:
    """Photos that strong pairs join, the largest group first; photos without any are in none."""
    group = {n: n for n in names}

    def root(n: str) -> str:
        while group[n] != n:
            n = group[n]
        return n

    for (a, b), count in pairs.items():
        if count >= STRONG:
            group[root(a)] = root(b)
    groups: dict[str, set[str]] = {}
    for n in names:
        groups.setdefault(root(n), set()).add(n)
    return sorted((g for g in groups.values() if len(g) > 1), key=lambda g: (-len(g), min(g)))
