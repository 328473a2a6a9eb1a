"""Scene -> webdataset shards: how a scene travels to the nodes that train on it, and the proof that it arrived.

A shard folder holds `shard-000000.tar`, ..., each with a sidecar `shard-000000.json`, and `manifest.json`,
written last: without it the folder is not complete. One sample a photo:

    <key>.rgb.png      the photo by LANCZOS at floor(w / downscale) x floor(h / downscale), lossless
    <key>.ref.png      the appearance reference: the *original* by LANCZOS at 1 / reference_downscale
    <key>.camera.json  a `CameraRecord`
    <key>.mask.png     transient probability * 255, as large as the rgb, where the scene has `masks/<photo>.png`

The same scene and settings give the same bytes, whoever cuts and in however many processes: nothing here
holds a time, a host name or an absolute path. `write_shard` is pure and idempotent; a shard is cut again if a
source photo has changed. Reading never trusts webdataset alone, which delivers 23 of 40 samples after one
flipped byte without a word.
"""

from __future__ import annotations

import hashlib
import io
import json
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, BinaryIO, Literal

import numpy as np
from filelock import FileLock
from PIL import Image
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, model_validator

from pipeline.errors import CrossrayError
from pipeline.files import atomic_file, atomic_write, sha256_of
from pipeline.patches import PatchPlan, steps_per_epoch
from pipeline.scene import Scene, ScenePhoto, read_scene

FORMAT_VERSION = 1
MANIFEST = "manifest.json"
SHARD_FILE = re.compile(r"shard-[0-9]{6}\.(tar|json)")
PHOTOS_A_SHARD = 16  # at most
SHARDS_AT_LEAST = 8  # where there are as many photos: every core gets several
LANCZOS, BILINEAR = Image.Resampling.LANCZOS, Image.Resampling.BILINEAR
REQUIRED, OPTIONAL = {"rgb.png", "ref.png", "camera.json"}, {"mask.png"}

Row = tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]
Corner = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Key = Annotated[str, Field(pattern=r"^[a-z0-9_-]+$")]
Mapper = Callable[[Callable[["ShardSpec"], "ShardInfo"], list["ShardSpec"]], Iterable["ShardInfo"]]


class ShardError(CrossrayError):
    """Shards that cannot be cut, or that are not what their manifest says."""


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class CameraRecord(_Record):
    """`<key>.camera.json`. Sizes and intrinsics are those of the downscaled photo; lengths are in scene
    units.
    """

    key: Key
    name: str
    image_id: int
    split: str = Field(pattern="^(train|val|test)$")
    width: int = Field(ge=1)
    height: int = Field(ge=1)
    fx: FiniteFloat
    fy: FiniteFloat
    cx: FiniteFloat
    cy: FiniteFloat
    c2w: tuple[Row, Row, Row]  # OpenCV camera-to-world
    near: FiniteFloat
    far: FiniteFloat
    source_sha256: Sha256  # of the photo's file


class ShardInfo(_Record):
    """One shard as the manifest lists it."""

    file: str
    sha256: Sha256
    bytes: int
    keys: tuple[Key, ...] = Field(min_length=1)


class Sidecar(_Record):
    """`shard-NNNNNN.json`: what the tar beside it was cut from, so that a second run can leave it alone."""

    identity: Sha256
    shard: ShardInfo


class SceneRecord(_Record):
    """The scene that was cut; `hash` covers names, splits, cameras and bounds, and not the pixels."""

    name: str
    hash: Sha256
    scale: FiniteFloat  # COLMAP units per scene unit
    box: tuple[Corner, Corner]  # 1st and 99th percentile of the points, scene units
    num_points: int


class PlanRecord(_Record):
    """The patch data set that these shards stand for."""

    plan: PatchPlan
    train_pixels: int
    steps_per_epoch: dict[str, int]  # world size -> steps


class Manifest(_Record):
    """`manifest.json`."""

    format_version: Literal[1] = 1
    scene: SceneRecord
    downscale: int = Field(ge=1)
    reference_downscale: int = Field(ge=1)
    masks: Sha256 | None = None  # of all masks together; None where the scene has none
    shards: tuple[ShardInfo, ...] = Field(min_length=1)
    patch_plan: PlanRecord
    libraries: dict[str, str]  # whose versions decide the bytes

    @model_validator(mode="after")
    def _plain_names_and_unique_keys(self) -> Manifest:
        for i, shard in enumerate(self.shards):
            if shard.file != shard_file(i):
                raise ValueError(f"shard {i} is named {shard.file!r}, not {shard_file(i)}")
        if len(set(self.keys)) < len(self.keys):
            raise ValueError("a sample key is listed twice")
        return self

    @property
    def keys(self) -> list[str]:
        """The keys of all samples, in the order of the photos."""
        return [key for shard in self.shards for key in shard.keys]

    @property
    def content_hash(self) -> str:
        """SHA-256 of all that decides what a reader sees: everything but the patch plan and the library
        versions.
        """
        return digest(self.model_dump(mode="json", exclude={"patch_plan", "libraries"}))


def shard_file(index: int) -> str:
    return f"shard-{index:06d}.tar"


