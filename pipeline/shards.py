"""Reading shards, and the proof that they arrived (their format: pipeline/manifest.py).

Reading never trusts webdataset alone, which delivers 23 of 40 samples after one flipped byte without a word.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.files import sha256_of
from pipeline.manifest import MANIFEST, CameraRecord, Manifest, ShardError, ShardInfo, read_manifest, sidecar_file
from pipeline.pictures import decode_png

REQUIRED, OPTIONAL = {"rgb.png", "ref.png", "camera.json"}, {"mask.png"}


@dataclass(frozen=True)
class Sample:
    """One photo of a shard; pictures are uint8."""

    camera: CameraRecord
    rgb: np.ndarray  # (h, w, 3)
    reference: np.ndarray  # (h', w', 3)
    mask: np.ndarray | None  # (h, w)


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
