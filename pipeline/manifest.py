"""What shards hold: how a scene travels to the nodes that train on it (cutting.py writes them, shards.py reads them).

A shard folder holds `shard-000000.tar`, ..., each with a sidecar `shard-000000.json`, and `manifest.json`,
written last: without it the folder is not complete. One sample a photo:

    <key>.rgb.png      the photo by LANCZOS at floor(w / downscale) x floor(h / downscale), lossless
    <key>.ref.png      the appearance reference: the *original* by LANCZOS at 1 / reference_downscale
    <key>.camera.json  a `CameraRecord`
    <key>.mask.png     transient probability * 255, as large as the rgb, where the scene has `masks/<photo>.png`

Nothing here holds a time, a host name or an absolute path.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, model_validator

from pipeline.errors import CrossrayError
from pipeline.patches import PatchPlan

FORMAT_VERSION = 1
MANIFEST = "manifest.json"

Row = tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]
Corner = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Key = Annotated[str, Field(pattern=r"^[a-z0-9_-]+$")]


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
    converted: dict[str, int] = {}  # what the sources were where they were not 8-bit RGB, and how many


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
    dropped: dict[str, str] = {}  # photos of the scene that are not here, as their files cannot be used -> reason
    source: Sha256 | None = None  # fingerprint of the scene's files; None: not known
    splits: dict[str, int] = {}  # split -> photos

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
        """SHA-256 of all that decides what a reader sees: not the patch plan, the library versions, and what is told
        of the sources.
        """
        content = self.model_dump(mode="json", exclude={"patch_plan", "libraries", "dropped", "source", "splits"})
        for shard in content["shards"]:
            del shard["converted"]
        return digest(content)


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


def shard_file(index: int) -> str:
    return f"shard-{index:06d}.tar"


def sidecar_file(shard: str) -> str:
    return shard.removesuffix(".tar") + ".json"


def digest(content: Any) -> str:
    """SHA-256 of JSON-like content in one canonical spelling."""
    return hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()
