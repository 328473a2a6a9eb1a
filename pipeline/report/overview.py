"""Pictures of several views as one PNG, a column each kind."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np

from pipeline.files import atomic_file

matplotlib.use("Agg")
from matplotlib import pyplot as plt


def write_overview(path: Path, rows: list[dict[str, np.ndarray]]) -> Path:
    """Named uint8 pictures, (h, w, 3) or (h, w), the same names in each row; returns the file's path."""
    titles = list(rows[0])
    shape = (len(rows), len(titles))
    figure, axes = plt.subplots(*shape, figsize=(2 * shape[1], 1.6 * shape[0]), squeeze=False, layout="constrained")
    for row, line in zip(rows, axes, strict=True):
        for axis, picture in zip(line, row.values(), strict=True):
            axis.imshow(picture, cmap="gray", vmin=0, vmax=255)
            axis.set_axis_off()
    for axis, title in zip(axes[0], titles, strict=True):
        axis.set_title(title, fontsize=10)
    with atomic_file(path) as file:
        figure.savefig(file, format="png", dpi=100)
    plt.close(figure)
    return path
