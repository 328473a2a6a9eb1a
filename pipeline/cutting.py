"""Cutting a scene into shards (their format: pipeline/manifest.py).

The same scene and settings give the same bytes, whoever cuts and in however many processes. `write_shard` is pure and
idempotent; a shard is cut again if a source photo has changed.
"""

from __future__ import annotations

import hashlib
import logging
import re
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Literal, Protocol, TypeVar

import numpy as np
from filelock import FileLock
from pydantic import ValidationError

from pipeline.files import atomic_file, atomic_write, resolved, sha256_of
from pipeline.manifest import (
    FORMAT_VERSION,
    MANIFEST,
    CameraRecord,
    Manifest,
    PlanRecord,
    SceneRecord,
    ShardError,
    ShardInfo,
    Sidecar,
    digest,
    read_manifest,
    shard_file,
    sidecar_file,
)
from pipeline.patches import PatchPlan, steps_per_epoch
from pipeline.pictures import BILINEAR, LANCZOS, conversion, decode_mask, decode_photo, encode_png, resize
from pipeline.scene import Scene, ScenePhoto, fingerprint, is_file, read_scene

SHARD_FILE = re.compile(r"shard-[0-9]{6}\.(tar|json)")
PHOTOS_A_SHARD = 16  # at most
SHARDS_AT_LEAST = 8  # where there are as many photos: every core gets several

log = logging.getLogger("crossray")

T = TypeVar("T")


class Mapper(Protocol):
    """Gives the result of `work` for each spec, in any order (`pipeline.launch.tasks`)."""

    def __call__(self, work: Callable[[ShardSpec], T], specs: list[ShardSpec], /) -> Iterable[T]: ...


@dataclass(frozen=True)
class ShardSpec:
    """All that one task needs to write one shard."""

    folder: Path
    index: int
    photos: tuple[ScenePhoto, ...]
    masks: tuple[Path | None, ...]
    downscale: int
    reference_downscale: int


def cut_shards(
    scene_root: Path,
    out: Path,
    *,
    downscale: int,
    reference_downscale: int = 8,
    plan: PatchPlan,
    mapper: Mapper,
    on_bad_photo: Literal["refuse", "drop"] = "refuse",
) -> Manifest:
    """Cut the scene into `out` and return the manifest; what is there already and right is only verified.

    An interrupted run leaves no half-written file, and the next one finishes it.

    Args:
        on_bad_photo: photos whose file is missing, damaged, or not of its camera's size end it with an error, or are
            left out with a warning; to find them, each photo is then decoded once more.

    Raises:
        SceneError: the scene cannot be read.
        ShardError: `out` holds something else, or shards of other settings; or a photo cannot be used.
    """
    if downscale < 1 or reference_downscale < 1:
        raise ShardError(f"downscale {downscale}, reference_downscale {reference_downscale}: both must be at least 1")
    dropping = on_bad_photo == "drop"
    source = fingerprint(scene_root)
    scene = read_scene(scene_root, drop_missing=dropping)
    out = resolved(out)
    try:
        out.mkdir(parents=True, exist_ok=True)
        lock = FileLock(out / ".lock")
        lock.acquire()
    except OSError as error:
        raise ShardError(f"{out} cannot be written ({error.strerror}): choose another folder") from error
    try:
        if dropping:
            scene = without_bad_photos(scene, out, downscale, reference_downscale, mapper)
        return _cut(scene, source, out, downscale, reference_downscale, plan, mapper)
    finally:
        lock.release()


def specs_of(scene: Scene, out: Path, downscale: int, reference_downscale: int) -> list[ShardSpec]:
    """A task's work each.

    Raises:
        ShardError: two photos share a mask.
    """
    owners: dict[Path, str] = {}
    for photo in scene.photos:
        mask = mask_path(scene, photo)
        if mask and owners.setdefault(mask, photo.name) != photo.name:
            raise ShardError(f"{mask} would be the mask of {owners[mask]} and of {photo.name}: rename one of them")
    return [
        ShardSpec(out, i, photos, tuple(mask_path(scene, p) for p in photos), downscale, reference_downscale)
        for i, photos in enumerate(split_photos(scene.photos))
    ]


def without_bad_photos(scene: Scene, out: Path, downscale: int, reference_downscale: int, mapper: Mapper) -> Scene:
    """The scene as it is without the photos that cannot be used, which the log counts and names."""
    bad = dict(scene.dropped)
    for found in mapper(find_bad_photos, specs_of(scene, out, downscale, reference_downscale)):
        bad |= found
    if not bad:
        return scene
    reasons = "\n  ".join(reason for _, reason in sorted(bad.items()))
    log.warning("scene.on_bad_photo: drop: %d photos of %s are left out:\n  %s", len(bad), scene.root, reasons)
    return read_scene(scene.root, without=bad)


