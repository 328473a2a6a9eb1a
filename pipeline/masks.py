"""Fixed masks: one transient-probability PNG a photo, from a segmenter that has never seen the scene.

`SCENE/masks/<photo name with suffix .png>` is uint8, 255 = certainly transient, with the photo's aspect and at most
its size; cutting shards takes it from there (`pipeline.cutting.mask_path`), and `model.transient: fixed` trains with
it. Which things count as transient: `pipeline/segmentation/classes.py`.

Every mask carries a `MaskRecord` as a PNG text: what it was made from, and what its pixels were. So an interrupted
run goes on where it was, a changed photo gets a new mask, and a mask that somebody else made or corrected by hand is
never overwritten without being told to. `masks.json`, written last, lists them all with their segmenter.
"""

from __future__ import annotations

import hashlib
import io
import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from filelock import FileLock
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from pipeline.errors import CrossrayError
from pipeline.files import atomic_write, resolved, sha256_of
from pipeline.manifest import ShardError
from pipeline.pictures import decode_photo
from pipeline.scene import Scene, ScenePhoto, read_scene
from pipeline.segmentation import Segmenter, SegmenterRecord

RECORD = "masks.json"
TEXT = "crossray"  # keyword of the PNG text that holds a MaskRecord
BATCH = 4  # photos a task
SHOWN = 5  # names of a list
LIKELY = (0.0005, 0.5)  # mean share masked; outside, something is probably wrong

Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Mapper = Callable[[Callable[["MaskBatch"], "list[MaskResult]"], list["MaskBatch"]], Iterable["list[MaskResult]"]]

log = logging.getLogger("crossray")


class MaskError(CrossrayError):
    """Masks that cannot be made, or that are not ours to replace."""


class BadPhotoError(MaskError):
    """A photo that cannot be read."""


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class MaskRecord(_Record):
    """What a mask was made from, and what it is."""

    segmenter: Sha256  # SegmenterRecord.identity
    photo: Sha256  # of the photo's file
    source: Sha256 | None  # of the file that the segmenter read for this photo, where it reads one
    pixels: Sha256  # of the mask's pixels
    share: float = Field(ge=0, le=1)  # mean of the mask


class SceneMasks(_Record):
    """`masks.json`."""

    format_version: Literal[1] = 1
    segmenter: SegmenterRecord
    photos: dict[str, MaskRecord]


@dataclass(frozen=True)
class MaskBatch:
    """All that one task needs to mask a few photos."""

    folder: Path
    segmenter: Segmenter
    identity: str
    photos: tuple[ScenePhoto, ...]
    replace: bool
    drop_bad: bool


@dataclass(frozen=True)
class MaskResult:
    """One mask that is there now."""

    photo: str
    record: MaskRecord
    made: bool  # not found, but made


@dataclass(frozen=True)
class Masked:
    """What `make_masks` did."""

    folder: Path
    photos: int
    made: int  # the others were there
    share: float  # mean over photos of the share that is masked


def make_masks(
    scene_root: Path,
    segmenter: Segmenter,
    *,
    replace: bool = False,
    on_bad_photo: Literal["refuse", "drop"] = "refuse",
    mapper: Mapper,
) -> Masked:
    """Mask the photos of a scene; masks that are there, of the same segmenter and photo, are kept.

    `mapper(mask_photos, batches)` yields the results in any order (`pipeline.launch.tasks`). `replace` allows to
    overwrite masks of another segmenter, and masks that were not made here. `on_bad_photo` is as for shards: photos
    that cannot be read may go without a mask.

    Raises:
        SceneError: the scene cannot be read.
        SegmenterError: the segmenter cannot be used, or not for these photos.
        MaskError: `masks/` cannot be written, or holds what is not ours to replace; or a photo cannot be read.
    """
    drop_bad = on_bad_photo == "drop"
    scene = read_scene(scene_root, drop_missing=drop_bad)
    folder = scene.root / "masks"
    check_names(folder, scene.photos)
    described = segmenter.describe(scene.photos)
    try:
        folder.mkdir(exist_ok=True)
        lock = FileLock(folder / ".lock")
        lock.acquire()
    except OSError as error:
        raise MaskError(
            f"{folder} cannot be written ({error.strerror}): masks lie beside the photos; copy the scene to where "
            "you can write"
        ) from error
    try:
        return _make(scene, folder, segmenter, described, replace, drop_bad, mapper)
    finally:
        lock.release()


