"""Shards: the same bytes whoever cuts them, interrupted and edited ones mended, and every kind of damage
named.
"""

from __future__ import annotations

import hashlib
import io
import json
import logging
import os
import shutil
import tarfile
import zlib
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tiny_scene import write_tiny_scene

from pipeline.cutting import camera_record, cut_shards, split_photos
from pipeline.errors import CrossrayError
from pipeline.files import sha256_of
from pipeline.launch.tasks import in_process
from pipeline.manifest import Manifest, ShardError, digest, read_manifest
from pipeline.patches import PatchPlan
from pipeline.pictures import conversion, decode_photo
from pipeline.scene import SceneError, read_scene
from pipeline.shards import read_shard, verify_shards

PLAN = PatchPlan(size=4)


def cut(root, out, downscale=2, plan=PLAN, mapper=in_process, **more):
    return cut_shards(root, out, downscale=downscale, plan=plan, mapper=mapper, **more)


def contents(folder) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in sorted(Path(folder).iterdir()) if not p.name.startswith(".")}


def samples(folder):
    return [s for shard in read_manifest(folder).shards for s in read_shard(folder, shard)]


@pytest.fixture
def root(tmp_path):
    return write_tiny_scene(tmp_path / "tiny", photos=10)


@pytest.fixture
def out(root, tmp_path):
    cut(root, tmp_path / "shards")
    return tmp_path / "shards"


# What is in them


def test_a_sample_holds_the_photo_its_reference_and_its_camera(root, tmp_path):
    out = tmp_path / "s"
    manifest = cut(root, out, downscale=5, reference_downscale=3)
    found = samples(out)
    scene = read_scene(root)
    assert manifest.keys == [p.key for p in scene.photos] == [s.camera.key for s in found]
    for photo, sample in zip(scene.photos, found, strict=True):
        with Image.open(photo.path) as image:
            small = np.asarray(image.resize((9, 7), Image.Resampling.LANCZOS))  # floor(48 / 5), floor(36 / 5)
            reference = np.asarray(image.resize((16, 12), Image.Resampling.LANCZOS))
        np.testing.assert_array_equal(sample.rgb, small)
        np.testing.assert_array_equal(sample.reference, reference)
        assert sample.mask is None
        camera = sample.camera
        assert (camera.width, camera.height) == (9, 7)
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((9, 48 * 7 / 36, 4.5, 3.5))
        assert (camera.name, camera.image_id, camera.split) == (photo.name, photo.image_id, photo.split)
        assert (camera.near, camera.far) == (photo.near, photo.far)
        np.testing.assert_array_equal(np.array(camera.c2w, np.float32), photo.c2w)
        assert camera.source_sha256 == sha256_of(photo.path)


