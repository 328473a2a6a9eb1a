"""The radiance field as one large MLP: position and direction -> density and features (released codes)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from model.encoding import positional_encoding


class RadianceMLP(nn.Module):
    """NeRF's MLP whose head gives `out_channels` features in (0, 1) instead of a colour.

    CR-NeRF's has no code: density and features are those of the place, and all conditioning comes after rendering.
    NeRF-W and Ha-NeRF give the directional layer an appearance code beside the direction; density never sees it. With
    the defaults, 619,073 parameters. Weights start as torch's defaults, as in the released code.
    """

    def __init__(
        self,
        out_channels: int = 64,
        width: int = 256,
        depth: int = 8,
        skip: int = 4,
        xyz_frequencies: int = 15,
        dir_frequencies: int = 4,
        code_channels: int = 0,
    ) -> None:
        """`skip`: index of the layer that sees the encoded position once more, in front of its input."""
        super().__init__()
        self.xyz_frequencies, self.dir_frequencies, self.skip = xyz_frequencies, dir_frequencies, skip
        xyz_channels = 3 * (1 + 2 * xyz_frequencies)
        dir_channels = 3 * (1 + 2 * dir_frequencies)
        inputs = [xyz_channels] + [width] * (depth - 1)
        if 0 < skip < depth:
            inputs[skip] += xyz_channels
        self.layers = nn.ModuleList(nn.Linear(channels, width) for channels in inputs)
        self.density = nn.Linear(width, 1)
        self.bottleneck = nn.Linear(width, width)
        self.directional = nn.Linear(width + dir_channels + code_channels, width // 2)
        self.head = nn.Linear(width // 2, out_channels)

    def trunk(self, xyz: Tensor) -> Tensor:
        """Position (..., 3) in scene units -> (..., width): what is known of a point from any direction."""
        encoded = positional_encoding(xyz, self.xyz_frequencies)
        h = encoded
        for index, layer in enumerate(self.layers):
            assert isinstance(layer, nn.Linear)
            h = joined(layer, encoded, h) if index == self.skip and index > 0 else layer(h)
            h = h.relu_()  # in place: the layer does not look at its output again
        return h

    def forward(self, xyz: Tensor, direction: Tensor, code: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Density (...,) > 0 in 1 / scene unit and features (..., out_channels) in (0, 1).

        xyz: (..., 3). direction: unit, (..., 3), or anything that broadcasts: (R, 1, 3) serves all samples of
        a ray. code: (..., code_channels), likewise.
        """
        density, bottleneck = self.density_and_bottleneck(xyz)
        return density, self.features_at(bottleneck, direction, code)

    def density_and_bottleneck(self, xyz: Tensor) -> tuple[Tensor, Tensor]:
        """Density (...,) and what no direction changes of a point, (..., width)."""
        h = self.trunk(xyz)
        return self.density_at(h), self.bottleneck(h)

    def density_at(self, h: Tensor) -> Tensor:
        """Density (...,) from the trunk's output (..., width)."""
        return functional.softplus(self.density(h)).squeeze(-1)

    def features_at(self, bottleneck: Tensor, direction: Tensor, code: Tensor | None = None) -> Tensor:
        """Features (..., out_channels) from the bottleneck (..., width), as seen from `direction` in the appearance
        `code`.
        """
        seen = positional_encoding(direction, self.dir_frequencies)
        if code is not None:
            places = torch.broadcast_shapes(seen.shape[:-1], code.shape[:-1])
            seen = torch.cat([x.expand(*places, -1) for x in (seen, code)], dim=-1)
        return torch.sigmoid(self.head(joined(self.directional, bottleneck, seen).relu_()))


def joined(layer: nn.Linear, a: Tensor, b: Tensor) -> Tensor:
    """layer([a, b]) without a copy of both beside each other; what is the same for all samples of a ray, (R, 1, .),
    goes through its part of the layer once.
    """
    weight_a, weight_b = layer.weight.split([a.shape[-1], b.shape[-1]], dim=1)
    parts = functional.linear(a, weight_a, layer.bias), functional.linear(b, weight_b)
    whole, other = parts if parts[0].numel() >= parts[1].numel() else parts[::-1]
    return whole.add_(other)
