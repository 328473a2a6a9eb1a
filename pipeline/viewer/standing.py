"""What one browser sees: the picture that it wishes for, coarse at first, then sharper while the camera stands.

Work is done in slices of SLICE seconds, so that several browsers share one thread and a finer picture is given up as
soon as its camera has moved on. A coarse picture is always finished, as nothing would be seen in motion otherwise. The
features of the last view are kept: another appearance of it is only painted. The exception are models whose field reads
the appearance: they render anew.

Memory: the features of one picture of full size, and of the coarser one before it.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from math import log2, sqrt
from threading import Lock
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from pipeline.judge import depth_picture
from pipeline.render import View
from pipeline.views.camera import Camera, resized

What = Literal["rgb", "depth", "accumulation"]

COARSE = 1 / 10  # seconds that a picture in motion may take, so that with its way to the browser about 8 come a second
SLICE = 1 / 20  # seconds of work between two looks at what is wished for
SMALLEST = 24  # pixels of a coarse picture's short side, at least


class Paints(Protocol):
    """Of `pipeline.painter.Painter`, what a standing view needs."""

    @property
    def coded(self) -> bool: ...
    def view(self, camera: Camera, F: Tensor | None = None) -> View: ...
    def paint(self, view: View, appearances: list[Tensor | None]) -> list[np.ndarray]: ...


class Pace:
    """Rays a second, as measured of late."""

    def __init__(self, rays_a_second: float = 20_000.0) -> None:
        self.rays_a_second = rays_a_second

    def measured(self, rays: int, seconds: float) -> None:
        """Take in one measurement; old ones fade."""
        self.rays_a_second += 0.3 * (rays / max(seconds, 1e-6) - self.rays_a_second)

    def rays(self, seconds: float) -> int:
        """How many are rendered in some seconds; one at least."""
        return max(1, int(self.rays_a_second * seconds))


class Wish(NamedTuple):
    """What is to be seen."""

    camera: Camera  # of full size
    F: Tensor | None  # the appearance; None where the model has none
    what: What = "rgb"


class Shown(NamedTuple):
    """A picture that is ready."""

    pixels: np.ndarray  # uint8 (h, w, 3)
    step: int  # 0 is the coarsest
    steps: int  # in all, until the picture is sharp


@dataclass
class Drawing:
    """A view on its way: rendered from the top, some rows at a time."""

    wish: Wish
    steps: list[Camera]
    step: int
    parts: list[View] = field(default_factory=list)
    rows: int = 0

    @property
    def camera(self) -> Camera:
        return self.steps[self.step]

    def draw(self, painter: Paints, pace: Pace) -> None:
        """Render the next rows: about SLICE seconds, one row at least."""
        camera = self.camera
        rows = min(max(1, pace.rays(SLICE) // camera.width), camera.height - self.rows)
        begun = time.perf_counter()
        part = painter.view(replace(camera, height=rows, cy=camera.cy - self.rows), self.wish.F)
        float(part.accumulation[-1, -1])  # a GPU has finished once a number of its is known
        self.parts.append(part)
        pace.measured(rows * camera.width, time.perf_counter() - begun)
        self.rows += rows

    def view(self) -> View:
        """All rows together; the parts are given away, so that they do not stay in memory."""
        parts, self.parts = self.parts, []
        features = torch.cat([part.features for part in parts])
        depth = torch.cat([part.depth for part in parts])
        return View(
            (self.camera.height, self.camera.width), features, depth, torch.cat([p.accumulation for p in parts])
        )


class Kept(NamedTuple):
    """The finest view so far, and where it stands."""

    view: View
    wish: Wish
    steps: list[Camera]
    step: int


class Standing:
    """One browser's view. Any thread may `ask`; one thread calls `advance`."""

    def __init__(self, painter: Paints, pace: Pace, wish: Wish) -> None:
        self.painter, self.pace, self.wish = painter, pace, wish
        self._lock = Lock()
        self._drawing: Drawing | None = None
        self._kept: Kept | None = None
        self._painted: Wish | None = None

    def ask(self, **changes: Any) -> None:
        """Change fields of the wish. The latest wins: there is no queue."""
        with self._lock:
            self.wish = self.wish._replace(**changes)

    @property
    def idle(self) -> bool:
        """Whether what is shown is all that is wished for."""
        kept, wish = self._kept, self.wish
        return (
            kept is not None
            and self._same_view(kept.wish, wish)
            and kept.step == len(kept.steps) - 1
            and same_paint(self._painted, wish)
        )

    def advance(self) -> Shown | None:
        """A slice of work; the picture, where one is ready."""
        wish = self.wish
        kept, drawing = self._kept, self._drawing
        if drawing is not None and drawing.step > 0 and not self._same_view(drawing.wish, wish):
            drawing = self._drawing = None
        if kept is not None and self._same_view(kept.wish, wish) and not same_paint(self._painted, wish):
            return self._paint(kept, wish)
        if drawing is None:
            if self.idle:
                return None
            drawing = self._drawing = self._begin(wish)
        drawing.draw(self.painter, self.pace)
        if drawing.rows < drawing.camera.height:
            return None
        self._drawing = None
        self._kept = Kept(drawing.view(), drawing.wish, drawing.steps, drawing.step)
        return self._paint(self._kept, wish)

    def _begin(self, wish: Wish) -> Drawing:
        """The next finer step of the kept view, or the first one of another."""
        kept = self._kept
        if kept is None or not self._same_view(kept.wish, wish):
            return Drawing(wish, steps_to(wish.camera, self.pace.rays(COARSE)), 0)
        return Drawing(wish, kept.steps, kept.step + 1)

    def _paint(self, kept: Kept, wish: Wish) -> Shown:
        self._painted = wish
        return Shown(picture_of(self.painter, kept.view, wish), kept.step, len(kept.steps))

    def _same_view(self, a: Wish, b: Wish) -> bool:
        """Whether two wishes are met by the features of one view."""
        return a.camera == b.camera and (not self.painter.coded or a.F is b.F)


def same_paint(a: Wish | None, b: Wish) -> bool:
    """Whether two wishes about one view are met by one picture."""
    return a is not None and a.F is b.F and a.what == b.what


def steps_to(camera: Camera, rays: int) -> list[Camera]:
    """The camera at growing sizes: one of about `rays` pixels, then sides about twice as long each time, up to its own:
    so all steps before the last are about a third of its work.
    """
    least = sqrt(rays / (camera.width * camera.height))
    least = min(1.0, max(least, SMALLEST / min(camera.width, camera.height)))
    count = round(-log2(least))
    shares = [least ** ((count - i) / count) for i in range(count)]
    small = [resized(camera, max(1, round(camera.width * s)), max(1, round(camera.height * s))) for s in shares]
    return [*small, camera]


def picture_of(painter: Paints, view: View, wish: Wish) -> np.ndarray:
    """uint8 (h, w, 3) of a view: its colours, its depth (near is bright), or its accumulation."""
    if wish.what == "rgb":
        return painter.paint(view, [wish.F])[0]
    if wish.what == "depth":
        grey = depth_picture(view)
    else:
        grey = (view.accumulation.clamp(0, 1) * 255).round().byte().cpu().numpy()
    return np.repeat(grey[..., None], 3, axis=2)
