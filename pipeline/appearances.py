"""Appearances by name, and the statistics with which one appearance colours every view alike.

One appearance over many views (a film, a baked field) needs one set of content statistics for all of them, or colours
flicker. A model of the policy `running` has it. For `view` and `patch` it is the average over at most VIEWS training
views, evenly chosen, of the statistics of a 32 x 32 grid of each view's rays: what such a model uses in a typical view.
"""

from __future__ import annotations

import difflib
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from model.appearance.crossray import ContentStatistics
from model.scene_model import SceneModel
from pipeline.errors import CrossrayError
from pipeline.files import sha256_of
from pipeline.manifest import ShardError
from pipeline.photos import Photos
from pipeline.pictures import FORMATS, reason, to_rgb
from pipeline.render import check_reference, grid_statistics, read_appearance, statistics_of, training_appearance
from pipeline.truth import reduced

VIEWS = 32  # training views over which statistics are averaged, at most


class Read(NamedTuple):
    """An appearance, and where it comes from."""

    F: Tensor | None  # F^a (1, C, g, g) or (1, CODE); None where the model reads no appearance
    source: dict[str, str]  # photo, sha256 of its file


def find_appearance(model: SceneModel, photos: Photos, name: str) -> Read:
    """The appearance of a photo of the scene by its name, or else of an image file.

    Raises:
        CrossrayError: there is neither, it is no image that we read, it is too small, or the model learned its
            appearances (NeRF-W) and this is no training photo.
    """
    records = {record.name: index for index, record in enumerate(photos.records)}
    train = [photos.records[i].name for i in photos.indices("train")]
    if model.embedding is not None and name not in train and (name in records or is_file(name)):
        raise CrossrayError(
            f"{name}: model.appearance: embedding has learned the appearances of the training photos and reads no "
            f"other; name one of these, for example {train[0]!r}"
        )
    if name in records:
        index = records[name]
        picture, sha256 = photos.reference(index), photos.records[index].source_sha256
        if model.embedding is not None:
            return Read(training_appearance(model, photos, index), {"photo": name, "sha256": sha256})
    elif is_file(name):
        picture, sha256 = read_picture(Path(name)), sha256_of(Path(name))
        picture = reduced(picture, photos.manifest.reference_downscale)
    else:
        close = difflib.get_close_matches(name, records, n=1, cutoff=0.5)
        guess = f"; did you mean {close[0]!r}?" if close else f" (the first is {photos.records[0].name!r})"
        raise CrossrayError(f"{name}: neither an image file nor the name of a photo of the scene{guess}")
    check_reference(model.spec, picture, name)
    return Read(read_appearance(model, picture), {"photo": Path(name).name, "sha256": sha256})


def is_file(name: str) -> bool:
    """Whether a file has this name; what no file could be called has none."""
    try:
        return Path(name).is_file()
    except (OSError, ValueError):
        return False


def read_picture(path: Path) -> np.ndarray:
    """An image file as uint8 RGB (h, w, 3), as the shards read photos: EXIF orientation is ignored, alpha dropped.

    Raises:
        CrossrayError: it cannot be read.
    """
    try:
        with Image.open(path, formats=FORMATS) as image:
            return to_rgb(image, str(path))
    except ShardError:
        raise
    except Exception as error:  # Pillow's decoders raise whatever they meet
        raise CrossrayError(f"{path}: cannot be read as an image ({reason(error)})") from error


def fixed_statistics(model: SceneModel, photos: Photos) -> tuple[ContentStatistics | None, str]:
    """Content statistics for all views, and in words how they were taken; None for a model without a transform."""
    if model.transform is None:
        return None, "none: the model has no transform"
    policy, train = model.spec.statistics, photos.indices("train")
    if policy == "running":
        return statistics_of(model, None), "running averages of the training"
    chosen = train[:: -(-len(train) // VIEWS)]
    found = [grid_statistics(model, photos.records[index]) for index in chosen]
    mean, gram = (torch.stack(parts).mean(0) for parts in zip(*found, strict=True))
    return ContentStatistics(mean, gram), f"{policy}: average over {len(chosen)} training views"
