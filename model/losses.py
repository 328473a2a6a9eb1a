"""Every term of the training loss, its weight and its source.

Notation: M (P, N) transient probability, 1 = transient; C (P, N, 3) colours of the photo; Cf, Cc fine and coarse
renderings; F^a appearance embeddings, or codes. The defaults are the weights of the released code, which differ from
the printed ones: there 1e-3 multiplies the appearance term, not the transient one (docs/differences.md lists all).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any, Literal

import torch
from torch import Tensor

from model.methods import STRICT, ModelSpec


@dataclass(frozen=True)
class LossWeights:
    """Weights of the loss terms; a term with weight 0 is not computed."""

    __pydantic_config__ = STRICT

    preset: Literal["released", "paper", "fast"] = "released"
    """Where the defaults of the other keys come from. `released`: the code behind the published numbers. `paper`: its
    equations taken literally. `fast`: what trains the field `hash` best, and its default."""
    photometric: float = 0.5
    """Factor of the mean squared colour error, fine and coarse, and of all terms that make it a likelihood."""
    mask_start: float = 5e-2
    """Weight of mean M^2 at step 0 (lambda_0 of the transient loss; released code: annealed)."""
    mask_end: float = 6e-3
    """Floor of that weight."""
    mask_decay: float = 1e-3
    """Rate a step of its exponential decay from start to floor."""
    appearance: float = 1e-3
    """Weight of the appearance loss."""
    appearance_target: Literal["other", "own"] = "other"
    """`other`: a random other photo's appearance, L1 (released code). `own`: the photo's own, squared L2 (paper)."""
    content: float = 1e-4
    """Weight of the content loss (beta of the appearance loss; appearance `crossray` only)."""
    embedding: float = 1e-5
    """Weight of mean (F^a)^2."""
    mode_seeking: float = 1e-6
    """Weight of the mode-seeking loss (appearance `code` only; CR-NeRF's released code parses it and never uses it)."""
    transient_density: float = 0.01
    """Weight of the mean transient density (transient `uncertainty` only; lambda_u of NeRF-W)."""
    beta_min: float = 0.03
    """Floor of a ray's standard deviation (transient `uncertainty` only)."""
    interlevel: float = 0.1
    """Weight of the loss that keeps the proposal's weights above the field's (field `hash` only)."""

    def mask_weight(self, step: int) -> float:
        """Weight of the mask's size at `step`: max(mask_end, mask_start exp(-mask_decay step))."""
        return max(self.mask_end, self.mask_start * math.exp(-self.mask_decay * step))


def loss_terms(spec: ModelSpec, weights: LossWeights) -> list[str]:
    """Names of the terms that a model of these choices is trained with, as SceneModel.forward gives them."""
    reads, codes = spec.appearance in ("code", "crossray"), spec.appearance == "code"
    present = {
        "fine": True,
        "coarse": spec.field == "mlp",
        "interlevel": spec.field == "hash" and weights.interlevel > 0,
        "mask": spec.transient in ("segmenter", "uvmask") and max(weights.mask_start, weights.mask_end) > 0,
        "uncertainty": spec.transient == "uncertainty",
        "transient_density": spec.transient == "uncertainty" and weights.transient_density > 0,
        "appearance": reads and weights.appearance > 0,
        "embedding": reads and weights.embedding > 0,
        "mode_seeking": codes and weights.mode_seeking > 0,
        "content": spec.appearance == "crossray" and weights.content > 0,
    }
    return [name for name, there in present.items() if there]


# The paper's equations with norms read as means over their elements. Two things are not printed and are ours: lambda_0
# (the floor of the released code, here times lambda as everything in L_t), and that the coarse level keeps its
# photometric term, without which the network that says where to sample would never learn.
LAMBDA = 1e-3
PRESETS: dict[str, dict[str, Any]] = {
    "released": {},
    "paper": {
        "photometric": LAMBDA,
        "mask_start": LAMBDA * 6e-3,
        "mask_end": LAMBDA * 6e-3,
        "mask_decay": 0.0,
        "appearance": 1.0,
        "appearance_target": "own",
        "content": 1e-5,
        "embedding": 0.0,
        "transient_density": 0.01 * LAMBDA / 0.5,  # as NeRF-W weighs it against the pixels
    },
    "fast": {
        "mask_start": 0.3,
        "mask_end": 0.01,
        "mask_decay": 0.007,
        "appearance": 0.0,
        "content": 0.0,
        "mode_seeking": 0.0,
    },
}


def check_weights(weights: LossWeights) -> None:
    """ValueError for a negative weight, whose term would be driven to infinity, and for a loss without a floor."""
    for field in fields(weights):
        value = getattr(weights, field.name)
        if not isinstance(value, str) and value < 0:
            raise ValueError(f"losses.{field.name}: {value} is negative")
    if weights.photometric == 0:
        raise ValueError("losses.photometric: 0 leaves nothing to learn the place from")
    if weights.beta_min == 0:
        raise ValueError("losses.beta_min: 0 lets the standard deviation of a ray vanish; NeRF-W takes 0.03")


def photometric(rendered: Tensor, photo: Tensor, mask: Tensor | None) -> Tensor:
    """mean (1 - M)(rendered - photo)^2 over rays and channels (first term of eq. 'transient').

    Args:
        rendered, photo: (..., 3) in [0, 1].
        mask: (...,) transient probability, or None: every pixel counts.
    """
    squared = (rendered - photo).square()
    if mask is not None:
        squared = (1 - mask)[..., None] * squared
    return squared.mean()


def mask_size(mask: Tensor) -> Tensor:
    """mean M^2 (second term of eq. 'transient'; the paper prints a sum, the code takes the mean)."""
    return mask.square().mean()


def appearance_consistency(embedding: Tensor, re_encoded: Tensor, target: str) -> Tensor:
    """How far the appearance that is read from a rendering is from the one that was put in (first term of eq.
    'transfer'), the latter without gradient.

    `other`: mean |F^a_r - E2(D(T(F, F^a_r)))| (released code, for a random other photo r). `own`: the mean square
    (paper, for the photo itself).
    """
    difference = embedding.detach() - re_encoded
    return difference.abs().mean() if target == "other" else difference.square().mean()


def content_preservation(plain: Tensor, transformed: Tensor) -> Tensor:
    """mean (E5(D(F)) - E5(D(T(F))))^2 (second term of eq. 'transfer')."""
    return (plain - transformed).square().mean()


def embedding_size(embedding: Tensor) -> Tensor:
    """mean (F^a)^2 (released code only)."""
    return embedding.square().mean()


def mode_seeking(picture: Tensor, other_picture: Tensor, code: Tensor, other_code: Tensor) -> Tensor:
    """1 / (mean |Cf - Cf_r| / mean |a - a_r| + 1e-5): other codes shall give other pictures (Ha-NeRF, released code).

    Both means are over all patches. Only `other_picture` carries a gradient. Where both codes are equal (one photo
    alone) it is 1e5, a constant.
    """
    apart = (code.detach() - other_code.detach()).abs().mean()
    ratio = (picture.detach() - other_picture).abs().mean() / apart.clamp(min=1e-12)
    return 1 / (torch.where(apart > 0, ratio, 0 * ratio) + 1e-5)


def uncertain_photometric(rendered: Tensor, photo: Tensor, beta: Tensor) -> Tensor:
    """mean (rendered - photo)^2 / beta^2 (NeRF-W's first term, doubled): rendered (..., 3), beta (...,)."""
    return ((rendered - photo).square() / beta.square()[..., None]).mean()


def log_uncertainty(beta: Tensor) -> Tensor:
    """3 + mean log beta (NeRF-W's second term; the 3 keeps the released code's numbers positive)."""
    return 3 + beta.log().mean()