def _make(
    scene: Scene,
    folder: Path,
    segmenter: Segmenter,
    described: SegmenterRecord,
    replace: bool,
    drop_bad: bool,
    mapper: Mapper,
) -> Masked:
    for stray in folder.rglob(".*.tmp"):
        stray.unlink()
    check_folder(folder, scene.photos, described, replace)
    before = read_masks(folder)
    if before and before.segmenter.identity != described.identity:
        (folder / RECORD).unlink()  # it would describe masks that are about to go
    batches = [
        MaskBatch(folder, segmenter, described.identity, scene.photos[k : k + BATCH], replace, drop_bad)
        for k in range(0, len(scene.photos), BATCH)
    ]
    results = [result for batch in mapper(mask_photos, batches) for result in batch]
    results.sort(key=lambda result: result.photo)
    bad = len(scene.photos) + len(scene.dropped) - len(results)
    if bad:
        log.warning("%d photos of %s cannot be read and have no mask", bad, scene.root)
    if not results:
        raise MaskError(f"{scene.root}: no photo is left to be masked")
    made = sum(result.made for result in results)
    now = SceneMasks(segmenter=described, photos={result.photo: result.record for result in results})
    if made or before is None or before.photos != now.photos or before.segmenter.identity != described.identity:
        atomic_write(folder / RECORD, now.model_dump_json(indent=1) + "\n")
    share = float(np.mean([result.record.share for result in results]))
    if not LIKELY[0] <= share <= LIKELY[1]:
        log.warning("%.2f %% of the photos is masked; look at %s: white is what is transient", 100 * share, folder)
    return Masked(folder, len(results), made, share)


def mask_photos(batch: MaskBatch) -> list[MaskResult]:
    """Mask the photos of a batch, each unless its mask is there.

    Raises:
        MaskError: a photo that cannot be read (unless those are dropped), or a mask that was changed since we made it.
    """
    results = []
    for photo in batch.photos:
        try:
            results.append(mask_photo(batch, photo))
        except BadPhotoError:
            if not batch.drop_bad:
                raise
    return results


def mask_photo(batch: MaskBatch, photo: ScenePhoto) -> MaskResult:
    path = mask_file(batch.folder, photo)
    try:
        data = photo.path.read_bytes()
        source = batch.segmenter.source(photo)
        made_from = {
            "segmenter": batch.identity,
            "photo": hashlib.sha256(data).hexdigest(),
            "source": sha256_of(source) if source else None,
        }
    except OSError as error:
        raise MaskError(f"photo {photo.name} cannot be masked: {error}") from error
    if source and resolved(source) == resolved(path):
        raise MaskError(f"{path} is what is to be copied there; masks that are there are used as they are")
    there = read_mask(path)
    if there and there[0].pixels == pixels_hash(there[1]):
        if made_from == there[0].model_dump(include=set(made_from)):
            return MaskResult(photo.name, there[0], made=False)
    elif path.exists() and not batch.replace:
        raise MaskError(
            f"{path} was changed since `crossray mask` made it; move it away, or let --replace make it again"
        )
    try:
        pixels = decode_photo(data, photo)
    except ShardError as error:
        raise BadPhotoError(str(error)) from error
    mask = to_mask(batch.segmenter.probability(photo, pixels), (photo.width, photo.height))
    record = MaskRecord(**made_from, pixels=pixels_hash(mask), share=float(mask.mean() / 255))
    try:
        atomic_write(path, encode_mask(mask, record))
    except OSError as error:
        raise MaskError(f"{path} cannot be written ({error.strerror or error}): is the disk full?") from error
    return MaskResult(photo.name, record, made=True)


# What may be written


def mask_file(folder: Path, photo: ScenePhoto) -> Path:
    return (folder / photo.name).with_suffix(".png")


