"""Appearance as a short code read off the photo, which enters the field at each point (Ha-NeRF; Chen et al. 2022).

A code knows a photo's light as a whole and nothing of where in the photo it came from: a convolutional network, then
the mean over all cells.
"""

from __future__ import annotations

from torch import Tensor, nn

from model.appearance.compact import strided_convolutions
from model.methods import CODE, SMALLEST_SIDE

LEAST = SMALLEST_SIDE["code"]  # three halvings of 16 leave 2 pixels, which reflection padding needs


class ReleasedCode(nn.Module):
    """A 7x7 convolution, four that halve, and the mean, as released with Ha-NeRF. 2,775,216 parameters."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(3, 64, kernel_size=7, padding=3, padding_mode="reflect"),
            nn.ReLU(),
            *_halving(64, 128),
            *_halving(128, 256),
            *_halving(256, 256),
            *_halving(256, 256),
        )
        self.head = nn.Linear(256, CODE)

    def forward(self, image: Tensor) -> Tensor:
        """RGB in [0, 1] (B, 3, h, w), h and w at least 16 -> codes (B, CODE). ValueError otherwise."""
        if image.ndim != 4 or image.shape[1] != 3 or min(image.shape[2:]) < LEAST:
            raise ValueError(f"the code network reads (B, 3, h, w) with h, w >= {LEAST}, not {tuple(image.shape)}")
        return self.head(self.layers(2 * image - 1).mean(dim=(2, 3)))


class CompactCode(nn.Module):
    """The convolutions of CompactEncoder, the mean and one layer: codes in (-1, 1)."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = strided_convolutions()
        self.head = nn.Sequential(nn.Linear(48, CODE), nn.Tanh())

    def forward(self, image: Tensor) -> Tensor:
        """RGB in [0, 1] (B, 3, h, w) -> codes (B, CODE); colours enter centred."""
        return self.head(self.layers(2 * image - 1).mean(dim=(2, 3)))


def _halving(inputs: int, outputs: int) -> tuple[nn.Conv2d, nn.ReLU]:
    return nn.Conv2d(inputs, outputs, kernel_size=4, stride=2, padding=1, padding_mode="reflect"), nn.ReLU()
