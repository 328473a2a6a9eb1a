"""The figure of rays of a run: which rays share their statistics in a step of training (the paper's illustration of
grid sampling), drawn with the plan that the run was trained by.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from model.cameras import patch_grid
from pipeline.errors import CrossrayError
from pipeline.figures.choose import photo_shown, sources_of, title
from pipeline.figures.sheet import Composed, Panel, Row, Sheet
from pipeline.painter import Painter
from pipeline.patches import Patch, patches

PATCHES = 5


def grids(painter: Painter, columns: int | None = None) -> Composed:
    """Patches (columns) of the last step of training and, where it has fewer, of those before: the photo with its
    k x k rays, and the pixels of these rays, which is what the step saw of it.

    Raises:
        CrossrayError: no step was trained.
    """
    scene, k = painter.photos, painter.job.patch.size
    train = scene.indices("train")
    drawn = [found for _, found in zip(range(columns or PATCHES), drawn_patches(painter), strict=False)]
    if not drawn or painter.checkpoint.meta["seconds"] == 0:
        raise CrossrayError(
            f"{painter.run}: this checkpoint was not trained here for a single step: no rays were drawn"
        )
    tops, bottoms, listed = [], [], []
    for step, rank, patch in drawn:
        index = train[patch.photo]
        photo = scene.image(index)
        height, width = photo.shape[:2]
        rows, cols, _ = (t.numpy() for t in patch_grid(k, patch.scale, patch.offset_h, patch.offset_w, height, width))
        shown = photo_shown(scene, index)
        dots = (np.stack([cols, rows], axis=1) + 0.5) * (shown.shape[1] / width, shown.shape[0] / height) - 0.5
        tops.append(Panel(shown, title(scene, index), dots))
        bottoms.append(Panel(photo[rows, cols].reshape(k, k, 3), stretched=tops[-1].ratio))
        listed.append({"step": step, "rank": rank, **sources_of(scene, [index])[0], "scale": patch.scale})
    rows_ = (Row("rays", tuple(tops)), Row(f"{k} × {k} rays", tuple(bottoms)))
    caption = (
        f"Rays that share their statistics: {k} x {k} on a grid that spans "
        f"{100 * painter.job.patch.min_scale:.0f} to {100 * painter.job.patch.max_scale:.0f} % of the sides of a "
        "training photo. Below: what the step saw of the photo."
    )
    return Composed(Sheet(rows_, even=False), caption, {"rays": k * k, "patches": listed})


def drawn_patches(painter: Painter) -> Iterator[tuple[int, int, Patch]]:
    """Step, rank and patch: those of the step that made the checkpoint, then those of the steps before."""
    meta, sizes = painter.checkpoint.meta, painter.photos.sizes("train")
    for step in range(painter.checkpoint.step - 1, -1, -1):
        for rank in range(meta["world_size"]):
            for patch in patches(
                painter.job.patch,
                sizes,
                step=step,
                rank=rank,
                world_size=meta["world_size"],
                steps_per_epoch=meta["steps_per_epoch"],
            ):
                yield step, rank, patch