def check_names(folder: Path, photos: Sequence[ScenePhoto]) -> None:
    """MaskError where a photo's mask would lie outside `folder`, or two photos would share one."""
    owners: dict[Path, str] = {}
    for photo in photos:
        path = mask_file(folder, photo)
        if ".." in Path(photo.name).parts or not resolved(path.parent).is_relative_to(resolved(folder)):
            raise MaskError(f"photo {photo.name}: its mask would lie outside {folder}; rename the photo in the model")
        owner = owners.setdefault(path, photo.name)
        if owner != photo.name:
            raise MaskError(f"photos {owner} and {photo.name} would share the mask {path.name}; rename one")


def check_folder(folder: Path, photos: Sequence[ScenePhoto], segmenter: SegmenterRecord, replace: bool) -> None:
    """MaskError where `folder` holds files that are not ours to keep or to replace.

    Our own masks of photos that the scene no longer has may stay: nobody reads them.
    """
    wanted = {mask_file(folder, photo) for photo in photos}
    strangers, others = [], []
    for path in sorted(folder.rglob("*")):
        if path not in wanted and (path.is_dir() or path.name.startswith(".") or path == folder / RECORD):
            continue
        record = read_record(path)
        if path not in wanted and record is None:
            name = path.relative_to(folder)
            raise MaskError(f"{folder} holds {name}, which is no mask of a photo of this scene: move it away")
        if path in wanted and record is None:
            strangers.append(path)
        if path in wanted and record and record.segmenter != segmenter.identity:
            others.append(path)
    if replace:
        return
    if others:
        raise MaskError(
            f"{folder} holds {len(others)} masks of another segmenter ({names(others, folder)}): --replace makes them "
            "again, with this one"
        )
    if strangers:
        raise MaskError(
            f"{folder} holds masks that `crossray mask` did not make ({names(strangers, folder)}): they are used as "
            "they are, so there may be nothing to do; --replace makes them again"
        )
    if (folder / RECORD).exists() and read_masks(folder) is None:
        raise MaskError(f"{folder / RECORD} is damaged or not ours: move it away, or let --replace write it again")


def names(paths: list[Path], folder: Path) -> str:
    shown = ", ".join(str(path.relative_to(folder)) for path in paths[:SHOWN])
    return f"{shown} and {len(paths) - SHOWN} more" if len(paths) > SHOWN else shown


# Files


def read_masks(folder: Path) -> SceneMasks | None:
    """`masks.json` of a folder; None where it is absent, damaged or another's."""
    try:
        return SceneMasks.model_validate_json((folder / RECORD).read_bytes())
    except (OSError, ValidationError):
        return None


def read_record(path: Path) -> MaskRecord | None:
    """The record that a mask carries; None where it is no mask of ours. Pixels are not looked at."""
    try:
        with Image.open(path, formats=["PNG"]) as image:
            return MaskRecord.model_validate_json(str(image.info.get(TEXT)))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None


def read_mask(path: Path) -> tuple[MaskRecord, np.ndarray] | None:
    """A mask of ours with its record; None where it is absent, damaged or another's."""
    record = read_record(path)
    try:
        with Image.open(path, formats=["PNG"]) as image:
            return (record, np.asarray(image)) if record else None
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None


def encode_mask(mask: np.ndarray, record: MaskRecord) -> bytes:
    text = PngInfo()
    text.add_text(TEXT, record.model_dump_json())
    buffer = io.BytesIO()
    Image.fromarray(mask).save(buffer, "PNG", pnginfo=text)
    return buffer.getvalue()


def pixels_hash(mask: np.ndarray) -> str:
    return hashlib.sha256(f"{mask.dtype} {mask.shape} ".encode() + mask.tobytes()).hexdigest()


def to_mask(probability: np.ndarray, photo_size: tuple[int, int]) -> np.ndarray:
    """Probability (h', w') in [0, 1], covering a photo of `photo_size` = (width, height), as uint8 with the photo's
    aspect: bilinear, its longer side that of the map or the photo's own, whichever is shorter.
    """
    long_side = max(photo_size)
    longest = min(max(probability.shape), long_side)
    width, height = (max(1, round(side * longest / long_side)) for side in photo_size)
    image = Image.fromarray(np.ascontiguousarray(probability, np.float32))
    if image.size != (width, height):
        image = image.resize((width, height), Image.Resampling.BILINEAR)
    return np.rint(np.clip(np.asarray(image), 0, 1) * 255).astype(np.uint8)