def test_the_manifest_writes_the_patch_data_set_down(root, tmp_path):
    manifest = cut(root, tmp_path / "s")
    record = manifest.patch_plan
    assert record.plan == PLAN
    assert record.train_pixels == 8 * 24 * 18  # photos 3 and 7 are test photos
    assert record.steps_per_epoch == {"1": 8 * 24 * 18 // 16, "8": 8 * 24 * 18 // 128}
    assert manifest.scene.name == "tiny"
    text = (tmp_path / "s" / "manifest.json").read_text()
    assert str(tmp_path) not in text
    assert verify_shards(tmp_path / "s") == manifest == read_manifest(tmp_path / "s")


def test_full_size_keeps_the_pixels(tmp_path):
    root = write_tiny_scene(tmp_path / "png", photos=2, suffix=".png", splits=["train", "train"])
    cut(root, tmp_path / "s", downscale=1)
    for photo, sample in zip(read_scene(root).photos, samples(tmp_path / "s"), strict=True):
        np.testing.assert_array_equal(sample.rgb, np.asarray(Image.open(photo.path)))


def test_masks_are_resized_with_their_photo(root, tmp_path):
    (root / "masks").mkdir()
    pixels = np.zeros((36, 48), np.uint8)
    pixels[:, 24:] = 255
    Image.fromarray(pixels).save(root / "masks" / "photo_002.png")
    manifest = cut(root, tmp_path / "s", downscale=4)
    found = samples(tmp_path / "s")
    assert [i for i, s in enumerate(found) if s.mask is not None] == [2]
    expected = np.asarray(Image.fromarray(pixels).resize((12, 9), Image.Resampling.BILINEAR))
    np.testing.assert_array_equal(found[2].mask, expected)
    Image.fromarray(255 - pixels).save(root / "masks" / "photo_002.png")  # an edited mask is noticed
    assert cut(root, tmp_path / "s", downscale=4).content_hash != manifest.content_hash


@pytest.mark.parametrize(("photos", "shards"), [(1, 1), (7, 7), (8, 8), (74, 8), (128, 8), (129, 9), (763, 48)])
def test_how_many_shards_depends_on_the_photos_alone(photos, shards):
    parts = split_photos(tuple(range(photos)))
    assert len(parts) == shards
    assert [i for part in parts for i in part] == list(range(photos))
    assert max(map(len, parts)) <= 16
    assert max(map(len, parts)) - min(map(len, parts)) <= 1


@pytest.mark.parametrize("mode", ["L", "LA", "RGBA", "P", "CMYK", "1", "I;16"])
def test_photos_of_any_kind_become_rgb(root, mode):
    photo = read_scene(root).photos[0]
    gray = np.tile(np.arange(48, dtype=np.uint8) * 5, (36, 1))
    if mode == "I;16":
        image = Image.fromarray(gray.astype(np.uint16) * 257)
    elif mode == "1":
        gray = (gray > 100).astype(np.uint8) * 255
        image = Image.fromarray(gray).convert("1")
    elif mode == "RGBA":
        image = Image.fromarray(np.dstack([gray, gray, gray, np.full_like(gray, 7)]))
    else:
        image = Image.fromarray(gray).convert(mode)
    buffer = io.BytesIO()
    image.save(buffer, "TIFF" if mode == "CMYK" else "PNG")
    pixels = decode_photo(buffer.getvalue(), photo)
    assert pixels.dtype == np.uint8
    assert abs(pixels.astype(int) - gray[..., None]).max() <= 1
    assert pixels.shape == (36, 48, 3)


def test_exif_orientation_and_colour_profiles_are_left_out(root, tmp_path):
    photo = read_scene(root).photos[0]
    image = Image.open(photo.path)
    pixels = np.asarray(image)
    exif = Image.Exif()
    exif[0x0112] = 6  # "turn by 90 degrees"
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG", exif=exif, icc_profile=b"x" * 128)
    np.testing.assert_array_equal(decode_photo(buffer.getvalue(), photo), pixels)


# Photos that cannot be used


def replace_photo(root, content: bytes, name="photo_004.jpg"):
    (root / "dense" / "images" / name).write_bytes(content)


def jpeg(width, height) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)).save(buffer, "JPEG")
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (jpeg(36, 48), "36 x 48 pixels and its camera 48 x 36"),
        (jpeg(48, 36)[:-900], "cannot be read"),
        (b"not a picture", "cannot be read"),
        (b"", "cannot be read"),
    ],
)
def test_a_photo_that_cannot_be_used_is_named_and_nothing_is_half_written(root, tmp_path, content, words):
    whole = (root / "dense" / "images" / "photo_004.jpg").read_bytes()
    replace_photo(root, content)
    with pytest.raises(ShardError, match=r"photo photo_004\.jpg.*" + words):
        cut(root, tmp_path / "s")
    assert not list((tmp_path / "s").glob(".*.tmp"))
    with pytest.raises(ShardError, match=r"no manifest\.json"):
        verify_shards(tmp_path / "s")
    replace_photo(root, whole)
    cut(root, tmp_path / "s")
    cut(root, tmp_path / "clean")
    assert contents(tmp_path / "s") == contents(tmp_path / "clean")


def test_photos_smaller_than_the_downscale_are_refused(root, tmp_path):
    with pytest.raises(ShardError, match=r"photo_000\.jpg \(48 x 36\) is too small for downscale 40"):
        cut(root, tmp_path / "s", downscale=40)
    with pytest.raises(ShardError, match="at least 1"):
        cut(root, tmp_path / "s", downscale=0)
    with pytest.raises(SceneError):
        cut(tmp_path / "nowhere", tmp_path / "s")