def find_bad_photos(spec: ShardSpec) -> dict[str, str]:
    """Photo -> what is wrong with it, of those of a shard that cannot be used."""
    bad = {}
    for photo in spec.photos:
        try:
            source = _read_source(photo.path)
            camera_record(photo, spec.downscale, source)
            decode_photo(source, photo)
        except ShardError as error:
            bad[photo.name] = str(error)
    return bad


def _cut(
    scene: Scene, source: str, out: Path, downscale: int, reference_downscale: int, plan: PatchPlan, mapper: Mapper
) -> Manifest:
    summary = scene_record(scene)
    _refuse_other_content(out, summary, downscale, reference_downscale)
    for stray in out.glob(".*.tmp"):
        stray.unlink()
    specs = specs_of(scene, out, downscale, reference_downscale)
    shards = sorted(mapper(write_shard, specs), key=lambda info: info.file)
    converted = sum((Counter(info.converted) for info in shards), Counter())
    if converted:
        kinds = ", ".join(f"{count} {kind}" for kind, count in sorted(converted.items()))
        log.info("photos that were converted to 8-bit RGB: %s", kinds)
    wanted = {name for info in shards for name in (info.file, sidecar_file(info.file))}
    for path in out.iterdir():
        if SHARD_FILE.fullmatch(path.name) and path.name not in wanted:
            path.unlink()
    if fingerprint(scene.root) != source:
        raise ShardError(f"{scene.root}: the model or the split table changed while shards were cut; cut again")
    manifest = Manifest(
        scene=summary,
        downscale=downscale,
        reference_downscale=reference_downscale,
        masks=masks_hash(scene),
        shards=tuple(shards),
        patch_plan=plan_record(plan, scene, downscale),
        libraries=library_versions(),
        dropped=scene.dropped,
        source=source,
        splits=dict(sorted(Counter(photo.split for photo in scene.photos).items())),
    )
    text = manifest.model_dump_json(indent=1) + "\n"
    path = out / MANIFEST
    if not path.exists() or path.read_text() != text:
        atomic_write(path, text)
    return manifest


def write_shard(spec: ShardSpec) -> ShardInfo:
    """Write one shard and its sidecar, unless they are there and of the same sources and settings.

    Raises:
        ShardError: a photo or mask that is damaged, or not of its camera's size.
    """
    sources = [_read_source(photo.path) for photo in spec.photos]
    masks = [_read_source(path) if path else None for path in spec.masks]
    cameras = [camera_record(p, spec.downscale, data) for p, data in zip(spec.photos, sources, strict=True)]
    identity = digest(
        {
            "format_version": FORMAT_VERSION,
            "libraries": library_versions(),
            "downscale": spec.downscale,
            "reference_downscale": spec.reference_downscale,
            "cameras": [camera.model_dump(mode="json") for camera in cameras],
            "masks": [None if m is None else hashlib.sha256(m).hexdigest() for m in masks],
        }
    )
    path = spec.folder / shard_file(spec.index)
    sidecar_path = path.with_name(sidecar_file(path.name))
    done = _finished(path, sidecar_path, identity)
    if done:
        return done
    try:
        with atomic_file(path) as file:
            stream = _Hashed(file)
            _write_tar(stream, spec, cameras, sources, masks)
        keys = tuple(camera.key for camera in cameras)
        converted = Counter(filter(None, map(conversion, sources)))
        info = ShardInfo(
            file=path.name,
            sha256=stream.sha256.hexdigest(),
            bytes=stream.bytes,
            keys=keys,
            converted=dict(sorted(converted.items())),
        )
        atomic_write(sidecar_path, Sidecar(identity=identity, shard=info).model_dump_json(indent=1) + "\n")
    except OSError as error:
        raise ShardError(f"{path} cannot be written ({error.strerror or error}): is the disk full?") from error
    return info


def _write_tar(
    stream: _Hashed,
    spec: ShardSpec,
    cameras: list[CameraRecord],
    sources: list[bytes],
    masks: list[bytes | None],
) -> None:
    from webdataset import TarWriter

    with TarWriter(stream, mtime=0, encoder=False, compress=False) as tar:
        for photo, camera, source, mask in zip(spec.photos, cameras, sources, masks, strict=True):
            original = decode_photo(source, photo)
            size = (camera.width, camera.height)
            members = {
                "rgb.png": encode_png(resize(original, size, LANCZOS)),
                "ref.png": encode_png(resize(original, reference_size(photo, spec), LANCZOS)),
                "camera.json": camera.model_dump_json().encode(),
            }
            if mask is not None:
                members["mask.png"] = encode_png(resize(decode_mask(mask, photo), size, BILINEAR))
            tar.write({"__key__": photo.key, **members})


