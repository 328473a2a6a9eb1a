"""Looking at every file of a folder: a photo, or rejected with a reason.

Accepted photos appear in the workspace under safe names: 8-bit RGB or gray JPEGs and PNGs as links to the files
themselves, all else (CMYK, 16 bits, alpha, other formats, photos that their EXIF orientation turns) as RGB PNGs.
"""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageOps, UnidentifiedImageError

from pipeline.errors import CrossrayError
from pipeline.files import atomic_file
from pipeline.pictures import FORMATS, ORIENTATION, TURN_BACK, conversion, reason, to_rgb

Mapper = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]

LEAST_SIDE = 64  # pixels: below, SIFT's largest scales do not fit and no camera is found
LEAST_PHOTOS = 3
AS_THEY_ARE = {"JPEG": ".jpg", "PNG": ".png"}
HEIC = (b"heic", b"heix", b"hevc", b"mif1", b"msf1")


@dataclass(frozen=True)
class File:
    """One file to look at, and where in the workspace its photo goes (without a suffix)."""

    source: Path
    name: str  # relative to the folder
    target: Path
    upright: bool = True  # turn it as its EXIF orientation says


@dataclass(frozen=True)
class Seen:
    """What a file turned out to be: a photo of `size` (width, height) in `photo`, or rejected with `reason`."""

    name: str
    reason: str = ""
    photo: str = ""
    size: tuple[int, int] = (0, 0)
    pixels_sha256: str = ""


def list_files(folder: Path) -> list[Path]:
    """Files of a folder and of the folders in it, sorted by name; hidden ones are left out.

    Raises:
        CrossrayError: it is no folder, or holds no file.
    """
    if not folder.is_dir():
        what = "is a file" if folder.exists() else "does not exist"
        raise CrossrayError(f"{folder} {what}; ingest takes a folder of photos, or a transforms.json")
    files = sorted(
        p
        for p in folder.rglob("*")
        if p.is_file() and not any(part.startswith(".") for part in p.relative_to(folder).parts)
    )
    if not files:
        raise CrossrayError(f"{folder} holds no file; put the photos of one place into it, {LEAST_PHOTOS} at least")
    return files


def safe_stems(names: list[str]) -> list[str]:
    """A distinct stem of letters, digits, - and _ for each name, for COLMAP's lists are split at blanks."""
    wanted = [re.sub(r"[^A-Za-z0-9_-]+", "_", str(Path(n).with_suffix(""))) for n in names]
    count = Counter(s.lower() for s in wanted)
    taken = {s.lower() for s in wanted if count[s.lower()] == 1}
    stems = []
    for stem in wanted:
        chosen, number = stem, 1
        while count[stem.lower()] > 1 and chosen.lower() in taken:
            chosen, number = f"{stem}-{number}", number + 1
        taken.add(chosen.lower())
        stems.append(chosen)
    return stems


def look_at(root: Path, files: list[Path], photos: Path, mapper: Mapper, *, upright: bool = True) -> list[Seen]:
    """Look at each of `files` under `root`, and put the photos into the folder `photos`; in the order of `files`.

    Args:
        upright: turn photos as their EXIF orientation says; not where poses of the stored pixels are known.

    Raises:
        CrossrayError: fewer than three different photos.
    """
    photos.mkdir(parents=True, exist_ok=True)
    names = [p.relative_to(root).as_posix() if p.is_relative_to(root) else p.as_posix() for p in files]
    stems = safe_stems(names)
    specs = [File(p.resolve(), n, photos / s, upright) for p, n, s in zip(files, names, stems, strict=True)]
    found = {seen.name: seen for seen in mapper(look, specs)}
    seen = without_duplicates([found[n] for n in names])
    kept = {s.photo for s in seen if s.photo}
    for path in photos.iterdir():
        if path.name not in kept:
            path.unlink()
    if len(kept) < LEAST_PHOTOS:
        reasons = "".join(f"\n  {s.name}: {s.reason}" for s in [s for s in seen if s.reason][:10])
        raise CrossrayError(
            f"{root}: {len(kept)} usable photos of {len(seen)} files; poses need at least {LEAST_PHOTOS} different "
            f"photos that overlap{', better 20 and more' if kept else ''}{reasons}"
        )
    return seen


def without_duplicates(seen: list[Seen]) -> list[Seen]:
    """The same, where only the first of several files with the same pixels stays a photo."""
    first: dict[str, str] = {}
    result = []
    for s in seen:
        if s.photo and first.setdefault(s.pixels_sha256, s.name) != s.name:
            s = Seen(s.name, f"the same picture as {first[s.pixels_sha256]}")
        result.append(s)
    return result


def look(file: File) -> Seen:
    """Look at one file, and put its photo in place. Damage is told, never raised."""
    try:
        data = file.source.read_bytes()
    except OSError as error:
        return Seen(file.name, f"cannot be read ({error.strerror or error})")
    try:
        with Image.open(_stream(data), formats=FORMATS) as image:
            kind = image.format or ""
            photo = upright(image) if file.upright else image
            if min(image.size) < LEAST_SIDE:
                return Seen(
                    file.name,
                    f"{image.width} x {image.height} pixels: too small, features need {LEAST_SIDE} pixels a side",
                )
            exif, turned = photo.info.get("exif"), photo is not image
            pixels = to_rgb(photo, "it")
    except UnidentifiedImageError:
        return Seen(file.name, what_else(data))
    except Exception as error:  # Pillow's decoders raise whatever they meet
        return Seen(file.name, f"damaged or cut short ({reason(error)})")
    as_it_is = not turned and kind in AS_THEY_ARE and conversion(data) in (None, "grayscale") and _is_8_bit(data)
    target = file.target.with_name(file.target.name + (AS_THEY_ARE[kind] if as_it_is else ".png"))
    if as_it_is:
        target.unlink(missing_ok=True)
        target.symlink_to(file.source)
    else:
        with atomic_file(target) as stream:
            Image.fromarray(pixels).save(stream, "PNG", compress_level=1, **({"exif": exif} if exif else {}))
    digest = hashlib.sha256(repr(pixels.shape).encode() + np.ascontiguousarray(pixels).tobytes()).hexdigest()
    return Seen(file.name, photo=target.name, size=(pixels.shape[1], pixels.shape[0]), pixels_sha256=digest)


def upright(image: Image.Image) -> Image.Image:
    """The photo turned as its EXIF orientation says; the image itself where that says nothing, or nonsense."""
    try:
        turned = image.getexif().get(ORIENTATION) in TURN_BACK
        return ImageOps.exif_transpose(image) if turned else image
    except Exception:  # Pillow's EXIF reader raises whatever it meets; damaged pixels are told where they are read
        return image


def what_else(data: bytes) -> str:
    """What a file is that Pillow does not know."""
    if not data:
        return "an empty file"
    if data[4:8] == b"ftyp" and data[8:12] in HEIC:
        return "a HEIC photo, which is not read: convert it to JPEG"
    if data[:5] == b"%PDF-":
        return "a PDF, not a photo"
    return "not a photo, or cut off at its start"


def _is_8_bit(data: bytes) -> bool:
    with Image.open(_stream(data), formats=FORMATS) as image:
        return image.mode in ("RGB", "L")


def _stream(data: bytes) -> Any:
    import io

    return io.BytesIO(data)
