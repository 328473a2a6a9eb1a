"""The photo cache: the shards' pixels, decoded once, mapped read-only, and rebuilt when it is not whole."""

from __future__ import annotations

import multiprocessing
import os
import time

import numpy as np
import pytest
from PIL import Image
from tiny_scene import write_tiny_scene

from pipeline import photos as photos_module
from pipeline.cutting import cut_shards
from pipeline.launch.tasks import in_process
from pipeline.manifest import ShardError
from pipeline.patches import PatchPlan
from pipeline.photos import CacheError, open_photos
from pipeline.shards import read_shard


def cut(root, out, **settings):
    return cut_shards(root, out, downscale=2, plan=PatchPlan(), mapper=in_process, **settings)


@pytest.fixture
def shards(tmp_path):
    root = write_tiny_scene(tmp_path / "tiny", photos=10, splits=["train"] * 6 + ["val"] + ["test"] * 3)
    (root / "masks").mkdir()
    Image.fromarray(np.arange(36 * 48, dtype=np.uint8).reshape(36, 48)).save(root / "masks" / "photo_001.png")
    cut(root, tmp_path / "shards")
    return tmp_path / "shards"


@pytest.fixture
def cache(tmp_path):
    return tmp_path / "cache"


@pytest.fixture
def builds(monkeypatch):
    """How often the cache was built."""
    calls = []
    build = photos_module.build_cache
    monkeypatch.setattr(photos_module, "build_cache", lambda *a: calls.append(a) or build(*a))
    return calls


def test_the_mapped_pixels_are_those_of_the_shards(shards, cache):
    photos = open_photos(shards, cache)
    samples = [s for shard in photos.manifest.shards for s in read_shard(shards, shard)]
    assert len(photos) == len(samples) == 10
    for i, sample in enumerate(samples):
        assert photos.records[i] == sample.camera
        np.testing.assert_array_equal(photos.image(i), sample.rgb)
        np.testing.assert_array_equal(photos.reference(i), sample.reference)
    assert [i for i in range(10) if photos.mask(i) is not None] == [1]
    np.testing.assert_array_equal(photos.mask(1), samples[1].mask)
    assert photos.indices("train") == (0, 1, 2, 3, 4, 5)
    assert photos.indices("val") == (6,)
    assert photos.indices("test") == (7, 8, 9)
    np.testing.assert_array_equal(photos.sizes("test"), [[18, 24]] * 3)
    assert open_photos(shards, cache).sizes("none").shape == (0, 2)


def test_pictures_are_read_only_views_of_one_file(shards, cache):
    photos = open_photos(shards, cache)
    image = photos.image(0)
    assert np.shares_memory(image, photos.image(0))
    with pytest.raises(ValueError, match="read-only"):
        image[0, 0, 0] = 1


def test_later_opens_build_nothing_and_are_fast(shards, cache, builds):
    open_photos(shards, cache)
    start = time.perf_counter()
    open_photos(shards, cache)
    assert time.perf_counter() - start < 0.5  # a few milliseconds, on a busy machine
    assert len(builds) == 1


def test_the_environment_names_the_cache(shards, cache, monkeypatch):
    monkeypatch.setenv("CROSSRAY_CACHE", str(cache))
    photos = open_photos(shards)
    assert (cache / f"{photos.manifest.content_hash}.pixels").is_file()


@pytest.mark.parametrize("damage", ["short", "index", "no pixels"])
def test_a_cache_that_is_not_whole_is_rebuilt(shards, cache, builds, damage):
    first = open_photos(shards, cache)
    expected = [first.image(i).copy() for i in range(10)]
    pixels = cache / f"{first.manifest.content_hash}.pixels"
    (cache / f".{pixels.stem}.pixels.99.tmp").write_bytes(b"of a killed process")
    if damage == "short":
        pixels.rename(cache / "kept")  # truncating a mapped file would end this process
        pixels.write_bytes((cache / "kept").read_bytes()[:-1])
    elif damage == "index":
        pixels.with_suffix(".json").write_text("{")
    else:
        pixels.unlink()
    again = open_photos(shards, cache)
    assert len(builds) == 2
    assert all((again.image(i) == expected[i]).all() for i in range(10))
    assert not list(cache.glob(".*.tmp"))


def test_other_shards_have_another_cache(shards, cache, tmp_path):
    root = tmp_path / "tiny"
    first = open_photos(shards, cache)
    before = first.image(0).copy()
    Image.new("RGB", (48, 36), (9, 9, 9)).save(root / "dense" / "images" / "photo_000.jpg")
    cut(root, shards)
    assert (open_photos(shards, cache).image(0) == 9).all()
    np.testing.assert_array_equal(first.image(0), before)


def test_shards_are_verified_before_they_are_cached(shards, cache):
    path = shards / "shard-000003.tar"
    data = bytearray(path.read_bytes())
    data[700] ^= 1
    path.write_bytes(data)
    with pytest.raises(ShardError, match=r"shard-000003\.tar is damaged"):
        open_photos(shards, cache)
    assert not list(cache.glob("*.pixels")) + list(cache.glob("*.json")) + list(cache.glob(".*.tmp"))


def test_a_shard_missing_or_cut_short_after_caching_is_still_an_error(shards, cache):
    open_photos(shards, cache)
    os.truncate(shards / "shard-000003.tar", 100)
    with pytest.raises(ShardError, match=r"shard-000003\.tar has 100 bytes"):
        open_photos(shards, cache)
    (shards / "shard-000003.tar").unlink()
    with pytest.raises(ShardError, match=r"shard-000003\.tar is missing"):
        open_photos(shards, cache)


def test_a_cache_that_cannot_be_written_says_what_to_set(shards, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("x")
    with pytest.raises(CacheError, match=r"file.*CROSSRAY_CACHE"):
        open_photos(shards, tmp_path / "file")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(photos_module, "build_cache", full)
    with pytest.raises(CacheError, match=r"No space left on device.*CROSSRAY_CACHE"):
        open_photos(shards, tmp_path / "full")


def _open_and_sum(arguments) -> tuple[int, int]:
    shards, cache = arguments
    builds = []
    build = photos_module.build_cache
    photos_module.build_cache = lambda *a: builds.append(a) or build(*a)
    photos = open_photos(shards, cache)
    return len(builds), sum(int(photos.image(i).sum()) for i in range(len(photos)))


@pytest.mark.slow
def test_processes_that_start_together_decode_once(shards, cache):
    with multiprocessing.get_context("spawn").Pool(3) as pool:  # other tests of this process have left threads
        results = pool.map(_open_and_sum, [(shards, cache)] * 3, chunksize=1)
    assert sum(built for built, _ in results) == 1
    assert len({total for _, total in results}) == 1
