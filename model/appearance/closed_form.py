"""The cross-ray transform of Proposition 1, corrected, in the place of the learned one. It has no parameters.

    T(F) = T (F - mu_cr) + mu_a,    T S_cr T^T = S_a,

with T from `model.transport` and P = identity: of all maps that give the rays the mean and the covariance of the
reference's cells, the one that moves them least. Same interface as ReleasedTransform; `gram` holds the covariance.

Both covariances get a ridge, here and not in the statistics, so that averages of statistics stay averages.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from model.appearance.crossray import ContentStatistics, StyleStatistics, check_rays, second_moment
from model.transport import transport

# Added to every variance, so that T stays near the identity until features and embeddings vary by more than this.
# Before anything is learned both are almost constant: without it T would blow noise up, or press what little contrast
# the rays have down to that of an untrained encoder. It also bounds T, which stretches no direction by more than
# sqrt((|S_a| + ridge) / ridge), |S_a| the largest eigenvalue. 1e-3 is a standard deviation of 0.03: little for features
# in (0, 1), and well above what float32 leaves of a covariance.
RIDGE = 1e-3


class ClosedFormTransform(nn.Module):
    """The optimal-transport map between two Gaussians, fitted to the rays and to the reference.

    Args:
        channels: C of a feature and of an embedding. A covariance of N rays has rank N - 1 at most: N > C is wanted.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.moment_size = channels

    def content_statistics(self, features: Tensor) -> ContentStatistics:
        """Mean and covariance of features (P, N, C). The order of the rays does not matter; ValueError without any."""
        return ContentStatistics(*mean_and_covariance(features))

    def style_statistics(self, reference: Tensor) -> StyleStatistics:
        """Mean and covariance of the cells of F^a (P, C, h, w)."""
        return StyleStatistics(*mean_and_covariance(reference.flatten(2).mT))

    def affine(self, content: ContentStatistics, style: StyleStatistics) -> tuple[Tensor, Tensor]:
        """W (P, C, C) and b (P, C) with T(F) = W F + b; W is symmetric. Differentiable once."""
        ridge = RIDGE * torch.eye(self.moment_size, dtype=content.gram.dtype, device=content.gram.device)
        W = transport(content.gram + ridge, style.gram + ridge)
        return W, style.mean - (W @ content.mean[..., None]).squeeze(-1)


def mean_and_covariance(features: Tensor) -> tuple[Tensor, Tensor]:
    """(P, C) and (P, C, C), divided by N, of features (P, N, C); in blocks where no gradient is needed."""
    check_rays(features)
    mean = features.mean(dim=1)
    return mean, second_moment(features, lambda block: block - mean[:, None])
