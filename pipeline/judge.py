"""One model under one protocol: what it may see of a test photo, what its picture is compared with, and how."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from model.scene_model import SceneModel
from pipeline.errors import CrossrayError
from pipeline.fit import FitRecipe, fit_code, fit_map
from pipeline.landmark import Landmark
from pipeline.lpips import LPIPS, SMALLEST_SIDE, VARIABLE, find_lpips, read_lpips
from pipeline.metrics import psnr, ssim_11, ssim_window3
from pipeline.photos import Photos
from pipeline.protocol import Protocol, appearance_from, samples_of
from pipeline.render import View, check_reference, colour_view, read_appearance, render_view
from pipeline.truth import elsewhere, mask_iou, reduced

log = logging.getLogger("crossray")

MASK_PHOTOS = 32  # training photos over which masks are compared with the truth, at most


class Judged(NamedTuple):
    """A test photo's view in the appearance that the protocol lets the model see, and what it took."""

    view: View
    picture: np.ndarray  # (h, w, 3) in [0, 1]
    appearance_seconds: float  # encoding, fitting
    render_seconds: float  # the field, the colours


class Seen(NamedTuple):
    """What a protocol lets the model see of a test photo."""

    source: int  # the photo whose view this is
    image: np.ndarray  # uint8 (h, w, 3)
    columns: int  # of the image, from the left, that a fit may look at
    reference: np.ndarray  # for the encoder: uint8 (h', w', 3)


