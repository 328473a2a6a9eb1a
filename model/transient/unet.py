"""A small U-Net segmenter: its masks are as fine as its input, where the released CGNet sees 1/64 of a photo."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

INITIAL_LOGIT = -2.0  # nearly nothing is transient before anything is learned


class UNet(nn.Module):
    """Three scales, the finest at half the input: pixels enter and leave in 2 x 2 groups.

    That costs a CPU far less than the same network at full resolution. GroupNorm keeps no statistics across photos, so
    training and evaluation see the same function.

    Args:
        width: channels at the finest scale.
    """

    def __init__(self, width: int = 16) -> None:
        super().__init__()
        self.enter = block(3 * 4, width)
        self.down1 = block(width, 2 * width)
        self.down2 = block(2 * width, 3 * width)
        self.up1 = block(5 * width, 2 * width)
        self.up2 = block(3 * width, width)
        self.out = nn.Conv2d(width, 4, 1)
        nn.init.zeros_(self.out.weight)  # so the other layers begin to learn at the second step
        nn.init.constant_(self.out.bias, INITIAL_LOGIT)  # type: ignore[arg-type]

    def forward(self, image: Tensor) -> Tensor:
        """Logits (B, 1, h, w) of images (B, 3, h, w) in [0, 1]; ValueError unless h and w are even."""
        if image.ndim != 4 or image.shape[-2] % 2 or image.shape[-1] % 2:
            raise ValueError(f"the U-Net reads (B, 3, h, w) with even sides, not {tuple(image.shape)}")
        fine = self.enter(F.pixel_unshuffle(image, 2))
        middle = self.down1(F.avg_pool2d(fine, 2, ceil_mode=True))
        coarse = self.down2(F.avg_pool2d(middle, 2, ceil_mode=True))
        middle = self.up1(torch.cat([resize(coarse, middle), middle], dim=1))
        return F.pixel_shuffle(self.out(self.up2(torch.cat([resize(middle, fine), fine], dim=1))), 2)


def block(inputs: int, outputs: int) -> nn.Sequential:
    """3x3 convolution, GroupNorm, ReLU."""
    return nn.Sequential(nn.Conv2d(inputs, outputs, 3, padding=1, bias=False), nn.GroupNorm(4, outputs), nn.ReLU())


def resize(x: Tensor, like: Tensor) -> Tensor:
    """x at the height and width of `like`."""
    resized = F.interpolate(x, size=like.shape[-2:], mode="bilinear", align_corners=False)
    if resized.requires_grad:
        # A concatenation's gradient is a part of a larger tensor, with which torch's kernel is five times slower.
        resized.register_hook(lambda grad: grad.contiguous(memory_format=torch.channels_last))
    return resized
