"""torchvision's networks and weights. torchvision is an optional extra, imported when one of its networks is asked for.

Weights are the default ones of torchvision, in torch's hub cache (`$TORCH_HOME`), downloaded by torch when absent. A
file there is used only if it has the SHA-256 that its name promises, and is read without running code from it.
"""

from __future__ import annotations

from pathlib import Path
from pickle import UnpicklingError
from typing import Any

from pipeline.files import sha256_of
from pipeline.segmentation.base import SegmenterError, SegmenterRecord
from pipeline.segmentation.classes import channels_of

INSTALL = "pip install -e '.[torchvision]'"


def import_torchvision() -> Any:
    """The module.

    Raises:
        SegmenterError: torchvision is not installed, or not the one for this torch.
    """
    try:
        import torchvision
    except ImportError as error:
        raise SegmenterError(f"this segmenter needs torchvision ({error}): {INSTALL}") from error
    except Exception as error:  # RuntimeError: operator torchvision::nms does not exist, or whatever else
        import torch

        raise SegmenterError(
            f"torchvision is installed and does not run beside torch {torch.__version__} ({error}): install both from "
            f"one index, in versions that belong together: {INSTALL}"
        ) from error
    return torchvision


def describe(name: str, builder: str, transient: tuple[str, ...]) -> SegmenterRecord:
    """The record of torchvision's network `builder`, its weights at hand."""
    import torch

    weights = default_weights(builder)
    classes = channels_of(transient, weights.meta["categories"], builder)
    file = fetch_weights(weights.url)
    return SegmenterRecord(
        name=name,
        file=file.name,
        sha256=sha256_of(file),
        classes=classes,
        versions={"torch": torch.__version__, "torchvision": import_torchvision().__version__},
    )


def default_weights(builder: str) -> Any:
    """torchvision's default weights for `builder`: their address, classes and preprocessing."""
    return import_torchvision().models.get_model_weights(builder).DEFAULT


def load_network(builder: str, **sizes: Any) -> Any:
    """The network with its default weights, for inference on the CPU."""
    import torch

    weights = default_weights(builder)
    network = import_torchvision().models.get_model(
        builder, weights=None, weights_backbone=None, num_classes=len(weights.meta["categories"]), **sizes
    )
    file = fetch_weights(weights.url)
    try:
        # Not weights.get_state_dict: it would run what is pickled in the file.
        network.load_state_dict(torch.load(file, map_location="cpu", weights_only=True))
    except (RuntimeError, UnpicklingError) as error:
        raise SegmenterError(f"{file} cannot be read as the weights of {builder} ({error}); remove it") from error
    return network.eval()


def fetch_weights(url: str) -> Path:
    """The file of weights in torch's hub cache.

    Raises:
        SegmenterError: it cannot be downloaded, or the one there is damaged.
    """
    import torch

    file = Path(torch.hub.get_dir()) / "checkpoints" / url.rsplit("/", 1)[-1]
    promised = file.stem.rsplit("-", 1)[-1]  # torchvision's names end with the first digits of the SHA-256
    if not file.is_file():
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            torch.hub.download_url_to_file(url, str(file), promised, progress=False)
        except (OSError, RuntimeError) as error:
            raise SegmenterError(
                f"{url} cannot be downloaded ({error}); download it where that works, and put it at {file}"
            ) from error
    if not sha256_of(file).startswith(promised):
        raise SegmenterError(f"{file} is damaged: its SHA-256 does not begin with {promised}; remove it")
    return file
