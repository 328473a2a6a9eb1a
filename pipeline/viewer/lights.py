"""The appearances that a browser may choose: photos of the scene by name, or the bytes of a photo of its own.

What a browser sends is a name or bytes, and never a path on the server's disk.
"""

from __future__ import annotations

import tempfile
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image

from pipeline.appearances import Read
from pipeline.errors import CrossrayError
from pipeline.painter import Painter
from pipeline.pictures import FORMATS

LARGEST_FILE = 32 * 2**20  # bytes of a photo of one's own
LARGEST_PHOTO = 64_000_000  # its pixels: 192 MB decoded
THUMBNAIL = 96  # pixels of a thumbnail's long side


def names_of(painter: Painter) -> tuple[str, ...]:
    """Photos whose appearance can be taken: the training photos first; where appearances were learned, these alone."""
    photos = painter.photos
    learned = painter.model.embedding is not None
    others = () if learned else photos.indices("val") + photos.indices("test")
    return tuple(photos.records[i].name for i in photos.indices("train") + others)


def read_photo(painter: Painter, name: str) -> Read:
    """The appearance of a photo of the scene. CrossrayError: there is no such photo."""
    if name not in names_of(painter):
        raise CrossrayError(f"{name[:80]!r} is no photo of this scene")
    return painter.read(name)


def read_upload(painter: Painter, name: str, content: bytes) -> Read:
    """The appearance of a photo that a browser sent.

    Raises:
        CrossrayError: it is too large, no image that we read, or too small for the model; it says so by `name`.
    """
    check_upload(name, content)
    with tempfile.TemporaryDirectory(prefix="crossray-view-") as folder:
        file = Path(folder) / "photo"
        file.write_bytes(content)
        try:
            return painter.read(str(file))
        except CrossrayError as error:
            raise CrossrayError(str(error).replace(str(file), name)) from None


def check_upload(name: str, content: bytes) -> None:
    """CrossrayError where a file is larger than we read, or says of itself that it has too many pixels."""
    if len(content) > LARGEST_FILE:
        raise CrossrayError(too_large(name, len(content)))
    try:
        with Image.open(BytesIO(content), formats=FORMATS) as image:
            width, height = image.size
    except Exception:  # whatever Pillow's decoders raise: told where it is read
        return
    if width * height > LARGEST_PHOTO:
        raise CrossrayError(
            f"{name}: {width} x {height} pixels; at most {LARGEST_PHOTO / 1e6:.0f} million are read: take a smaller one"
        )


def too_large(name: str, size: int) -> str:
    """What to tell of a file that is too large."""
    return f"{name}: {size / 2**20:.0f} MiB; at most {LARGEST_FILE // 2**20} MiB are read: take a smaller one"


def plain_name(name: str) -> str:
    """What to call a file that a browser named: its last part, printable and short."""
    last = name.replace("\\", "/").rpartition("/")[2]
    return "".join(c for c in last if c.isprintable())[-60:] or "photo"


def thumbnail(photo: np.ndarray) -> np.ndarray:
    """A uint8 photo (h, w, 3), reduced to THUMBNAIL pixels on its long side at most."""
    image = Image.fromarray(photo)
    image.thumbnail((THUMBNAIL, THUMBNAIL))
    return np.asarray(image)


def jpeg(picture: np.ndarray, quality: int = 80) -> bytes:
    """A uint8 picture (h, w, 3) as a JPEG file."""
    buffer = BytesIO()
    Image.fromarray(picture).save(buffer, "JPEG", quality=quality)
    return buffer.getvalue()
