"""Cross-ray appearance: the transform T and the decoder D of CR-NeRF, as released (there: MulLayer).

Notation: P patches or views, each with its own reference photo; N rays; C = 64 channels; c = 32 compressed
channels. F (P, N, C) are the rendered features F^cr, F^a (P, C, h, w) the features of the reference photo.

T looks at F only through its mean and one second moment over the rays, and at F^a only through the same two
of its cells. Given these four, T(F) = W F + b is affine, the decoder is affine up to a sigmoid, and so

    rgb = sigmoid(A F + b')          with A (3, C) and b' (3,) for a whole view and one appearance.

Hence features are rendered once and coloured as often as one likes. The statistics are values that the caller
holds: it decides whether they come from a patch, a view, or the past, and cutting a view into chunks cannot
change a colour.

The released code differs from the paper: a fully connected layer follows each second moment, T = M_style @
M_content in this order, channels are centred before and the reference's mean is added after, and moments are
not re-centred.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor, nn

BLOCK = 16384  # rays whose activations are held at once when no gradient is needed


class ContentStatistics(NamedTuple):
    """What T needs to know of the rendered features: mean (P, C) over rays, second moment (P, c, c)."""

    mean: Tensor
    gram: Tensor


class StyleStatistics(NamedTuple):
    """What T needs to know of the reference photo: mean (P, C) over its cells, second moment (P, c, c)."""

    mean: Tensor
    gram: Tensor


class MomentNet(nn.Module):
    """A small MLP on each ray alone, the second moment of its output over rays, a matrix read off that."""

    def __init__(self, channels: int, compressed: int) -> None:
        super().__init__()
        self.per_ray = nn.Sequential(
            nn.Linear(channels, 2 * channels),
            nn.LeakyReLU(0.2),
            nn.Linear(2 * channels, channels),
            nn.LeakyReLU(0.2),
            nn.Linear(channels, compressed),
        )
        self.read_off = nn.Linear(compressed**2, compressed**2)

    def gram(self, features: Tensor, mean: Tensor) -> Tensor:
        """Second moment (P, c, c) of z = per_ray(features - mean) over the rays; z itself is not centred."""
        return second_moment(features, lambda block: self.per_ray(block - mean[:, None]))

    def matrix(self, gram: Tensor) -> Tensor:
        """(P, c, c) -> (P, c, c)."""
        return self.read_off(gram.flatten(1)).view_as(gram)


class NoMoment(nn.Module):
    """In the place of a MomentNet: looks at nothing, and its matrix is the identity."""

    def __init__(self, compressed: int) -> None:
        super().__init__()
        self.compressed = compressed

    def gram(self, features: Tensor, mean: Tensor) -> Tensor:
        """(P, 0, 0)."""
        return no_moment(features)

    def matrix(self, gram: Tensor) -> Tensor:
        """P identities (P, c, c)."""
        return identities(gram, self.compressed)


def second_moment(features: Tensor, z: Callable[[Tensor], Tensor]) -> Tensor:
    """mean_n z_n z_n^T (P, c, c) of z(features), features (P, N, C); z (P, N, c) must look at each ray alone.

    Without gradients the rays go through in blocks of a fixed size, so that a view of 500,000 rays needs
    no more memory than a block; the result does not depend on how a caller chunks its rendering.
    """
    if torch.is_grad_enabled():
        total = outer_sum(z(features))
    else:
        total = torch.stack([outer_sum(z(block)) for block in features.split(BLOCK, dim=1)]).sum(0)
    return total / features.shape[1]


def outer_sum(z: Tensor) -> Tensor:
    """sum_n z_n z_n^T: (P, N, c) -> (P, c, c)."""
    return z.mT @ z


def no_moment(features: Tensor) -> Tensor:
    """The second moment (P, 0, 0) of a transform that uses none."""
    return features.new_zeros(len(features), 0, 0)


def identities(gram: Tensor, side: int) -> Tensor:
    """One identity (side, side) for each row of `gram`: (P, side, side)."""
    return torch.eye(side, dtype=gram.dtype, device=gram.device).expand(len(gram), side, side)


def check_rays(features: Tensor) -> None:
    """ValueError unless `features` are (P, N > 0, C)."""
    if features.ndim != 3 or features.shape[1] == 0:
        raise ValueError(f"statistics need features (P, N > 0, C), not {tuple(features.shape)}")


class ReleasedTransform(nn.Module):
    """T as released. With the defaults, 2,140,704 parameters; weights start as torch's defaults, as there.

    Args:
        channels: C of a feature and of an embedding.
        compressed: c, side of the matrices.
        content, style: False leaves that second moment out. Controls: without the content's, T no longer looks across
            rays but for their mean; without both, T(F) = expand(compress(F - mu_cr)) + mu_a.
    """

    def __init__(self, channels: int = 64, compressed: int = 32, content: bool = True, style: bool = True) -> None:
        super().__init__()
        self.moment_size = compressed if content else 0
        self.compress = nn.Linear(channels, compressed)
        self.expand = nn.Linear(compressed, channels)
        self.content = MomentNet(channels, compressed) if content else NoMoment(compressed)
        self.style = MomentNet(channels, compressed) if style else NoMoment(compressed)

    def content_statistics(self, features: Tensor) -> ContentStatistics:
        """Of features (P, N, C). The order of the rays does not matter; ValueError if there are none."""
        check_rays(features)
        mean = features.mean(dim=1)
        return ContentStatistics(mean, self.content.gram(features, mean))

    def style_statistics(self, reference: Tensor) -> StyleStatistics:
        """Of F^a (P, C, h, w), as it comes from the encoder. The order of its cells does not matter."""
        cells = reference.flatten(2).mT
        mean = cells.mean(dim=1)
        return StyleStatistics(mean, self.style.gram(cells, mean))

    def matrix(self, content: ContentStatistics, style: StyleStatistics) -> Tensor:
        """The paper's T (P, c, c): what is applied to the compressed, centred features."""
        return self.style.matrix(style.gram) @ self.content.matrix(content.gram)

    def affine(self, content: ContentStatistics, style: StyleStatistics) -> tuple[Tensor, Tensor]:
        """W (P, C, C) and b (P, C) with T(F) = W F + b.

        Equal to expand(matrix @ compress(F - content mean)) + style mean, multiplied out.
        """
        lift = self.expand.weight @ self.matrix(content, style)
        centre = self.compress.bias - content.mean @ self.compress.weight.mT
        b = (lift @ centre[..., None]).squeeze(-1) + self.expand.bias + style.mean
        return lift @ self.compress.weight, b


class AffineDecoder(nn.Module):
    """D: one linear layer and a sigmoid, all that the released NeuralRenderer does. 195 parameters."""

    def __init__(self, channels: int = 64) -> None:
        super().__init__()
        self.linear = nn.Linear(channels, 3)

    def forward(self, features: Tensor) -> Tensor:
        """D(F), with no appearance applied: (..., C) -> rgb (..., 3)."""
        return torch.sigmoid(self.linear(features))

    def fold(self, W: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
        """T and D as one map: W (P, C, C), b (P, C) -> A (P, 3, C), b' (P, 3) for `recolour`."""
        return self.linear.weight @ W, self.linear(b)


def recolour(features: Tensor, A: Tensor, b: Tensor) -> Tensor:
    """sigmoid(A F + b): features (P, N, C), A (P, 3, C), b (P, 3) -> rgb (P, N, 3) in (0, 1)."""
    return torch.sigmoid(features @ A.mT + b[:, None, :])