def camera_record(photo: ScenePhoto, downscale: int, source: bytes) -> CameraRecord:
    """The camera of the downscaled photo: fx and cx scale by w'/w and fy and cy by h'/h, with w' = floor(w /
    downscale).
    """
    width, height = photo.width // downscale, photo.height // downscale
    if not width or not height:
        raise ShardError(f"photo {photo.name} ({photo.width} x {photo.height}) is too small for downscale {downscale}")
    fx, fy, cx, cy = photo.intrinsics
    sx, sy = width / photo.width, height / photo.height
    return CameraRecord(
        key=photo.key,
        name=photo.name,
        image_id=photo.image_id,
        split=photo.split,
        width=width,
        height=height,
        fx=fx * sx,
        fy=fy * sy,
        cx=cx * sx,
        cy=cy * sy,
        c2w=photo.c2w.tolist(),
        near=photo.near,
        far=photo.far,
        source_sha256=hashlib.sha256(source).hexdigest(),
    )


def split_photos(photos: tuple[ScenePhoto, ...]) -> list[tuple[ScenePhoto, ...]]:
    """Contiguous shards of about equal count; how many depends on the number of photos alone."""
    n = len(photos)
    count = max(-(-n // PHOTOS_A_SHARD), min(n, SHARDS_AT_LEAST))
    return [photos[n * i // count : n * (i + 1) // count] for i in range(count)]


def mask_path(scene: Scene, photo: ScenePhoto) -> Path | None:
    """The mask of a photo, None where there is none; a photo's name cannot lead out of the folder of masks."""
    path = (scene.root / "masks" / photo.name).with_suffix(".png")
    return path if ".." not in path.relative_to(scene.root).parts and is_file(path) else None


def masks_hash(scene: Scene) -> str | None:
    """SHA-256 of which photos have which masks; None where none has."""
    found = {photo.key: path for photo in scene.photos if (path := mask_path(scene, photo))}
    return digest({key: sha256_of(path) for key, path in found.items()}) if found else None


def scene_record(scene: Scene) -> SceneRecord:
    photos = [
        [p.name, p.key, p.image_id, p.split, p.width, p.height, p.intrinsics, p.c2w.tolist(), p.near, p.far]
        for p in scene.photos
    ]
    box = scene.box.tolist()
    return SceneRecord(
        name=scene.name,
        hash=digest([scene.scale, box, photos]),
        scale=scene.scale,
        box=box,
        num_points=scene.num_points,
    )


def plan_record(plan: PatchPlan, scene: Scene, downscale: int) -> PlanRecord:
    train = [p for p in scene.photos if p.split == "train"]
    sizes = np.array([(p.height // downscale, p.width // downscale) for p in train])
    return PlanRecord(
        plan=plan,
        train_pixels=int(sizes.prod(axis=1).sum()),
        steps_per_epoch={str(world): steps_per_epoch(plan, sizes, world) for world in (1, 8)},
    )


def library_versions() -> dict[str, str]:
    """Versions of what encodes the bytes."""
    from importlib.metadata import version

    return {name: version(name) for name in ("numpy", "pillow", "webdataset")}


def _read_source(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise ShardError(f"{path.name} cannot be read: {error}") from error


def _finished(path: Path, sidecar_path: Path, identity: str) -> ShardInfo | None:
    """The shard, if both files are whole and cut from what `identity` says."""
    try:
        sidecar = Sidecar.model_validate_json(sidecar_path.read_bytes())
        whole = (
            sidecar.identity == identity
            and sidecar.shard.file == path.name
            and sidecar.shard.bytes == path.stat().st_size
            and sidecar.shard.sha256 == sha256_of(path)
        )
    except (OSError, ValidationError):
        return None
    return sidecar.shard if whole else None


def _refuse_other_content(out: Path, scene: SceneRecord, downscale: int, reference_downscale: int) -> None:
    """Raise ShardError where `out` is not ours to write into."""
    for path in sorted(out.iterdir()):
        if not (path.name == MANIFEST or path.name.startswith(".") or SHARD_FILE.fullmatch(path.name)):
            raise ShardError(f"{out} holds {path.name}, which is no shard: choose an empty folder")
    if not (out / MANIFEST).exists():
        return
    old = read_manifest(out)
    differences = [
        f"{what} {was}, not {wanted}"
        for what, was, wanted in (
            ("scene", old.scene.name, scene.name),
            ("downscale", old.downscale, downscale),
            ("reference_downscale", old.reference_downscale, reference_downscale),
        )
        if was != wanted
    ]
    if not differences and old.scene != scene:
        differences = ["other photos, splits or cameras of the same scene"]
    if differences:
        raise ShardError(f"{out} holds shards of {'; '.join(differences)}: cut into another folder")


class _Hashed:
    """A binary stream that hashes and counts what passes through it."""

    def __init__(self, file: BinaryIO) -> None:
        self.file, self.sha256, self.bytes = file, hashlib.sha256(), 0

    def write(self, data: bytes) -> int:
        self.sha256.update(data)
        self.bytes += len(data)
        return self.file.write(data)


def reference_size(photo: ScenePhoto, spec: ShardSpec) -> tuple[int, int]:
    return max(1, photo.width // spec.reference_downscale), max(1, photo.height // spec.reference_downscale)