def test_photos_that_cannot_be_used_may_be_dropped_and_are_counted(root, tmp_path, caplog):
    splits = {p.name: p.split for p in read_scene(root).photos}
    bad = {
        "photo_001.jpg": (jpeg(36, 48), "36 x 48 pixels and its camera 48 x 36"),
        "photo_003.jpg": (jpeg(48, 36)[:-900], "cannot be read"),
        "photo_004.jpg": (None, "is missing"),
    }
    for name, (content, _) in bad.items():
        replace_photo(root, content, name) if content else (root / "dense" / "images" / name).unlink()
    with pytest.raises(CrossrayError, match=r"photo_004\.jpg"):
        cut(root, tmp_path / "s")
    with caplog.at_level(logging.WARNING, logger="crossray"):
        manifest = cut(root, tmp_path / "s", on_bad_photo="drop")
    assert "3 photos of" in caplog.text
    assert sorted(manifest.dropped) == sorted(bad)
    for name, (_, words) in bad.items():
        assert words in manifest.dropped[name]
        assert words in caplog.text
    left = {sample.camera.name: sample.camera.split for sample in samples(tmp_path / "s")}
    assert left == {name: split for name, split in splits.items() if name not in bad}
    verify_shards(tmp_path / "s")
    assert cut(root, tmp_path / "s", on_bad_photo="drop") == manifest


def test_a_scene_of_bad_photos_alone_is_refused(root, tmp_path):
    for path in (root / "dense" / "images").iterdir():
        path.write_bytes(b"not a picture")
    with pytest.raises(SceneError, match="no training photo among the 0 posed ones, 10 were left out"):
        cut(root, tmp_path / "s", on_bad_photo="drop")


def test_conversions_are_counted(root, tmp_path, caplog):
    for number, mode in enumerate(("L", "CMYK", "L", "RGB")):
        path = root / "dense" / "images" / f"photo_00{number}.jpg"
        Image.open(path).convert(mode).save(path)
    with caplog.at_level(logging.INFO, logger="crossray"):
        manifest = cut(root, tmp_path / "s")
    assert "converted to 8-bit RGB: 1 CMYK, 2 grayscale" in caplog.text
    assert sum((Counter(shard.converted) for shard in manifest.shards), Counter()) == {"CMYK": 1, "grayscale": 2}
    caplog.clear()
    with caplog.at_level(logging.INFO, logger="crossray"):
        cut(root, tmp_path / "s")
    assert "1 CMYK, 2 grayscale" in caplog.text


# The same bytes, whatever happens


def backwards(fn, specs):
    return [fn(spec) for spec in reversed(specs)]


def test_every_run_in_any_order_at_any_place_gives_the_same_bytes(root, out, tmp_path):
    cut(root, tmp_path / "again", mapper=backwards)
    assert contents(tmp_path / "again") == contents(out)
    moved = tmp_path / "elsewhere" / "moved"
    shutil.copytree(root, moved)
    cut(moved, tmp_path / "third")
    assert contents(tmp_path / "third") == contents(out)
    with tarfile.open(out / "shard-000000.tar") as tar:
        assert {m.mtime for m in tar} == {0}


def test_a_second_run_writes_nothing(root, out):
    times = {p.name: p.stat().st_mtime_ns for p in out.iterdir() if p.name != ".lock"}
    cut(root, out)
    assert {p.name: p.stat().st_mtime_ns for p in out.iterdir() if p.name != ".lock"} == times


class Interrupted(Exception):
    pass


def test_an_interrupted_run_is_finished_by_the_next(root, out, tmp_path):
    def stop_after_three(fn, specs):
        for spec in specs[:3]:
            yield fn(spec)
        raise Interrupted

    late = tmp_path / "late"
    with pytest.raises(Interrupted):
        cut(root, late, mapper=stop_after_three)
    assert not (late / "manifest.json").exists()
    (late / ".shard-000003.tar.123.tmp").write_bytes(b"half")
    (late / "shard-000004.tar").write_bytes(b"a tar without its sidecar")
    (late / "shard-000077.tar").write_bytes(b"of a larger scene")
    (late / "shard-000077.json").write_bytes(b"of a larger scene")
    cut(root, late)
    assert contents(late) == contents(out)
    assert not list(late.glob(".*.tmp"))


