"""Shards -> photos in memory: verified and decoded once a node into one file, which every rank maps
read-only.

The cache is two files named by the manifest's content hash: `<hash>.pixels`, the uint8 pixels of all pictures
back to back, and `<hash>.json`, the index, written last. Any step of training reaches any photo, no rank
copies one, and nothing is left behind in shared memory when a rank is killed.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal

import numpy as np
from filelock import FileLock
from pydantic import BaseModel, ConfigDict, ValidationError

from pipeline.errors import CrossrayError
from pipeline.files import atomic_file, atomic_write
from pipeline.manifest import CameraRecord, Manifest, read_manifest
from pipeline.shards import check_sha256, check_sizes, read_shard


class CacheError(CrossrayError):
    """The photo cache cannot be written."""


class Picture(BaseModel):
    """Where a picture lies in the pixel file."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    start: int
    shape: tuple[int, ...]


class CachedPhoto(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    camera: CameraRecord
    image: Picture
    reference: Picture
    mask: Picture | None


class CacheIndex(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    layout: Literal[1] = 1
    content_hash: str
    bytes: int  # of the pixel file
    photos: tuple[CachedPhoto, ...]


class Photos:
    """The photos of a scene, of all splits, in the order of their names; pictures are read-only views of a
    mapped file.
    """

    def __init__(self, manifest: Manifest, index: CacheIndex, pixels: np.ndarray) -> None:
        self.manifest = manifest
        self.records = tuple(photo.camera for photo in index.photos)
        self._photos = index.photos
        self._pixels = pixels

    def __len__(self) -> int:
        return len(self.records)

    def image(self, i: int) -> np.ndarray:
        """Photo `i`: uint8 (h, w, 3)."""
        return self._view(self._photos[i].image)

    def reference(self, i: int) -> np.ndarray:
        """The appearance reference of photo `i`, from the original: uint8 (h', w', 3)."""
        return self._view(self._photos[i].reference)

    def mask(self, i: int) -> np.ndarray | None:
        """Transient probability * 255 of photo `i`: uint8 (h, w), or None where the shards have no mask."""
        mask = self._photos[i].mask
        return None if mask is None else self._view(mask)

    def indices(self, split: str) -> tuple[int, ...]:
        """Which photos are of `split`: "train", "val" or "test"."""
        return tuple(i for i, record in enumerate(self.records) if record.split == split)

    def sizes(self, split: str) -> np.ndarray:
        """(N, 2) int64: (height, width) of the photos of `split`, as `pipeline.patches` wants them."""
        sizes = [(self.records[i].height, self.records[i].width) for i in self.indices(split)]
        return np.array(sizes, np.int64).reshape(-1, 2)

    def _view(self, picture: Picture) -> np.ndarray:
        size = int(np.prod(picture.shape))
        return self._pixels[picture.start : picture.start + size].reshape(picture.shape)


def open_photos(shards: Path, cache: Path | None = None) -> Photos:
    """Map the photos of the shard folder `shards`, through the cache folder `cache`.

    The cache is `$CROSSRAY_CACHE` by default, else `~/.cache/crossray`. The first call on a node verifies
    every shard and decodes it, while other processes wait; later calls take milliseconds and compare the
    manifest's hash and the shards' lengths.

    Raises:
        ShardError: shards that are damaged, missing or extra.
        CacheError: the cache folder cannot be written, or its disk is full.
    """
    manifest = read_manifest(shards)
    check_sizes(shards, manifest)
    folder = Path(cache or os.environ.get("CROSSRAY_CACHE") or Path.home() / ".cache" / "crossray")
    pixels = folder / f"{manifest.content_hash}.pixels"
    index = read_index(pixels, manifest)
    if index is None:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with FileLock(pixels.with_suffix(".lock")):
                index = read_index(pixels, manifest) or build_cache(Path(shards), manifest, pixels)
        except OSError as error:
            raise CacheError(
                f"the photo cache in {folder} cannot be written ({error.strerror or error}): set "
                "CROSSRAY_CACHE to a folder with room for the decoded photos"
            ) from error
    return Photos(manifest, index, np.memmap(pixels, np.uint8, mode="r").view(np.ndarray))


def read_index(pixels: Path, manifest: Manifest) -> CacheIndex | None:
    """The index of a cache that is whole and of this manifest, else None."""
    try:
        index = CacheIndex.model_validate_json(pixels.with_suffix(".json").read_bytes())
        whole = index.content_hash == manifest.content_hash and index.bytes == pixels.stat().st_size
    except (OSError, ValidationError):
        return None
    return index if whole else None


def build_cache(shards: Path, manifest: Manifest, pixels: Path) -> CacheIndex:
    """Verify and decode all shards into the file `pixels`, photo by photo, then write the index beside it."""
    for stray in pixels.parent.glob(f".{pixels.stem}.*.tmp"):
        stray.unlink()
    photos = []
    with atomic_file(pixels) as file:

        def append(picture: np.ndarray) -> Picture:
            start = file.tell()
            file.write(picture.tobytes())
            return Picture(start=start, shape=picture.shape)

        for shard in manifest.shards:
            check_sha256(shards, shard)
            for sample in read_shard(shards, shard):
                mask = None if sample.mask is None else append(sample.mask)
                photos.append(
                    CachedPhoto(
                        camera=sample.camera,
                        image=append(sample.rgb),
                        reference=append(sample.reference),
                        mask=mask,
                    )
                )
        size = file.tell()
    index = CacheIndex(content_hash=manifest.content_hash, bytes=size, photos=tuple(photos))
    atomic_write(pixels.with_suffix(".json"), index.model_dump_json())
    return index
