"""Pictures for a page: made small, encoded, and counted, so that a page does not grow without bound."""

from __future__ import annotations

import base64
import io

import numpy as np
from PIL import Image

from pipeline.report.blocks import Picture

ROOM = 9_000_000  # characters of all pictures of a page, which is to stay under 10 MB
EXACT = 256 * 192  # pixels: smaller pictures are kept to the bit where that is asked for
QUALITY = 82


class Album:
    """The pictures of one page. `left_out` counts those for which there was no room."""

    def __init__(self, room: int = ROOM) -> None:
        self.room = room
        self.left_out = 0

    def add(self, picture: np.ndarray, alt: str, side: int, exact: bool = False) -> Picture:
        """A uint8 picture, (h, w, 3) or (h, w), with no side longer than `side` pixels.

        Args:
            alt: what it shows, for who cannot see it.
            exact: keep every pixel as it is, if the picture is small enough for that.
        """
        image = Image.fromarray(np.ascontiguousarray(picture))
        image.thumbnail((side, side), Image.Resampling.LANCZOS)
        buffer = io.BytesIO()
        exact = exact and image.width * image.height <= EXACT
        image.save(buffer, format="WEBP", lossless=exact, quality=QUALITY, method=4)
        source = f"data:image/webp;base64,{base64.b64encode(buffer.getvalue()).decode()}"
        if len(source) > self.room:
            self.left_out += 1
            return Picture("", image.width, image.height, alt)
        self.room -= len(source)
        return Picture(source, image.width, image.height, alt)

    @property
    def foot(self) -> str:
        """What the page says of pictures that are not on it."""
        if not self.left_out:
            return ""
        return f"{self.left_out} pictures were left out, to keep this page under 10 MB."
