"""Crossray as nerfbaselines calls it: one process, one device, its photos from memory, its steps those of
`pipeline.train`.

Training differs from `crossray train` in nothing but where photos come from and who counts the steps. What is rendered
follows the protocol `nerfw-half` of Crossray (pipeline/protocols): appearance from the left half of the test photo,
sample counts of the paper's networks as evaluated there.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from model.methods import CODE, smallest_reference
from model.scene_model import SceneModel
from pipeline.batches import TrainingPhotos, check_references
from pipeline.clock import Clock
from pipeline.config import Job, flatten, make_job, parse_setting
from pipeline.errors import CrossrayError
from pipeline.fit import fit_code, fit_map
from pipeline.manifest import CameraRecord
from pipeline.metrics import psnr_of, to_8bit
from pipeline.nerfbaselines import CAMERAS, FEATURES, METHOD, OUTPUTS
from pipeline.nerfbaselines.dataset import DatasetPhotos, numbers, picture_of, world_to_camera
from pipeline.nerfbaselines.saved import KnownScene, Saved, load_moments, read_saved, write_saved
from pipeline.protocol import Protocol, parse_protocol, samples_of
from pipeline.record import LossRecord, record_path
from pipeline.render import check_reference, read_appearance, render_picture, render_view
from pipeline.resume import run_identity
from pipeline.scene import SceneError, camera_to_world, depth_bounds
from pipeline.together import Together, check_finite
from pipeline.train import (
    LOOK_EVERY,
    build_model,
    build_optimiser,
    epoch_length,
    set_learning_rates,
    set_up_torch,
    training_step,
)
from pipeline.truth import reduced
from pipeline.work import Context, Work

if TYPE_CHECKING:
    from nerfbaselines import Cameras, Dataset, RenderOptions

FIT = "fit"  # the one key beside those of a job
USUAL: dict[str, Any] = {
    "name": METHOD,
    "method": METHOD,
    "scene": {"path": "dataset", "downscale": 1},
    "train": {"steps_per_epoch": 1500},  # 30,000 steps, as many as most methods of the benchmark take
}


class Crossray:
    """The method.

    Args:
        checkpoint: folder to load; without `train_dataset` it can only be rendered.
        train_dataset: photos, pinhole cameras, points.
        config_overrides: keys of a job as `--set` takes them (`train.epochs`: 5), and `fit`: true has appearances that
            were read from a photo fitted further to what is seen of it.

    Raises:
        CrossrayError: keys, photos or a checkpoint that cannot be used, or a checkpoint of other photos or another job
            than are to be trained on.
    """

    def __init__(
        self,
        *,
        checkpoint: str | None = None,
        train_dataset: Dataset | None = None,
        config_overrides: dict[str, Any] | None = None,
    ) -> None:
        saved = read_saved(Path(checkpoint)) if checkpoint else None
        if saved is None and train_dataset is None:
            raise CrossrayError("neither a checkpoint nor a training data set: there is nothing to render or to train")
        overrides = dict(config_overrides or {})
        self.fits = as_flag(overrides.pop(FIT, saved.fits if saved else False))
        self.job = job_of(overrides, saved)
        self.loaded = (checkpoint, saved.step) if saved else (None, None)
        self.device = torch.device("cuda" if torch.cuda.is_available() and self.job.device != "cpu" else "cpu")
        set_up_torch(self.job, self.device)
        self.step = saved.step if saved else 0
        self.work: Work | None = None
        if train_dataset is not None:
            photos = DatasetPhotos(train_dataset, self.job)
            check_references(photos, smallest_reference(self.job.model))
            data = TrainingPhotos(photos, self.device, self.job.model.pixel_center)
            self.work = Work(self.job, Context(device=self.device), data, epoch_length(self.job, data.sizes, 1))
            self.scene = known_scene(train_dataset, photos, run_identity(self.job, photos, self.work.steps_per_epoch))
            if saved:
                check_same(saved, self.scene)
            self.model = build_model(self.job, photos, self.device)
        else:
            assert saved is not None
            self.scene = saved.scene
            self.model = SceneModel(self.job.model, torch.zeros(2, 3), len(saved.scene.references)).to(self.device)
            self.model.freeze_idle(self.job.losses)
        self.optimiser = build_optimiser(self.model, self.job.train)
        if saved:
            self.model.load_state_dict(saved.model)
            load_moments(self.optimiser, saved.optimiser)
        self.record = LossRecord(record_path(self.job.run, 0), self.step)
        self.numbers: dict[str, float] = {}
        self.mean: Tensor | None = None

    # ------------------------------------------------------------------------------------------------ what it is

    @classmethod
    def get_method_info(cls) -> dict[str, Any]:
        """What holds for every instance."""
        return {
            "method_id": METHOD,
            "required_features": frozenset(FEATURES),
            "supported_camera_models": frozenset(CAMERAS),
            "supported_outputs": OUTPUTS,
            "can_resume_training": True,
        }

    def get_info(self) -> dict[str, Any]:
        """What holds for this one; `hparams` are the keys of its job."""
        checkpoint, step = self.loaded
        return {
            **self.get_method_info(),
            "num_iterations": self.steps,
            "loaded_step": step,
            "loaded_checkpoint": checkpoint,
            "batch_size": self.job.patch.photos * self.job.patch.size**2,
            "hparams": flatten(
                self.job.model_dump(mode="json", include={"method", "model", "patch", "losses", "train"})
            ),
        }

    @property
    def steps(self) -> int:
        """Of the whole training."""
        return self.job.train.epochs * int(self.scene.identity["steps_per_epoch"])

    # -------------------------------------------------------------------------------------------------- training

    def train_iteration(self, step: int) -> dict[str, float]:
        """One step. Returns loss terms and PSNR of the latest step that was looked at: the device is asked for numbers
        every LOOK_EVERY steps only.

        Raises:
            CrossrayError: without a training data set, or numbers that are not finite.
        """
        if self.work is None:
            raise CrossrayError(f"{self.loaded[0]}: was loaded without a training data set, so it cannot be trained")
        set_learning_rates(self.optimiser, self.job.train, Clock(self.steps, None, step))
        self.step, self.mean = step + 1, None
        if step in self.job.train.skip_steps:
            self.record.leave_out()
            return self.numbers
        terms, watched = training_step(self.work, self.model, self.optimiser, step, self.record)
        if step % LOOK_EVERY == 0 or self.step == self.steps:
            self.look()
            parts = {name: float(term) for name, term in terms.items()}
            self.numbers = {"loss": sum(parts.values()), "psnr": psnr_of(watched["mse"]), **parts}
        return self.numbers

    def look(self, model: SceneModel | None = None) -> None:
        """CrossrayError where the steps since the last look, or the weights of `model`, hold numbers that are not
        finite."""
        if self.work is not None:
            check_finite(self.work, Together(self.work.context), self.record, model)
            self.record = LossRecord(self.record.path, self.step)  # what was looked at is not needed again

    def save(self, path: str) -> None:
        """Write a checkpoint into the folder `path`; the same state gives the same bytes.

        Raises:
            CrossrayError: numbers that are not finite.
        """
        self.look(self.model)
        state = self.model.state_dict()
        write_saved(Path(path), self.job, self.step, self.fits, self.scene, state, self.optimiser)

    # ------------------------------------------------------------------------------------------------ appearance

    def get_train_embedding(self, index: int) -> np.ndarray | None:
        """F^a of a training photo, flat; None where the model has no appearance."""
        appearance = self.training_appearance(index)
        return None if appearance is None else flat(appearance)

    def optimize_embedding(self, dataset: Dataset, *, embedding: np.ndarray | None = None) -> dict[str, Any]:
        """F^a of the one photo of `dataset`, flat: read from it, and with `fit` fitted further to it; learned codes are
        always fitted.

        Args:
            embedding: where a fit begins, in place of what is read, or of the mean of the learned codes.

        Raises:
            NotImplementedError: the model has no appearance; nerfbaselines goes on without.
            CrossrayError: the photo is too small for the encoder.
        """
        spec, image = self.job.model, picture_of(dataset, 0)
        if spec.appearance == "none":
            raise NotImplementedError(f"method {self.job.method}: model.appearance: none, nothing is read from a photo")
        camera, columns = self.camera(dataset["cameras"][0]), image.shape[1]
        protocol, start = judged(), None if embedding is None else self.appearance_of(embedding)
        with evaluating(self.model):
            if self.model.embedding is not None:
                code = fit_code(self.model, image, camera, columns, protocol.fit[spec.field], start=start)
                return {"embedding": flat(code)}
            if start is None or not self.fits:
                start = self.read(reduced(image, self.job.scene.reference_downscale))
            if self.fits:
                start = self.fitted(image, camera, start)
            return {"embedding": flat(start)}

    def fitted(self, image: np.ndarray, camera: CameraRecord, start: Tensor) -> Tensor:
        """F^a from `start` on, fitted to all of `image`, as `nerfw-half+fit` does."""
        protocol, columns = judged(), image.shape[1]
        recipe = protocol.fit_read[self.job.model.field]
        if self.model.coded:
            return fit_code(self.model, image, camera, columns, recipe, start=start)
        view = render_view(self.model, camera, samples=samples_of(self.job.model, protocol))
        return fit_map(self.model, view, image, columns, recipe, start)

    def read(self, reference: np.ndarray) -> Tensor:
        """F^a of a reference, by the encoder."""
        check_reference(self.job.model, reference, "a photo")
        appearance = read_appearance(self.model, reference)
        assert appearance is not None
        return appearance

    @torch.no_grad()
    def training_appearance(self, index: int) -> Tensor | None:
        """F^a of a training photo: (1, C, g, g) or (1, CODE)."""
        if self.model.embedding is not None:
            return self.model.embedding.weight[index : index + 1].clone()
        with evaluating(self.model):
            return read_appearance(self.model, self.scene.references[index])

    @torch.no_grad()
    def mean_appearance(self) -> Tensor | None:
        """The mean F^a of all training photos: what a view is rendered in where no embedding is given."""
        if self.mean is None and self.job.model.appearance != "none":
            total: Tensor | None = None
            for index in range(len(self.scene.references)):
                one = self.training_appearance(index)
                assert one is not None
                total = one if total is None else total + one
            assert total is not None
            self.mean = total / len(self.scene.references)
        return self.mean

    def appearance_of(self, embedding: np.ndarray) -> Tensor:
        """F^a of a flat embedding.

        Raises:
            CrossrayError: it is not of this model.
        """
        values = torch.as_tensor(np.asarray(embedding, np.float32).reshape(-1), device=self.device)
        if self.model.coded:
            shape: tuple[int, ...] = (1, CODE)
        else:
            channels = self.job.model.channels
            side = math.isqrt(len(values) // channels)
            shape = (1, channels, side, side)
        if len(values) == 0 or math.prod(shape) != len(values):
            raise CrossrayError(
                f"an embedding of {len(values)} numbers is no appearance of method {self.job.method}; those of another "
                "method, or of other model.channels, cannot be used"
            )
        return values.view(shape)

    # ------------------------------------------------------------------------------------------------- rendering

    @torch.no_grad()
    def render(self, camera: Cameras, *, options: RenderOptions | None = None) -> dict[str, np.ndarray]:
        """One view. Memory is bounded as `SceneModel.render` says.

        Args:
            options: `embedding`, by default the mean of the training photos; `outputs`, by default all.

        Returns:
            color: uint8 (h, w, 3), rounded: nerfbaselines truncates what is not 8-bit.
            depth: float32 (h, w), expected distance along the ray in the data set's units.
            accumulation: float32 (h, w) in [0, 1].
        """
        options = options or {}
        embedding, wanted = options.get("embedding"), options.get("outputs") or OUTPUTS
        appearance = self.mean_appearance() if embedding is None else self.appearance_of(embedding)
        with evaluating(self.model):
            samples = samples_of(self.job.model, judged())
            view, picture = render_picture(self.model, self.camera(camera), appearance, samples)
        depth = self.scene.scale * view.depth / view.accumulation.clamp(min=1e-3)
        outputs = {
            "color": to_8bit(picture, "round"),
            "depth": depth.float().cpu().numpy(),
            "accumulation": view.accumulation.float().cpu().numpy(),
        }
        return {name: outputs[name] for name in wanted if name in outputs}

    def camera(self, camera: Cameras) -> CameraRecord:
        """A camera in scene units, with the depth bounds that the points give it; where it sees none of them, with the
        widest of the training photos."""
        camera = camera.item()
        width, height = (int(n) for n in camera.image_sizes)
        fx, fy, cx, cy = numbers(camera.intrinsics)
        pose, scale = world_to_camera(camera.poses), self.scene.scale
        try:
            near, far = (z / scale for z in depth_bounds(self.scene.points, pose, "of a view"))
        except SceneError:
            near, far = self.scene.bounds
        return CameraRecord(
            key="view",
            name="view",
            image_id=0,
            split="test",
            width=width,
            height=height,
            fx=fx,
            fy=fy,
            cx=cx,
            cy=cy,
            c2w=camera_to_world(pose, scale).tolist(),
            near=near,
            far=far,
            source_sha256="0" * 64,
        )


def judged() -> Protocol:
    """The protocol of Crossray that nerfbaselines' `nerfw` is."""
    return parse_protocol("nerfw-half@R1")[0]