def test_damage_is_mended_by_cutting_again(root, out):
    before = contents(out)
    flip(out / "shard-000002.tar", 700)
    (out / "shard-000003.json").write_text("{")
    (out / "shard-000004.tar").unlink()
    cut(root, out)
    assert contents(out) == before


def test_an_edited_photo_cuts_its_shard_again_and_no_other(root, out):
    before, old = contents(out), read_manifest(out)
    replace_photo(root, jpeg(48, 36), "photo_000.jpg")
    new = cut(root, out)
    after = contents(out)
    assert {name for name in after if after[name] != before[name]} == {
        "shard-000000.tar",
        "shard-000000.json",
        "manifest.json",
    }
    assert new.content_hash != old.content_hash
    verify_shards(out)


def test_another_plan_rewrites_the_manifest_alone(root, out):
    before, old = contents(out), read_manifest(out)
    new = cut(root, out, plan=PatchPlan(size=8))
    after = contents(out)
    assert {name for name in after if after[name] != before[name]} == {"manifest.json"}
    assert new.content_hash == old.content_hash
    assert new.patch_plan.plan.size == 8


def test_other_settings_need_another_folder(root, out, tmp_path):
    before = contents(out)
    with pytest.raises(ShardError, match=r"downscale 2, not 4.*another folder"):
        cut(root, out, downscale=4)
    with pytest.raises(ShardError, match="reference_downscale 8, not 4"):
        cut(root, out, reference_downscale=4)
    table = root / "tiny.tsv"
    table.write_text(table.read_text().replace("1003.0\ttest", "1003.0\ttrain"))
    with pytest.raises(ShardError, match="other photos, splits or cameras"):
        cut(root, out)
    table.rename(root / "other.tsv")
    with pytest.raises(ShardError, match="scene tiny, not other"):
        cut(root, out)
    assert contents(out) == before


def test_a_folder_of_something_else_is_left_alone(root, tmp_path):
    home = tmp_path / "home"
    home.mkdir()
    (home / "thesis.txt").write_text("years of work")
    with pytest.raises(ShardError, match=r"thesis\.txt"):
        cut(root, home)
    assert contents(home) == {"thesis.txt": b"years of work"}
    with pytest.raises(ShardError, match="cannot be written"):
        cut(root, home / "thesis.txt" / "s")


# Reading: nothing is trusted


def flip(path, place):
    data = bytearray(path.read_bytes())
    data[place] ^= 1
    path.write_bytes(data)


def pretend(folder, index=0):
    """Make the manifest agree with the bytes of a shard that was tampered with."""
    path = folder / "manifest.json"
    content = json.loads(path.read_text())
    shard = content["shards"][index]
    data = (folder / shard["file"]).read_bytes()
    shard["bytes"], shard["sha256"] = len(data), hashlib.sha256(data).hexdigest()
    path.write_text(json.dumps(content))


@pytest.mark.parametrize("place", [0, 100, 700, 1024, -1])
def test_one_flipped_bit_anywhere_names_the_shard(out, place):
    flip(out / "shard-000002.tar", place)
    with pytest.raises(ShardError, match=r"shard-000002\.tar is damaged"):
        verify_shards(out)


def test_missing_short_and_extra_files_are_named(out):
    (out / "shard-000099.tar").write_bytes(b"")
    with pytest.raises(ShardError, match=r"shard-000099\.tar is extra"):
        verify_shards(out)
    (out / "shard-000099.tar").unlink()
    os.truncate(out / "shard-000001.tar", 512)
    with pytest.raises(ShardError, match=r"shard-000001\.tar has 512 bytes"):
        verify_shards(out)
    (out / "shard-000001.tar").unlink()
    with pytest.raises(ShardError, match=r"shard-000001\.tar is missing"):
        verify_shards(out)


def test_sidecars_need_not_travel(out):
    for path in out.glob("shard-*.json"):
        path.unlink()
    verify_shards(out)


