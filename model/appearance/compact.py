"""A small appearance branch for small pictures: bounded encoder, transform that starts near the identity.

Same interface as the released one: T(F) = W F + b for each view, from explicit statistics. Two things differ, both from
trouble seen with the released form on the fast field: embeddings pass through tanh, so that style cannot drown content,
and T acts as a correction to F,

    T(F) = F + U M_style M_content K (F - mu_cr) + v(mu_a),

so that a view's own mean (which says more about how much sky it shows than about its light) stays in the picture.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from model.appearance.crossray import ContentStatistics, StyleStatistics, identities, no_moment, second_moment

GRID = 8  # cells a side of an embedding


class CompactEncoder(nn.Module):
    """Strided convolutions and an average pool: images (P, 3, h, w) in [0, 1] -> F^a (P, C, 8, 8) in (-1, 1)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            *strided_convolutions(),
            nn.AdaptiveAvgPool2d(GRID),
            nn.Conv2d(48, channels, 1),
            nn.Tanh(),
        )

    def forward(self, image: Tensor) -> Tensor:
        """F^a (P, C, 8, 8) of images (P, 3, h, w); colours enter centred."""
        return self.layers(2 * image - 1)


def strided_convolutions() -> nn.Sequential:
    """Images (P, 3, h, w) -> (P, 48, ceil(h/8), ceil(w/8))."""
    return nn.Sequential(
        nn.Conv2d(3, 16, 3, stride=2, padding=1),
        nn.LeakyReLU(0.2),
        nn.Conv2d(16, 32, 3, stride=2, padding=1),
        nn.LeakyReLU(0.2),
        nn.Conv2d(32, 48, 3, stride=2, padding=1),
        nn.LeakyReLU(0.2),
    )


class CompactTransform(nn.Module):
    """T from second moments of compressed features, near the identity at the start.

    Args:
        channels: C of a feature and of an embedding.
        compressed: c, side of the matrices.
        content, style: False leaves that second moment out. Controls: without the content's, T no longer looks across
            rays but for their mean; without both, T(F) = F + U K (F - mu_cr) + v(mu_a).
    """

    def __init__(self, channels: int, compressed: int = 16, content: bool = True, style: bool = True) -> None:
        super().__init__()
        self.compressed = compressed
        self.moment_size = compressed if content else 0
        self.compress = nn.Linear(channels, compressed, bias=False)
        self.content = nn.Linear(channels, compressed) if content else None
        self.style = nn.Linear(channels, compressed) if style else None
        self.content_matrix = nn.Linear(compressed**2, compressed**2) if content else None
        self.style_matrix = nn.Linear(compressed**2, compressed**2) if style else None
        self.unzip = nn.Linear(compressed, channels, bias=False)
        self.shift = nn.Sequential(nn.Linear(channels, 64), nn.LeakyReLU(0.2), nn.Linear(64, channels))
        for layer in (self.content_matrix, self.style_matrix):
            if layer is not None:
                nn.init.normal_(layer.weight, std=0.1 / compressed)
                nn.init.zeros_(layer.bias)
        nn.init.normal_(self.unzip.weight, std=0.1 / compressed**0.5)

    def content_statistics(self, features: Tensor) -> ContentStatistics:
        """Mean (P, C) and second moment (P, c, c) of the features (P, N, C) of the rays at hand."""
        mean = features.mean(dim=1)
        return ContentStatistics(mean, moment(self.content, features, mean))

    def style_statistics(self, embedding: Tensor) -> StyleStatistics:
        """Mean (P, C) and second moment (P, c, c) of embeddings (P, C, h, w)."""
        cells = embedding.flatten(2).transpose(1, 2)
        mean = cells.mean(dim=1)
        return StyleStatistics(mean, moment(self.style, cells, mean))

    def affine(self, content: ContentStatistics, style: StyleStatistics) -> tuple[Tensor, Tensor]:
        """W (P, C, C) and b (P, C) with T(F) = W F + b."""
        product = self.matrix(self.style_matrix, style.gram) @ self.matrix(self.content_matrix, content.gram)
        correction = self.unzip.weight @ product @ self.compress.weight
        b = self.shift(style.mean) - (correction @ content.mean[..., None]).squeeze(-1)
        return torch.eye(correction.shape[-1], device=b.device) + correction, b

    def matrix(self, layer: nn.Linear | None, gram: Tensor) -> Tensor:
        """I + FC(gram), (P, c, c); just I without a layer."""
        identity = identities(gram, self.compressed)
        return identity if layer is None else identity + layer(gram.flatten(1)).view_as(identity)


def moment(per_ray: nn.Linear | None, features: Tensor, mean: Tensor) -> Tensor:
    """Second moment (P, c, c) of per_ray(features - mean) over rays or cells (P, N, C); (P, 0, 0) without a layer."""
    if per_ray is None:
        return no_moment(features)
    return second_moment(features, lambda block: per_ray(block - mean[:, None]))


def at_size(images: list[Tensor], size: tuple[int, int]) -> Tensor:
    """Images (3, h, w) of any size as one batch (P, 3, *size), area-averaged."""
    return torch.cat([reduced(image[None], size) for image in images])


def reduced(image: Tensor, size: tuple[int, int]) -> Tensor:
    """One image (1, 3, h, w) at that size."""
    return image if image.shape[-2:] == size else F.interpolate(image, size=size, mode="area")
