"""Photos and masks as arrays of 8 bits: whatever a file holds in, lossless PNGs out."""

from __future__ import annotations

import io

import numpy as np
from PIL import Image, UnidentifiedImageError
from PIL.TiffImagePlugin import TiffImageFile

from pipeline.manifest import ShardError
from pipeline.scene import ScenePhoto

LANCZOS, BILINEAR = Image.Resampling.LANCZOS, Image.Resampling.BILINEAR
Image.init()
# Not EPS, for which Pillow would run a program.
READ = ("JPEG", "PNG", "TIFF", "WEBP", "GIF", "BMP", "PPM", "JPEG2000", "AVIF")
FORMATS = tuple(name for name in READ if name in Image.OPEN)
ORIENTATION = 0x0112
TURN_BACK = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_90,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_270,
}
ACROSS = {Image.Transpose.TRANSPOSE, Image.Transpose.ROTATE_90, Image.Transpose.TRANSVERSE, Image.Transpose.ROTATE_270}
KINDS = {"1": "grayscale", "L": "grayscale", "LA": "grayscale with alpha", "RGBA": "RGB with alpha", "P": "palette"}


def decode_photo(data: bytes, photo: ScenePhoto) -> np.ndarray:
    """The photo as uint8 RGB (h, w, 3), as stored: EXIF orientation is ignored, as COLMAP does; alpha is
    dropped.

    Raises:
        ShardError: damaged, of a kind that we do not read, or not of its camera's size.
    """
    where = f"photo {photo.name}"
    try:
        with Image.open(io.BytesIO(data), formats=FORMATS) as image:
            size = stored_size(image)
            if size != (photo.width, photo.height):
                raise ShardError(
                    f"{where} has {size[0]} x {size[1]} pixels and its camera {photo.width} x "
                    f"{photo.height}: use the photos that the model was made from"
                )
            return to_rgb(image, where)
    except ShardError:
        raise
    except Exception as error:  # Pillow's decoders raise whatever they meet: OSError, RuntimeError, AttributeError, ...
        raise ShardError(
            f"{where} cannot be read ({reason(error)}): replace it, or take it out of the split table"
        ) from error


def reason(error: Exception) -> str:
    """What Pillow found wrong with a file."""
    return "no picture, or cut off at its start" if isinstance(error, UnidentifiedImageError) else str(error)


def conversion(data: bytes) -> str | None:
    """What a photo is that `decode_photo` has to convert, such as CMYK; None for 8-bit RGB."""
    with Image.open(io.BytesIO(data), formats=FORMATS) as image:
        if image.mode.startswith("I;16"):
            return "16-bit grayscale"
        kind = KINDS.get(image.mode, image.mode)
        if bits(image, data) == 16:
            return f"16-bit {kind}"
        return None if image.mode == "RGB" else kind


def bits(image: Image.Image, data: bytes) -> int:
    """Of a channel in the file, where Pillow has made 8 of 16 by itself."""
    if image.format == "PNG":
        return data[24]
    return max(image.tag_v2.get(258, (8,))) if isinstance(image, TiffImageFile) else 8


def decode_mask(data: bytes, photo: ScenePhoto) -> np.ndarray:
    """The mask as uint8 (h, w), in whatever size it is stored."""
    where = f"the mask of photo {photo.name}"
    try:
        with Image.open(io.BytesIO(data), formats=FORMATS) as image:
            if not same_aspect(image.size, (photo.width, photo.height)):
                raise ShardError(
                    f"{where} has {image.width} x {image.height} pixels, which is not the shape of the photo's "
                    f"{photo.width} x {photo.height}: make it again"
                )
            if image.mode.startswith("I;16"):
                return _to_8_bits(image)
            return np.asarray(image.convert("L"))
    except ShardError:
        raise
    except Exception as error:  # as above
        raise ShardError(f"{where} cannot be read ({reason(error)}): make it again, or remove it") from error


def same_aspect(a: tuple[int, int], b: tuple[int, int]) -> bool:
    """Whether sizes (width, height) are one shape, but for rounding a side by up to a pixel."""
    return abs(a[0] * b[1] - a[1] * b[0]) <= max(b) + max(a)


def to_rgb(image: Image.Image, where: str) -> np.ndarray:
    """uint8 (h, w, 3) of any 8- or 16-bit picture, as it is stored; gray is repeated."""
    turn = turn_back(image)
    if turn is not None:
        return np.asarray(Image.fromarray(_to_rgb(image, where)).transpose(turn))
    return _to_rgb(image, where)


def stored_size(image: Image.Image) -> tuple[int, int]:
    """Width and height of the pixels in the file of an image that is not loaded yet."""
    return image.size[::-1] if turn_back(image) in ACROSS else image.size


def turn_back(image: Image.Image) -> Image.Transpose | None:
    """What undoes the turn by EXIF orientation that Pillow does when it loads a TIFF, and only a TIFF."""
    return TURN_BACK.get(image.tag_v2.get(ORIENTATION, 1)) if isinstance(image, TiffImageFile) else None


def _to_rgb(image: Image.Image, where: str) -> np.ndarray:
    if image.mode.startswith("I;16"):
        return np.repeat(_to_8_bits(image)[..., None], 3, axis=2)
    if image.mode in ("I", "F"):
        raise ShardError(f"{where} has 32 bits a pixel, whose range is not known: convert it to 8 or 16 bits")
    return np.asarray(image.convert("RGB"))


def _to_8_bits(image: Image.Image) -> np.ndarray:
    """16 bits to 8: 65535 = 257 * 255, rounded."""
    return ((np.asarray(image).astype(np.uint32) + 128) // 257).astype(np.uint8)


def resize(pixels: np.ndarray, size: tuple[int, int], method: Image.Resampling) -> np.ndarray:
    """Resample uint8 (h, w[, 3]) to `size` = (width, height); the same size keeps the pixels."""
    if size == (pixels.shape[1], pixels.shape[0]):
        return pixels
    return np.asarray(Image.fromarray(pixels).resize(size, method))


def encode_png(pixels: np.ndarray) -> bytes:
    """Lossless, and nothing but pixels: a fresh image carries no profile and no time of the source."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG", compress_level=4)
    return buffer.getvalue()


def decode_png(data: bytes, shape: tuple[int, ...] | None = None) -> np.ndarray:
    """uint8 (h, w, 3) or (h, w) of a PNG of ours.

    Raises:
        ValueError: not a PNG, or not of `shape`.
    """
    try:
        image = Image.open(io.BytesIO(data), formats=["PNG"])
    except Image.DecompressionBombError as error:
        raise ValueError(str(error)) from None
    with image:
        if image.mode not in ("RGB", "L"):
            raise ValueError(f"a PNG of mode {image.mode}")
        if shape is not None and image.size != shape[1::-1]:  # before it takes memory
            raise ValueError(f"a picture of {image.width} x {image.height} pixels, not {shape[1]} x {shape[0]}")
        pixels = np.asarray(image)
    if shape is not None and pixels.shape != shape:
        raise ValueError(f"a picture of shape {pixels.shape}, not {shape}")
    return pixels
