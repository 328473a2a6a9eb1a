"""The figure of depth: what a model knows of a view's geometry."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.errors import CrossrayError
from pipeline.figures.choose import camera_shown, lender_of, sources_of, title, views_of
from pipeline.figures.sheet import Bar, Composed, Panel, Row, Sheet, coloured
from pipeline.painter import Painter
from pipeline.progress import shown

VIEWS = 5
SOLID = 0.5  # of accumulation: of less there is no depth to speak of
CUT = (1, 99)  # percentiles of all depths between which colours span
ACCUMULATION = Bar("", 0, 1, "gray")


def depth(
    painter: Painter, photos: Sequence[str] = (), views: Sequence[str] = (), columns: int | None = None
) -> Composed:
    """Views (columns): the picture, the mean distance along the ray of what is seen, in scene units, and how much of
    the ray's light comes from the scene.

    Args:
        photos: one, whose appearance all views have; by default the first training photo.
        views: by default `columns` test views.

    Raises:
        CrossrayError: more than one photo.
    """
    if len(photos) > 1:
        raise CrossrayError(f"{len(photos)} photos: --photos names the one whose appearance all views have")
    scene = painter.photos
    chosen = views_of(scene, views, columns or VIEWS)
    lender = lender_of(painter, photos[0] if photos else scene.records[scene.indices("train")[0]].name)
    cameras = [camera_shown(scene, index) for index in chosen]
    pictures = list(shown(map, "rendering views")(lambda camera: painter.picture(camera, lender.F), cameras))
    solid = [picture.accumulation >= SOLID for picture in pictures]
    bar = depth_bar([picture.depth[there] for picture, there in zip(pictures, solid, strict=True)])
    titles = [title(scene, index) for index in chosen]
    rows = (
        Row("rendered", tuple(Panel(p.rgb, name) for p, name in zip(pictures, titles, strict=True))),
        Row("depth", tuple(Panel(coloured(p.depth, bar, s)) for p, s in zip(pictures, solid, strict=True)), bar),
        Row("accumulation", tuple(Panel(coloured(p.accumulation, ACCUMULATION)) for p in pictures), ACCUMULATION),
    )
    caption = (
        f"Depth. From the top: views, rendered; the mean distance along each ray of what it meets, in scene units, "
        f"white where less than {SOLID:g} of its light comes from the scene; that share itself."
    )
    about = {
        "views": sources_of(scene, chosen),
        "appearances": [lender.source] if painter.has_appearance else [],
        "depth_range": [bar.low, bar.high],
    }
    return Composed(Sheet(rows, even=False), caption, about)


def depth_bar(depths: Sequence[np.ndarray]) -> Bar:
    """One scale for depths (n,) of several views: from percentile to percentile CUT of all together."""
    together = np.concatenate(depths)
    low, high = (float(v) for v in np.percentile(together, CUT)) if len(together) else (0.0, 1.0)
    return Bar("scene units", low, high if high > low else low + 1, "viridis")
