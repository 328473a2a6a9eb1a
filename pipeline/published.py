"""Numbers that others have published, as data (published.yaml): they stand beside ours, never mixed with them."""

from __future__ import annotations

from functools import cache
from importlib.resources import files
from typing import Any

import yaml

Scores = dict[str, dict[str, float]]  # scene -> metric -> value
TIMES = "times"  # the one key of the file that is not a table of scores


def published_tables() -> dict[str, dict[str, Scores]]:
    """Table -> row -> scene -> metric -> value. PSNR in dB; a table's name ends with the downscale of its photos."""
    return {name: table for name, table in everything().items() if name != TIMES}


def published_times() -> dict[str, dict[str, dict[str, float]]]:
    """`inference` and `training` -> method -> column -> value: seconds an image of one (`single`) or many (`multiple`)
    images of a view at R/4 and R/2; epochs, iterations an epoch, and minutes."""
    return everything()[TIMES]


@cache
def everything() -> dict[str, Any]:
    """The file."""
    return yaml.safe_load(files("pipeline").joinpath("published.yaml").read_text())
