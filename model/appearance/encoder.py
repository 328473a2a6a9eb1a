"""The released encoders of appearance (E2) and content (E5): an image -> a 64 x 32 x 32 feature map.

Shaped like the first layers of VGG, but trained from scratch. E2 reads the reference photo, at 1/8 of its
size; E5 is a second copy that compares rendered patches in training and is not needed afterwards.
"""

from __future__ import annotations

from torch import Tensor, nn

from model.methods import SMALLEST_SIDE

LEAST = SMALLEST_SIDE["crossray"]  # two poolings of 8 leave 2 pixels, which reflection padding needs


class ReleasedEncoder(nn.Module):
    """Seven convolutions, two poolings, and an average to 32 x 32 cells. 416,012 parameters.

    A 32 x 32 patch is 8 x 8 before that average, which then *replicates*: 64 distinct cells out of 1,024.
    """

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(3, 3, kernel_size=1),  # a learned change of colour space, without activation
            *_conv3x3(3, 64),
            *_conv3x3(64, 64),
            nn.MaxPool2d(2),
            *_conv3x3(64, 128),
            *_conv3x3(128, 128),
            nn.MaxPool2d(2),
            *_conv3x3(128, 128),
            nn.AdaptiveAvgPool2d(32),
            nn.Conv2d(128, 64, kernel_size=1),
            nn.LeakyReLU(0.2),
        )

    def forward(self, image: Tensor) -> Tensor:
        """RGB in [0, 1] (B, 3, h, w), h and w at least 8 -> F^a (B, 64, 32, 32). ValueError otherwise."""
        if image.ndim != 4 or image.shape[1] != 3 or min(image.shape[2:]) < LEAST:
            raise ValueError(f"the encoder reads (B, 3, h, w) with h, w >= {LEAST}, not {tuple(image.shape)}")
        return self.layers(image)


def _conv3x3(inputs: int, outputs: int) -> tuple[nn.Conv2d, nn.LeakyReLU]:
    return nn.Conv2d(inputs, outputs, kernel_size=3, padding=1, padding_mode="reflect"), nn.LeakyReLU(0.2)