def job_of(overrides: dict[str, Any], saved: Saved | None) -> Job:
    """The job that overrides make of the usual one, or of that of a checkpoint.

    Raises:
        CrossrayError: a key or a value that cannot be used, or that has no meaning here.
    """
    settings = [f"{key}={value if isinstance(value, str) else json.dumps(value)}" for key, value in overrides.items()]
    raw = saved.job.model_dump(mode="json") if saved else USUAL
    there = flatten(raw)  # what a checkpoint's job says already may be said again
    news = [setting for setting in settings if not flatten(parse_setting(setting)).items() <= there.items()]
    job = make_job(raw, news, source="nerfbaselines")
    if job.train.seconds is not None:
        raise CrossrayError("train.seconds: nerfbaselines counts steps; set train.epochs and train.steps_per_epoch")
    if job.ranks != 1:
        raise CrossrayError(f"ranks: {job.ranks}, and nerfbaselines trains in one process; `crossray train` has many")
    if job.model.transient == "fixed":
        raise CrossrayError("model.transient: fixed reads masks from shards, and a data set of nerfbaselines has none")
    return job


def as_flag(value: Any) -> bool:
    """`true` or `false`, as a value or as text."""
    if str(value).lower() not in ("true", "false"):
        raise CrossrayError(f"{FIT}: {value!r} is neither true nor false")
    return str(value).lower() == "true"


