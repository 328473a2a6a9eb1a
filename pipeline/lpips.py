"""LPIPS v0.1 with AlexNet (Zhang et al. 2018): a learned distance between pictures; lower is closer.

Its weights are no part of Crossray. They come from a file (.npz or .safetensors) with the convolutions of
torchvision's AlexNet, `features.{0,3,6,8,10}.{weight,bias}`, and the five heads of LPIPS,
`lin{0..4}.model.1.weight`; or from the packages torchvision and lpips, where both are installed and AlexNet
is already downloaded.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn import functional

from pipeline.errors import CrossrayError

VARIABLE = "CROSSRAY_LPIPS"
SMALLEST_SIDE = 31  # below it nothing is left after AlexNet's second pooling

# Index in torchvision's `features` -> channels in and out, kernel, stride, padding of the convolution there.
# Each is followed by a ReLU, whose output is compared.
CONVOLUTIONS = {
    "0": (3, 64, 11, 4, 2),
    "3": (64, 192, 5, 1, 2),
    "6": (192, 384, 3, 1, 1),
    "8": (384, 256, 3, 1, 1),
    "10": (256, 256, 3, 1, 1),
}
POOLED_BEFORE = ("3", "6")


class LPIPS(nn.Module):
    """The network; frozen. `source` in the constructor names the file for error messages."""

    mean: Tensor
    std: Tensor

    def __init__(self, weights: Mapping[str, Tensor], source: str) -> None:
        """CrossrayError, naming `source` and the key, where a weight is missing, misshapen or not finite."""
        super().__init__()
        self.features = nn.ModuleDict({index: nn.Conv2d(*shape) for index, shape in CONVOLUTIONS.items()})
        self.heads = nn.ModuleList(
            nn.Conv2d(outputs, 1, kernel_size=1, bias=False) for _, outputs, *_ in CONVOLUTIONS.values()
        )
        # Pixels in [-1, 1] to the scale that AlexNet was trained on.
        self.register_buffer("mean", torch.tensor([-0.030, -0.088, -0.188])[:, None, None], persistent=False)
        self.register_buffer("std", torch.tensor([0.458, 0.448, 0.450])[:, None, None], persistent=False)
        own = self.state_dict()
        self.load_state_dict({name: _weight(weights, name, own[name], source) for name in own})
        self.requires_grad_(False).eval()

    def forward(self, a: Tensor, b: Tensor) -> Tensor:
        """Distances (B,) of pictures a and b, (B, 3, h, w) in [-1, 1]."""
        levels = zip(self.heads, self._taps(a), self._taps(b), strict=True)
        return torch.stack([head((x - y) ** 2).mean(dim=(1, 2, 3)) for head, x, y in levels]).sum(0)

    @torch.no_grad()
    def distance(self, a: np.ndarray, b: np.ndarray) -> float:
        """Distance of two uint8 pictures (h, w, 3), both sides at least 31 pixels. ValueError otherwise."""
        if a.shape != b.shape:
            raise ValueError(f"pictures {a.shape} and {b.shape} differ in shape")
        if a.dtype != np.uint8 or b.dtype != np.uint8 or a.ndim != 3 or a.shape[2] != 3:
            raise ValueError(f"LPIPS takes uint8 (h, w, 3), not {a.dtype} {a.shape} and {b.dtype} {b.shape}")
        if min(a.shape[:2]) < SMALLEST_SIDE:
            raise ValueError(f"pictures {a.shape} are smaller than {SMALLEST_SIDE} pixels, LPIPS' least")
        return self(self._signed(a), self._signed(b)).item()

    def _signed(self, picture: np.ndarray) -> Tensor:
        pixels = torch.tensor(picture, device=self.mean.device).permute(2, 0, 1)[None]
        return pixels.float() / 127.5 - 1

    def _taps(self, image: Tensor) -> list[Tensor]:
        """Outputs of the five convolutions, every pixel's channels scaled to length 1."""
        taps = []
        x = (image - self.mean) / self.std
        for index in CONVOLUTIONS:
            if index in POOLED_BEFORE:
                x = functional.max_pool2d(x, kernel_size=3, stride=2)
            x = torch.relu(self.features[index](x))
            taps.append(x / (x.norm(dim=1, keepdim=True) + 1e-10))
        return taps


def find_lpips(path: Path | None = None) -> LPIPS | None:
    """LPIPS from `path`, else the file that $CROSSRAY_LPIPS names, else the packages torchvision and lpips.

    None where there is none of these: the caller then says that LPIPS is left out. Never downloads anything.
    CrossrayError if a named file is absent, damaged or incomplete: what was asked for is not left out
    quietly.
    """
    named = path or os.environ.get(VARIABLE)
    if named:
        return read_lpips(Path(named))
    weights = _package_weights()
    return LPIPS(weights, "the packages torchvision and lpips") if weights else None


def read_lpips(path: Path) -> LPIPS:
    """LPIPS from a .npz or .safetensors file. CrossrayError, naming file and key, if it does not hold it."""
    if not path.is_file():
        raise CrossrayError(f"no LPIPS weights at {path}; correct the path, or unset {VARIABLE} to go without LPIPS")
    try:
        if path.suffix == ".safetensors":
            weights = load_file(path)
        else:
            with np.load(path, allow_pickle=False) as arrays:
                weights = {name: torch.from_numpy(arrays[name]) for name in arrays.files}
    except Exception as error:  # zipfile, zlib, numpy and safetensors each raise what they like on a damaged file
        raise CrossrayError(f"{path} is no readable .npz or .safetensors file of weights: {error}") from error
    return LPIPS(weights, str(path))


def _weight(weights: Mapping[str, Tensor], name: str, like: Tensor, source: str) -> Tensor:
    key = f"lin{name.split('.')[1]}.model.1.weight" if name.startswith("heads.") else name
    if key not in weights:
        raise CrossrayError(f"{source} lacks the LPIPS weight {key}")
    value = weights[key]
    if value.shape != like.shape:
        raise CrossrayError(f"{source}: {key} has shape {tuple(value.shape)}, AlexNet LPIPS needs {tuple(like.shape)}")
    if not value.isfinite().all():
        raise CrossrayError(f"{source}: {key} holds a value that is not finite")
    return value


def _package_weights() -> dict[str, Tensor] | None:
    try:
        lpips = importlib.import_module("lpips")
        torchvision = importlib.import_module("torchvision")
    except (ImportError, RuntimeError):  # RuntimeError: a torchvision that was built for another torch
        return None
    url = torchvision.models.AlexNet_Weights.IMAGENET1K_V1.url
    if not (Path(torch.hub.get_dir()) / "checkpoints" / Path(url).name).is_file():
        return None
    state = lpips.LPIPS(net="alex", verbose=False).state_dict()
    # The package cuts `features` into slices: net.slice2.3.weight is features.3.weight.
    return {f"features.{k.split('.', 2)[2]}" if k.startswith("net.") else k: v for k, v in state.items()}