def rewrite(path, change):
    """Pack a tar again with `change(name, data)` -> (name, data) or None for every member."""
    with tarfile.open(path) as tar:
        members = [(m.name, tar.extractfile(m).read()) for m in tar]
    with tarfile.open(path, "w") as tar:
        for name, data in filter(None, (change(*member) for member in members)):
            info = tarfile.TarInfo(name)
            info.size = len(data)
            tar.addfile(info, io.BytesIO(data))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda n, d: None if n.endswith("ref.png") else (n, d), "has members camera.json, rgb.png"),
        (lambda n, d: (n.replace("ref.png", "ref.pkl"), d), r"ref\.pkl"),
        (lambda n, d: (n.replace("000000-", "000009-"), d), "not where the manifest has it"),
        (lambda n, d: None if n.startswith("000001-") else (n, d), "000001-photo_001 is missing"),
        (lambda n, d: None, "000000-photo_000 is missing"),
    ],
)
def test_samples_are_those_of_the_manifest_even_if_the_hash_agrees(tmp_path, change, words):
    root = write_tiny_scene(tmp_path / "large", photos=20, size=(16, 12))
    out = tmp_path / "s"
    cut(root, out)
    rewrite(out / "shard-000000.tar", change)
    pretend(out)
    with pytest.raises(ShardError, match=r"shard-000000\.tar: .*" + words):
        verify_shards(out)


def test_a_tar_cut_short_at_a_header_is_noticed_even_if_the_hash_agrees(out):
    with tarfile.open(out / "shard-000000.tar") as tar:
        start = tar.getmembers()[-1].offset
    os.truncate(out / "shard-000000.tar", start)
    pretend(out)
    with pytest.raises(ShardError, match=r"shard-000000\.tar"):
        verify_shards(out)


@pytest.mark.parametrize(
    ("suffix", "data"),
    [("rgb.png", b"no png"), ("camera.json", b"{}"), ("rgb.png", None)],
)
def test_members_that_are_not_what_they_should_be_name_their_sample(out, suffix, data):
    buffer = io.BytesIO()
    Image.fromarray(np.zeros((5, 5, 3), np.uint8)).save(buffer, "PNG")
    wrong = data if data is not None else buffer.getvalue()
    rewrite(out / "shard-000000.tar", lambda n, d: (n, wrong if n.endswith(suffix) else d))
    pretend(out)
    with pytest.raises(ShardError, match=r"shard-000000\.tar: sample 000000-photo_000 is damaged"):
        samples(out)


@pytest.mark.parametrize("name", ["../x.tar", "/etc/passwd", "shard-000000.tar\n", "pipe:id", "shard-٠٠٠٠٠٠.tar"])
def test_a_manifest_cannot_name_files_elsewhere(out, name):
    path = out / "manifest.json"
    content = json.loads(path.read_text())
    content["shards"][0]["file"] = name
    path.write_text(json.dumps(content))
    with pytest.raises(ShardError, match=r"manifest\.json is damaged \(.*shard 0 is named"):
        read_manifest(out)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"format_version": 2}, "format version 2"),
        ({"downscale": 0}, r"damaged \(downscale"),
        ({"shards": []}, r"damaged \(shards"),
        ({"surprise": 1}, r"damaged \(surprise"),
    ],
)
def test_a_manifest_that_is_not_ours_is_refused(out, change, words):
    path = out / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(ShardError, match=words):
        read_manifest(out)
    path.write_text("{")
    with pytest.raises(ShardError, match="damaged"):
        read_manifest(out)


def test_a_key_listed_twice_is_refused(out):
    content = json.loads((out / "manifest.json").read_text())
    content["shards"][1]["keys"] = content["shards"][0]["keys"]
    with pytest.raises(ValueError, match="listed twice"):
        Manifest.model_validate(content)


def test_the_content_hash_is_of_the_content(out):
    manifest = read_manifest(out)
    other = manifest.model_copy(update={"libraries": {"pillow": "0"}})
    assert other.content_hash == manifest.content_hash
    assert manifest.model_copy(update={"downscale": 3}).content_hash != manifest.content_hash
    assert digest({"b": 1.5, "a": [1]}) == hashlib.sha256(b'{"a":[1],"b":1.5}').hexdigest()