def known_scene(dataset: Dataset, photos: DatasetPhotos, identity: dict[str, Any]) -> KnownScene:
    """What a checkpoint keeps of a data set."""
    return KnownScene(
        points=np.array(dataset["points3D_xyz"], np.float32),
        references=tuple(np.ascontiguousarray(photos.reference(i)) for i in range(len(photos))),
        scale=photos.manifest.scene.scale,
        bounds=(min(r.near for r in photos.records), max(r.far for r in photos.records)),
        identity=identity,
    )


def check_same(saved: Saved, scene: KnownScene) -> None:
    """CrossrayError where a checkpoint is of other photos or another job than are to be trained on."""
    names = {"shards": "photos", "job": "settings", "steps_per_epoch": "epochs"}
    differs = [name for key, name in names.items() if saved.scene.identity.get(key) != scene.identity[key]]
    if differs:
        raise CrossrayError(
            f"the checkpoint of step {saved.step} was trained with other {' and '.join(differs)}: it can be rendered, "
            "but not gone on from; leave out --checkpoint to train anew"
        )


@contextmanager
def evaluating(model: SceneModel) -> Iterator[None]:
    """The model as `crossray evaluate` has it: in evaluation mode, and in float32; afterwards as it was."""
    before, model.use_bfloat16 = model.use_bfloat16, False
    model.eval()
    try:
        yield
    finally:
        model.train()
        model.use_bfloat16 = before


def flat(appearance: Tensor) -> np.ndarray:
    """F^a as nerfbaselines stores and interpolates it: float32 (N,)."""
    return appearance.detach().float().flatten().cpu().numpy()