def digest(content: Any) -> str:
    """SHA-256 of JSON-like content in one canonical spelling."""
    return hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


# Cutting


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
) -> Manifest:
    """Cut the scene into `out` and return the manifest; what is there already and right is only verified.

    `mapper(write_shard, specs)` yields the results in any order (`pipeline.launch.tasks`). An interrupted run
    leaves no half-written file, and the next one finishes it.

    Raises:
        SceneError: the scene cannot be read.
        ShardError: `out` holds something else, or shards of other settings; or a photo cannot be used.
    """
    if downscale < 1 or reference_downscale < 1:
        raise ShardError(f"downscale {downscale}, reference_downscale {reference_downscale}: both must be at least 1")
    scene = read_scene(scene_root)
    out = Path(out).resolve()
    try:
        out.mkdir(parents=True, exist_ok=True)
        lock = FileLock(out / ".lock")
        lock.acquire()
    except OSError as error:
        raise ShardError(f"{out} cannot be written ({error.strerror}): choose another folder") from error
    try:
        return _cut(scene, out, downscale, reference_downscale, plan, mapper)
    finally:
        lock.release()


def _cut(
    scene: Scene, out: Path, downscale: int, reference_downscale: int, plan: PatchPlan, mapper: Mapper
) -> Manifest:
    summary = scene_record(scene)
    _refuse_other_content(out, summary, downscale, reference_downscale)
    for stray in out.glob(".*.tmp"):
        stray.unlink()
    specs = [
        ShardSpec(out, i, photos, tuple(mask_path(scene, p) for p in photos), downscale, reference_downscale)
        for i, photos in enumerate(split_photos(scene.photos))
    ]
    shards = sorted(mapper(write_shard, specs), key=lambda info: info.file)
    wanted = {name for info in shards for name in (info.file, sidecar_file(info.file))}
    for path in out.iterdir():
        if SHARD_FILE.fullmatch(path.name) and path.name not in wanted:
            path.unlink()
    manifest = Manifest(
        scene=summary,
        downscale=downscale,
        reference_downscale=reference_downscale,
        masks=masks_hash(scene),
        shards=tuple(shards),
        patch_plan=plan_record(plan, scene, downscale),
        libraries=library_versions(),
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
        info = ShardInfo(file=path.name, sha256=stream.sha256.hexdigest(), bytes=stream.bytes, keys=keys)
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
    return path if ".." not in path.relative_to(scene.root).parts and path.is_file() else None


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


def sidecar_file(shard: str) -> str:
    return shard.removesuffix(".tar") + ".json"


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


# Pictures


def decode_photo(data: bytes, photo: ScenePhoto) -> np.ndarray:
    """The photo as uint8 RGB (h, w, 3), as stored: EXIF orientation is ignored, as COLMAP does; alpha is
    dropped.

    Raises:
        ShardError: damaged, of a kind that we do not read, or not of its camera's size.
    """
    where = f"photo {photo.name}"
    try:
        with Image.open(io.BytesIO(data)) as image:
            if image.size != (photo.width, photo.height):
                raise ShardError(
                    f"{where} has {image.width} x {image.height} pixels and its camera {photo.width} x "
                    f"{photo.height}: use the photos that the model was made from"
                )
            return to_rgb(image, where)
    except (OSError, ValueError, SyntaxError, EOFError, Image.DecompressionBombError) as error:
        raise ShardError(f"{where} cannot be read ({error}): replace it, or take it out of the split table") from error


def decode_mask(data: bytes, photo: ScenePhoto) -> np.ndarray:
    """The mask as uint8 (h, w), in whatever size it is stored."""
    where = f"the mask of photo {photo.name}"
    try:
        with Image.open(io.BytesIO(data)) as image:
            if image.mode.startswith("I;16"):
                return _to_8_bits(image)
            return np.asarray(image.convert("L"))
    except (OSError, ValueError, SyntaxError, EOFError, Image.DecompressionBombError) as error:
        raise ShardError(f"{where} cannot be read ({error})") from error


def to_rgb(image: Image.Image, where: str) -> np.ndarray:
    """uint8 (h, w, 3) of any 8- or 16-bit picture; gray is repeated."""
    if image.mode.startswith("I;16"):
        return np.repeat(_to_8_bits(image)[..., None], 3, axis=2)
    if image.mode in ("I", "F"):
        raise ShardError(f"{where} has 32 bits a pixel, whose range is not known: convert it to 8 or 16 bits")
    return np.asarray(image.convert("RGB"))


def _to_8_bits(image: Image.Image) -> np.ndarray:
    """16 bits to 8: 65535 = 257 * 255, rounded."""
    return ((np.asarray(image).astype(np.uint32) + 128) // 257).astype(np.uint8)


def reference_size(photo: ScenePhoto, spec: ShardSpec) -> tuple[int, int]:
    return max(1, photo.width // spec.reference_downscale), max(1, photo.height // spec.reference_downscale)


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


# Reading


@dataclass(frozen=True)
class Sample:
    """One photo of a shard; pictures are uint8."""

    camera: CameraRecord
    rgb: np.ndarray  # (h, w, 3)
    reference: np.ndarray  # (h', w', 3)
    mask: np.ndarray | None  # (h, w)


def read_manifest(folder: Path) -> Manifest:
    """The manifest of a shard folder; whether the shards agree with it is for `verify_shards` to say.

    Raises:
        ShardError: absent (the folder is not complete), damaged, or of another format version.
    """
    path = Path(folder) / MANIFEST
    if not path.is_file():
        raise ShardError(f"{folder} has no {MANIFEST}: no complete shards are here; cut them with `crossray shard`")
    try:
        content = json.loads(path.read_bytes())
        version = content.get("format_version") if isinstance(content, dict) else None
        if version != FORMAT_VERSION:
            raise ShardError(
                f"{path} has format version {version}, and this crossray reads {FORMAT_VERSION}: cut again"
            )
        return Manifest.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise ShardError(f"{path} is damaged ({place}: {first['msg']}): remove it and cut the shards again") from error
    except (ValueError, RecursionError) as error:
        raise ShardError(f"{path} is damaged ({error}): remove it and cut the shards again") from error


def check_sizes(folder: Path, manifest: Manifest) -> None:
    """The quick look: every shard is there and as long as the manifest says, and there is no other."""
    for shard in manifest.shards:
        path = Path(folder) / shard.file
        if not path.is_file():
            raise ShardError(f"{path} is missing: copy it again, or cut the shards again")
        size = path.stat().st_size
        if size != shard.bytes:
            raise ShardError(f"{path} has {size} bytes and should have {shard.bytes}: copy it again, or cut again")
    known = {MANIFEST} | {name for s in manifest.shards for name in (s.file, sidecar_file(s.file))}
    for path in sorted(Path(folder).iterdir()):
        if path.name not in known and not path.name.startswith("."):
            raise ShardError(f"{path} is extra: the manifest does not list it; remove it, or cut the shards again")


def verify_shards(folder: Path) -> Manifest:
    """Read every shard once and compare it with the manifest: length, SHA-256, keys, and the members of each
    sample.

    Raises:
        ShardError: names the first file that is damaged, missing or extra.
    """
    manifest = read_manifest(folder)
    check_sizes(folder, manifest)
    for shard in manifest.shards:
        check_sha256(folder, shard)
        for _ in read_members(folder, shard):
            pass
    return manifest


def check_sha256(folder: Path, shard: ShardInfo) -> None:
    path = Path(folder) / shard.file
    if sha256_of(path) != shard.sha256:
        raise ShardError(f"{path} is damaged: its SHA-256 is not the manifest's; copy it again, or cut again")


def read_shard(folder: Path, shard: ShardInfo) -> Iterator[Sample]:
    """The samples of one shard, decoded one by one, in the manifest's order.

    Raises:
        ShardError: damaged, or not the samples that the manifest lists.
    """
    for key, members in read_members(folder, shard):
        try:
            yield decode_sample(key, members)
        except (ValueError, OSError, SyntaxError) as error:
            raise ShardError(f"{Path(folder) / shard.file}: sample {key} is damaged ({error}); cut again") from error


def decode_sample(key: str, members: dict[str, bytes]) -> Sample:
    """Decode exactly the four kinds of member; webdataset's own decoders would also run pickles."""
    camera = CameraRecord.model_validate_json(members["camera.json"])
    if camera.key != key:
        raise ValueError(f"its camera is that of {camera.key}")
    shape = (camera.height, camera.width)
    mask = members.get("mask.png")
    return Sample(
        camera=camera,
        rgb=decode_png(members["rgb.png"], (*shape, 3)),
        reference=decode_png(members["ref.png"]),
        mask=None if mask is None else decode_png(mask, shape),
    )


def read_members(folder: Path, shard: ShardInfo) -> Iterator[tuple[str, dict[str, bytes]]]:
    """(key, member name -> bytes) of each sample of a shard, which must be those that the manifest lists."""
    from webdataset.handlers import reraise_exception
    from webdataset.tariterators import group_by_keys, tar_file_expander

    path = Path(folder) / shard.file
    remaining = list(shard.keys)
    try:
        # The file is opened here, because webdataset takes names for URLs and some of those run a shell.
        with path.open("rb") as stream:
            source = [{"url": shard.file, "stream": stream}]
            files = tar_file_expander(source, handler=reraise_exception)
            for sample in group_by_keys(files, handler=reraise_exception):
                key = sample["__key__"]
                members = {name: data for name, data in sample.items() if not name.startswith("__")}
                if not remaining or key != remaining.pop(0):
                    raise ShardError(f"{path}: sample {key} is not where the manifest has it; cut again")
                if not members.keys() >= REQUIRED or not members.keys() <= REQUIRED | OPTIONAL:
                    raise ShardError(f"{path}: sample {key} has members {', '.join(sorted(members))}; cut again")
                yield key, members
    except ShardError:
        raise
    except Exception as error:  # whatever tarfile meets in a damaged file
        raise ShardError(f"{path} is damaged ({error}); copy it again, or cut again") from error
    if remaining:
        raise ShardError(f"{path}: sample {remaining[0]} is missing; copy it again, or cut again")
