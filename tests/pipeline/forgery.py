"""Shards that somebody has changed, with a manifest that vouches for them."""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Callable
from pathlib import Path

from pipeline.files import sha256_of
from pipeline.photos import open_photos
from pipeline.shards import read_shard, verify_shards


def edit_manifest(shards: Path, change: Callable[[dict], object]) -> None:
    content = json.loads((shards / "manifest.json").read_text())
    change(content)
    (shards / "manifest.json").write_text(json.dumps(content))


def repack(shards: Path, change: Callable[[tarfile.TarInfo, bytes], tuple[tarfile.TarInfo, bytes] | None]) -> None:
    """Make the first tar anew, and a manifest that vouches for it: the attacker wrote both."""
    path = shards / "shard-000000.tar"
    with tarfile.open(path) as tar:
        members = [(member, tar.extractfile(member).read()) for member in tar]  # type: ignore[union-attr]
    with tarfile.open(path, "w") as tar:
        for member, data in filter(None, (change(*pair) for pair in members)):
            member.size = len(data) if member.isreg() else 0
            tar.addfile(member, io.BytesIO(data))

    vouch(shards, path)


def vouch(shards: Path, path: Path) -> None:
    """Let the manifest say that the first tar is as it should be."""
    of_now = {"sha256": sha256_of(path), "bytes": path.stat().st_size}
    edit_manifest(shards, lambda content: content["shards"][0].update(of_now))


def read_all(shards: Path) -> None:
    for shard in verify_shards(shards).shards:
        list(read_shard(shards, shard))
    open_photos(shards)