@dataclass
class Shared:
    """What the protocols of one checkpoint need not do twice, with the seconds that it took."""

    codes: dict[tuple[FitRecipe, int, str], tuple[torch.Tensor, float]] = field(default_factory=dict)
    """(recipe, photo, what it was read from) -> fitted code."""
    views: dict[tuple[int, tuple[int, int] | None], tuple[View, float]] = field(default_factory=dict)
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
        self.samples = samples_of(model.spec, protocol)

    def render(self, index: int) -> Judged:
        """A test photo's view in the appearance that the protocol lets the model see.

        Raises:
            CrossrayError: the model gives no picture of it: values that are not numbers.
        """
        if self.model.coded:  # the field itself reads the appearance: another view for each
            appearance, reading = self.appearance(index)
            began = self.now()
            view = render_view(self.model, self.photos.records[index], appearance, samples=self.samples)
            rendering = self.now() - began
            self.check_numbers(view.features, "its rendered view", index)
        else:
            view, rendering = self.view(index)
            self.check_numbers(view.features, "its rendered view", index)
            appearance, reading = self.appearance(index, view)
        began = self.now()
        picture = colour_view(self.model, view, appearance)
        rendering += self.now() - began
        self.check_numbers(torch.from_numpy(picture), "its picture", index)
        if self.protocol.suffix == "affine":
            began = self.now()
            picture = fit_colours(picture, self.photos.image(index))
            reading += self.now() - began
        return Judged(view, picture, reading, rendering)

    def view(self, index: int) -> tuple[View, float]:
        """A test photo's view, whatever its appearance, and the seconds that it took when it was rendered."""
        key = (index, self.samples)
        if key not in self.shared.views:
            self.shared.views.clear()
            began = self.now()
            view = render_view(self.model, self.photos.records[index], samples=self.samples)
            self.shared.views[key] = view, self.now() - began
        return self.shared.views[key]

    def now(self) -> float:
        """Seconds; all that the device was given is done."""
        device = next(self.model.parameters()).device
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        return time.perf_counter()

    def seen(self, index: int) -> Seen:
        """What may be seen of a test photo. Nothing is ever fitted to the scored half of it."""
        if self.protocol.appearance == "elsewhere":
            source = elsewhere(self.photos, index)
            image = self.clean(source, index)
            reference = reduced(image, self.photos.manifest.reference_downscale)
            return Seen(source, image, image.shape[1], reference)
        image, reference = self.photos.image(index), self.photos.reference(index)
        if self.appearance_from == "left":
            reference = left_half(reference)
        return Seen(index, image, left_half(image).shape[1], reference)

    def appearance(self, index: int, view: View | None = None) -> tuple[torch.Tensor | None, float]:
        """F^a of a test photo, and the seconds that it took to read or fit it.

        Args:
            view: of the photo, where appearance acts on what is rendered.
        """
        if self.model.spec.appearance == "none":
            return None, 0.0
        seen = self.seen(index)
        if self.model.embedding is not None:
            return self.learned_code(seen, index)
        check_reference(self.model.spec, seen.reference, self.photos.records[index].name)
        began = self.now()
        appearance = read_appearance(self.model, seen.reference)
        self.check_numbers(appearance, "the appearance that is read for it", index)
        if self.protocol.suffix == "fit":
            assert appearance is not None
            appearance = self.fitted(appearance, seen, index, view)
            self.check_numbers(appearance, "the appearance that is fitted for it", index)
        return appearance, self.now() - began

    def learned_code(self, seen: Seen, index: int) -> tuple[torch.Tensor, float]:
        """A code for the photo, fitted from the mean of those of the training photos."""
        recipe = self.protocol.fit[self.model.spec.field]
        codes, key = self.shared.codes, (recipe, index, self.appearance_from)
        if key not in codes:
            camera, began = self.photos.records[seen.source], self.now()
            code = fit_code(self.model, seen.image, camera, seen.columns, recipe, seed=index)
            codes[key] = code, self.now() - began
        return codes[key]

    def fitted(self, appearance: torch.Tensor, seen: Seen, index: int, view: View | None) -> torch.Tensor:
        """`appearance`, as it was read from the photo, fitted further (`+fit`)."""
        recipe, camera = self.protocol.fit_read[self.model.spec.field], self.photos.records[seen.source]
        if self.model.coded:
            return fit_code(self.model, seen.image, camera, seen.columns, recipe, seed=index, start=appearance)
        if view is None or seen.source != index:
            view = render_view(self.model, camera, samples=self.samples)
        return fit_map(self.model, view, seen.image, seen.columns, recipe, appearance, seed=index)

    def check_numbers(self, values: torch.Tensor | None, what: str, index: int) -> None:
        """CrossrayError where the model gives NaN for a photo: no metric of it means anything."""
        bad = 0 if values is None else int(values.isnan().sum())
        if values is not None and bad:
            raise CrossrayError(
                f"{self.photos.records[index].name}: {bad} of {values.numel()} numbers of {what} are NaN, so nothing "
                "can be scored; an earlier checkpoint may do (--step)"
            )

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


def first_scored(width: int, protocol: Protocol) -> int:
    """The first column that is scored of a picture of this width."""
    return width // 2 if protocol.scored == "right" else 0


def lpips_usable(photos: Photos, indices: tuple[int, ...], protocol: Protocol) -> bool:
    """Whether the weights of LPIPS are found and all pictures are large enough; if not, the log says why."""
    if find_lpips() is None:
        warn_once(f"LPIPS is left out: no weights found; {VARIABLE}=/path/to/lpips_alex.npz names them")
        return False
    for record in (photos.records[i] for i in indices):
        width = record.width - first_scored(record.width, protocol)
        if min(record.height, width) < SMALLEST_SIDE:
            warn_once(f"LPIPS is left out: what is scored of {record.name} has a side under {SMALLEST_SIDE} pixels")
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
    start = first_scored(truth.shape[1], protocol)
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
    some = depth.flatten()[:: 1 + depth.numel() // 1_000_000]  # torch takes quantiles of 16 million numbers at most
    near, far = torch.quantile(some, torch.tensor([0.01, 0.99], device=depth.device))
    bright = (1 - 0.85 * ((depth - near) / (far - near).clamp(min=1e-6)).clamp(0, 1)) * view.accumulation.clamp(0, 1)
    return (255 * bright).round().byte().cpu().numpy()