# The real photos


@pytest.mark.real
def test_golden_intrinsics_of_downscaled_photos(test_data, golden):
    expected = golden("colmap_scene")
    photos = {p.name: p for p in read_scene(test_data / "reichstag").photos}
    for ds in (2, 4):
        for i, name in enumerate(expected["in/image_names"]):
            camera = camera_record(photos[str(name)], ds, b"")
            K = expected[f"out/ds{ds}/K"][i]
            assert [camera.width, camera.height] == expected[f"in/ds{ds}/image_wh"][i].tolist()
            assert [camera.fx, camera.fy, camera.cx, camera.cy] == pytest.approx(
                [K[0, 0].item(), K[1, 1].item(), K[0, 2].item(), K[1, 2].item()], abs=3e-3
            )


@pytest.fixture(scope="module")
def reichstag_shards(test_data, tmp_path_factory):
    out = tmp_path_factory.mktemp("reichstag")
    cut(test_data / "reichstag", out, downscale=8, plan=PatchPlan())
    return out


@pytest.mark.real
@pytest.mark.slow
def test_real_photos_are_cut_and_verified(reichstag_shards, test_data):
    manifest = verify_shards(reichstag_shards)
    assert len(manifest.keys) == 74
    assert len(manifest.shards) == 8
    for sample in samples(reichstag_shards):
        with Image.open(test_data / "reichstag" / "dense" / "images" / sample.camera.name) as image:
            size = (image.width // 8, image.height // 8)
            expected = np.asarray(image.convert("RGB").resize(size, Image.Resampling.LANCZOS))
        np.testing.assert_array_equal(sample.rgb, expected)


@pytest.mark.real
@pytest.mark.slow
def test_real_shards_run_again_are_only_verified(reichstag_shards, test_data):
    before = contents(reichstag_shards)
    cut(test_data / "reichstag", reichstag_shards, downscale=8, plan=PatchPlan())
    assert contents(reichstag_shards) == before


def test_two_photos_of_one_mask_are_refused(tmp_path):
    root = write_tiny_scene(tmp_path / "scene", photos=3)
    (first, *_) = read_scene(root).photos
    (root / "masks").mkdir(exist_ok=True)
    Image.new("L", (first.width, first.height)).save(mask_name := (root / "masks" / first.name).with_suffix(".png"))
    twin = first.path.with_suffix(".gif")
    Image.new("RGB", (first.width, first.height)).save(twin)
    images = next((root / "dense").rglob("images.txt"))
    second = read_scene(root).photos[1].name
    images.write_text(images.read_text().replace(second, twin.name))
    table = root / "tiny.tsv"
    table.write_text(table.read_text().replace(second, twin.name))
    with pytest.raises(ShardError, match=f"{mask_name.name} would be the mask of"):
        cut_shards(root, tmp_path / "shards", downscale=1, plan=PatchPlan(), mapper=in_process)


def test_a_mask_of_another_shape_is_refused(tmp_path):
    root = write_tiny_scene(tmp_path / "scene", photos=3)
    (first, *_) = read_scene(root).photos
    (root / "masks").mkdir(exist_ok=True)
    Image.new("L", (10, 1000)).save((root / "masks" / first.name).with_suffix(".png"))
    with pytest.raises(ShardError, match="10 x 1000 pixels, which is not the shape"):
        cut_shards(root, tmp_path / "shards", downscale=1, plan=PatchPlan(), mapper=in_process)


@pytest.mark.parametrize("mode", ["I;16", "RGB"])
def test_sixteen_bits_are_told(mode):
    png = io.BytesIO()
    if mode == "I;16":
        Image.new(mode, (4, 4)).save(png, "PNG")
        assert conversion(png.getvalue()) == "16-bit grayscale"
        return
    Image.new(mode, (4, 4)).save(png, "PNG")
    assert conversion(png.getvalue()) is None
    deep = bytearray(png.getvalue())
    deep[24] = 16
    deep[29:33] = zlib.crc32(bytes(deep[12:29])).to_bytes(4, "big")
    assert conversion(bytes(deep)) == "16-bit RGB"
