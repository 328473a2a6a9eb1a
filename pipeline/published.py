"""Numbers that others have published, as data (published.yaml): they stand beside ours, never mixed with them."""

from __future__ import annotations

from functools import cache
from importlib.resources import files

import yaml

Scores = dict[str, dict[str, float]]  # scene -> metric -> value


@cache
def published_tables() -> dict[str, dict[str, Scores]]:
    """Table -> row -> scene -> metric -> value. PSNR in dB; a table's name ends with the downscale of its photos."""
    return yaml.safe_load(files("pipeline").joinpath("published.yaml").read_text())
