"""One model under one protocol: what it may see of a test photo, what its picture is compared with, and how."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from model.methods import smallest_side
from model.scene_model import SceneModel
from pipeline.errors import CrossrayError
from pipeline.fit import FitRecipe, fit_code
from pipeline.landmark import Landmark
from pipeline.lpips import LPIPS, VARIABLE, find_lpips, read_lpips
from pipeline.metrics import psnr, ssim_11, ssim_window3
from pipeline.photos import Photos
from pipeline.protocol import Protocol, appearance_from, samples_of
from pipeline.render import View, colour_view, read_appearance, render_picture, render_view
from pipeline.truth import elsewhere, mask_iou, reduced

log = logging.getLogger("crossray")

LPIPS_SIDE = 31  # pixels; AlexNet has nothing left of a smaller picture
MASK_PHOTOS = 32  # training photos over which masks are compared with the truth, at most


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


def lpips_at(weights: Path | None) -> LPIPS:
    """LPIPS with these weights, by default those that this machine has.

    Raises:
        CrossrayError: it has none.
    """
    lpips = read_lpips(weights) if weights else find_lpips()
    if lpips is None:
        raise CrossrayError("LPIPS: the weights that were found before are not on this machine")
    return lpips


@cache
def warn_once(text: str) -> None:
    """A warning that several evaluations share."""
    log.warning(text)


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
