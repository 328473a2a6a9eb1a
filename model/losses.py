"""Every term of the training loss, its weight and its source.

Notation: M (P, N) transient probability, 1 = transient; C (P, N, 3) colours of the photo; Cf, Cc fine and coarse
renderings; F^a appearance embeddings. The defaults are the weights of the released code, which differ from the printed
ones: there 1e-3 multiplies the appearance term, not the transient one (docs/differences.md lists all of it).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from torch import Tensor

from model.methods import STRICT


@dataclass(frozen=True)
class LossWeights:
    """Weights of the loss terms; a term with weight 0 is not computed."""

    __pydantic_config__ = STRICT

    mask_start: float = 5e-2
    """Weight of mean M^2 at step 0 (lambda_0 of the transient loss; released code: annealed)."""
    mask_end: float = 6e-3
    """Floor of that weight."""
    mask_decay: float = 1e-3
    """Rate a step of its exponential decay from start to floor."""
    appearance: float = 1e-3
    """Weight of the appearance loss on a random other photo's embedding."""
    content: float = 1e-4
    """Weight of the content loss (beta of the appearance loss)."""
    embedding: float = 1e-5
    """Weight of mean (F^a)^2."""
    interlevel: float = 0.1
    """Weight of the loss that keeps the proposal's weights above the field's (field `hash` only)."""

    def mask_weight(self, step: int) -> float:
        """Weight of the mask's size at `step`: max(mask_end, mask_start exp(-mask_decay step))."""
        return max(self.mask_end, self.mask_start * math.exp(-self.mask_decay * step))


def check_weights(weights: LossWeights) -> None:
    """ValueError for a negative weight: its term would be driven to infinity."""
    for field in fields(weights):
        if getattr(weights, field.name) < 0:
            raise ValueError(f"losses.{field.name}: {getattr(weights, field.name)} is negative")


def photometric(rendered: Tensor, photo: Tensor, mask: Tensor | None) -> Tensor:
    """0.5 mean (1 - M)(rendered - photo)^2 over rays and channels (first term of eq. 'transient', with the code's 0.5).

    Args:
        rendered, photo: (..., 3) in [0, 1].
        mask: (...,) transient probability, or None: every pixel counts.
    """
    squared = (rendered - photo).square()
    if mask is not None:
        squared = (1 - mask)[..., None] * squared
    return 0.5 * squared.mean()


def mask_size(mask: Tensor) -> Tensor:
    """mean M^2 (second term of eq. 'transient'; the paper prints a sum, the code takes the mean)."""
    return mask.square().mean()


def appearance_consistency(embedding: Tensor, re_encoded: Tensor) -> Tensor:
    """mean |F^a_r - E2(D(T(F, F^a_r)))|, target detached (released code; the paper prints a squared L2)."""
    return (embedding.detach() - re_encoded).abs().mean()


def content_preservation(plain: Tensor, transformed: Tensor) -> Tensor:
    """mean (E5(D(F)) - E5(D(T(F))))^2 (second term of eq. 'transfer')."""
    return (plain - transformed).square().mean()


def embedding_size(embedding: Tensor) -> Tensor:
    """mean (F^a)^2 (released code only)."""
    return embedding.square().mean()
