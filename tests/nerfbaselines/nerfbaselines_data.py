"""Data sets of nerfbaselines, a method that is small enough for a test, and LPIPS without a download."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from tiny_run import HASH, MLP
from torch import nn

from pipeline.config import flatten

TINY: dict[str, Any] = {
    "model": {"hash": HASH, "mlp": MLP},
    "patch": {"size": 8, "photos": 2},
    "scene": {"reference_downscale": 1},
    "train": {"epochs": 2, "steps_per_epoch": 6, "warmup_steps": 0, "precision": "float32"},
}
CHANNELS = 8


def tiny(**over: Any) -> dict[str, Any]:
    """Overrides of a tiny method by dotted keys, and `over`, where a double underscore stands for a dot."""
    named = {key.replace("__", "."): value for key, value in over.items()}
    channels = {} if "method" in over else {"model.channels": CHANNELS}
    return flatten(TINY) | channels | named


def load(folder: Path, split: str) -> Any:
    """The photos of a split, through nerfbaselines' own loader."""
    from nerfbaselines.datasets import load_dataset

    from pipeline.nerfbaselines.method import Crossray

    info = Crossray.get_method_info()
    return load_dataset(
        folder,
        split=split,
        features=info["required_features"],
        supported_camera_models=info["supported_camera_models"],
    )


def only(dataset: Any, index: int) -> Any:
    """The data set of one of its photos."""
    from nerfbaselines.datasets import dataset_index_select

    return dataset_index_select(dataset, [index])


ALEXNET = """
import torch
from torch import nn


def alexnet(pretrained=True):
    with torch.random.fork_rng():
        torch.manual_seed(0)
        features = nn.Sequential(
            nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2),
            nn.Conv2d(64, 192, 5, 1, 2), nn.ReLU(), nn.MaxPool2d(3, 2),
            nn.Conv2d(192, 384, 3, 1, 1), nn.ReLU(),
            nn.Conv2d(384, 256, 3, 1, 1), nn.ReLU(),
            nn.Conv2d(256, 256, 3, 1, 1), nn.ReLU(), nn.MaxPool2d(3, 2),
        )
    return nn.ModuleDict({"features": features})
"""


def write_torchvision(folder: Path) -> Path:
    """A `torchvision` whose AlexNet has random weights, always the same: nerfbaselines' LPIPS then needs no download,
    and is still computed by its own code with its own heads."""
    package = folder / "torchvision"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package / "models.py").write_text(ALEXNET)
    return folder


def write_lpips(path: Path) -> Path:
    """The same network for Crossray's LPIPS: those random convolutions and nerfbaselines' heads."""
    import nerfbaselines
    from safetensors.torch import save_file

    scope: dict[str, Any] = {}
    exec(ALEXNET, scope)
    network: nn.Module = scope["alexnet"]()
    weights = Path(nerfbaselines.__file__).parent / "_lpips_weights" / "alex-0.1.pth"
    heads = torch.load(weights, map_location="cpu", weights_only=True)
    save_file({k: v.detach().contiguous() for k, v in {**network.state_dict(), **heads}.items()}, path)
    return path
