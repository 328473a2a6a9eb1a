"""The transient segmenter S: CGNet with M = N = 2 blocks and one class (Wu et al. 2018; released code).

A photo -> the probability that a pixel is transient (1 = transient; the paper calls its complement
"visibility"). Its real resolution is 1/8 of what it reads, which is itself 1/8 of the photo.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

STRIDE = 8
GATE_HIDDEN = 8


class CGNet(nn.Module):
    """Three stages, each at half the resolution of the one before. 257,714 parameters.

    Batch normalisation works on one photo at a time in training, so running averages are what evaluation
    uses.
    """

    def __init__(self, blocks2: int = 2, blocks3: int = 2) -> None:
        """`blocks2`, `blocks3`: blocks in the second and third stage (M and N), the halving one included."""
        super().__init__()
        self.stage1 = nn.Sequential(ConvNormAct(3, 32, stride=2), ConvNormAct(32, 32), ConvNormAct(32, 32))
        self.join1 = NormAct(32 + 3)
        self.down2 = DownBlock(32 + 3, 64, dilation=2)
        self.stage2 = nn.Sequential(*(ContextBlock(64, dilation=2) for _ in range(blocks2 - 1)))
        self.join2 = NormAct(64 + 64 + 3)
        self.down3 = DownBlock(64 + 64 + 3, 128, dilation=4)
        self.stage3 = nn.Sequential(*(ContextBlock(128, dilation=4) for _ in range(blocks3 - 1)))
        self.join3 = NormAct(128 + 128)
        self.classifier = nn.Conv2d(256, 1, kernel_size=1, bias=False)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight)

    def forward(self, image: Tensor) -> Tensor:
        """RGB in [0, 1] (B, 3, h, w) -> logit (B, 1, ceil(h/8), ceil(w/8)). ValueError for another shape."""
        if image.ndim != 4 or image.shape[1] != 3:
            raise ValueError(f"the segmenter reads (B, 3, h, w), not {tuple(image.shape)}")
        half = functional.avg_pool2d(image, kernel_size=3, stride=2, padding=1)
        quarter = functional.avg_pool2d(half, kernel_size=3, stride=2, padding=1)

        x = self.join1(torch.cat([self.stage1(image), half], dim=1))
        down = self.down2(x)
        x = self.join2(torch.cat([self.stage2(down), down, quarter], dim=1))
        down = self.down3(x)
        x = self.join3(torch.cat([down, self.stage3(down)], dim=1))  # this order, unlike join2: as released
        return self.classifier(x)


def transient_probability(logit: Tensor, size: tuple[int, int], seen: tuple[int, int] | None = None) -> Tensor:
    """CGNet's logit (B, 1, h/8, w/8) -> probability (B, 1, *size) in [0, 1] (released code).

    Two bilinear steps: the logit is enlarged to what the segmenter read, and its sigmoid is resized to `size`. `seen`
    is the size (h, w) of what it read; without it, 8 times the logit's, which is the same for multiples of 8.
    """
    seen = seen or (STRIDE * logit.shape[2], STRIDE * logit.shape[3])
    return resized(resized(logit, seen).sigmoid(), size)


def resized(x: Tensor, size: tuple[int, int]) -> Tensor:
    """x (B, C, h, w) at that size, bilinear."""
    if x.shape[-2:] == size:
        return x
    return functional.interpolate(x, size=size, mode="bilinear", align_corners=False)


class NormAct(nn.Sequential):
    """Batch normalisation and a leaky ReLU whose slope is learned for each channel."""

    def __init__(self, channels: int) -> None:
        super().__init__(nn.BatchNorm2d(channels, eps=1e-3), nn.PReLU(channels))


class ConvNormAct(nn.Sequential):
    """A square convolution without bias, then NormAct."""

    def __init__(self, inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> None:
        conv = nn.Conv2d(inputs, outputs, kernel, stride, padding=(kernel - 1) // 2, bias=False)
        super().__init__(conv, NormAct(outputs))


class LocalAndSurrounding(nn.Module):
    """Each channel filtered by itself twice, close by and dilated; both results, concatenated."""

    def __init__(self, channels: int, dilation: int) -> None:
        super().__init__()
        self.local = nn.Conv2d(channels, channels, 3, padding=1, groups=channels, bias=False)
        self.surrounding = nn.Conv2d(
            channels, channels, 3, padding=dilation, dilation=dilation, groups=channels, bias=False
        )

    def forward(self, x: Tensor) -> Tensor:
        return torch.cat([self.local(x), self.surrounding(x)], dim=1)


class Gate(nn.Module):
    """Scales each channel by a number in (0, 1) that is read off the mean of all channels."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.squeeze = nn.Linear(channels, GATE_HIDDEN)
        self.excite = nn.Linear(GATE_HIDDEN, channels)

    def forward(self, x: Tensor) -> Tensor:
        scale = torch.sigmoid(self.excite(torch.relu(self.squeeze(x.mean(dim=(2, 3))))))
        return x * scale[:, :, None, None]


class DownBlock(nn.Module):
    """Context-guided block that halves the resolution."""

    def __init__(self, inputs: int, outputs: int, dilation: int) -> None:
        super().__init__()
        self.halve = ConvNormAct(inputs, outputs, stride=2)
        self.context = LocalAndSurrounding(outputs, dilation)
        self.join = NormAct(2 * outputs)
        self.reduce = nn.Conv2d(2 * outputs, outputs, kernel_size=1, bias=False)
        self.gate = Gate(outputs)

    def forward(self, x: Tensor) -> Tensor:
        return self.gate(self.reduce(self.join(self.context(self.halve(x)))))


class ContextBlock(nn.Module):
    """Context-guided block at one resolution, added to its input."""

    def __init__(self, channels: int, dilation: int) -> None:
        super().__init__()
        self.narrow = ConvNormAct(channels, channels // 2, kernel=1)
        self.context = LocalAndSurrounding(channels // 2, dilation)
        self.join = NormAct(channels)
        self.gate = Gate(channels)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.gate(self.join(self.context(self.narrow(x))))
