"""What becomes of each file of a folder of photos."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from pipeline.colmap import import_pycolmap
from pipeline.errors import CrossrayError
from pipeline.ingest.folder import File, list_files, look, look_at, safe_stems, what_else


def picture(seed, size=(96, 80), mode="RGB"):
    pixels = np.random.default_rng(seed).integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)
    return Image.fromarray(pixels).convert(mode)


@pytest.fixture
def folder(tmp_path):
    root = tmp_path / "photos"
    root.mkdir()
    for i in range(3):
        picture(i).save(root / f"{i}.jpg")
    return root


def looked(folder, tmp_path):
    return {s.name: s for s in look_at(folder, list_files(folder), tmp_path / "used", map)}


def test_photos_are_linked_as_they_are(folder, tmp_path):
    seen = looked(folder, tmp_path)
    assert [s.photo for s in seen.values()] == ["0.jpg", "1.jpg", "2.jpg"]
    assert seen["0.jpg"].size == (96, 80)
    assert (tmp_path / "used" / "0.jpg").resolve() == (folder / "0.jpg").resolve()


def test_other_kinds_become_rgb_pngs(folder, tmp_path):
    picture(5, mode="CMYK").save(folder / "cmyk.jpg")
    picture(6, mode="RGBA").save(folder / "alpha.png")
    picture(7, mode="L").save(folder / "gray.jpg")
    deep = np.full((80, 96), 257 * 100, np.uint16)
    deep[:, ::2] = 0
    Image.fromarray(deep).save(folder / "deep.png")
    picture(8).save(folder / "w.webp", lossless=True)
    seen = looked(folder, tmp_path)
    names = ("cmyk.jpg", "alpha.png", "gray.jpg", "deep.png", "w.webp")
    assert [seen[n].photo for n in names] == ["cmyk.png", "alpha.png", "gray.jpg", "deep.png", "w.png"]
    for n in ("cmyk.png", "alpha.png", "deep.png", "w.png"):
        with Image.open(tmp_path / "used" / n) as image:
            assert image.mode == "RGB"
    assert np.asarray(Image.open(tmp_path / "used" / "deep.png"))[0, 1].tolist() == [100, 100, 100]
    np.testing.assert_array_equal(Image.open(tmp_path / "used" / "w.png"), picture(8))


def test_each_reason(folder, tmp_path):
    (folder / "a.pdf").write_bytes(b"%PDF-1.7 ...")
    (folder / "b.heic").write_bytes(b"\0\0\0\x18ftypheic" + b"\0" * 50)
    (folder / "c.jpg").write_bytes((folder / "0.jpg").read_bytes()[:900])
    picture(9, (1, 1)).save(folder / "d.png")
    picture(9, (63, 900)).save(folder / "e.png")
    (folder / "f.jpg").write_bytes(b"")
    (folder / "g.txt").write_text("hello")
    (folder / "h.jpg").write_bytes((folder / "1.jpg").read_bytes())
    (folder / ".hidden").write_text("no")
    reasons = {n: s.reason for n, s in looked(folder, tmp_path).items() if s.reason}
    assert reasons.keys() == {"a.pdf", "b.heic", "c.jpg", "d.png", "e.png", "f.jpg", "g.txt", "h.jpg"}
    assert "PDF" in reasons["a.pdf"]
    assert "convert it to JPEG" in reasons["b.heic"]
    assert "cut short" in reasons["c.jpg"]
    assert reasons["d.png"].startswith("1 x 1 pixels: too small")
    assert reasons["e.png"].startswith("63 x 900")
    assert reasons["f.jpg"] == "an empty file"
    assert reasons["g.txt"].startswith("not a photo")
    assert reasons["h.jpg"] == "the same picture as 1.jpg"
    assert sorted(p.name for p in (tmp_path / "used").iterdir()) == ["0.jpg", "1.jpg", "2.jpg"]


def test_200_copies_are_one_photo(tmp_path):
    root = tmp_path / "photos"
    root.mkdir()
    picture(0).save(root / "000.png")
    for i in range(1, 200):  # different files, the same pixels
        (root / f"{i:03d}.png").write_bytes((root / "000.png").read_bytes() + bytes([i]))
    with pytest.raises(CrossrayError, match=r"1 usable photos of 200 files(.|\n)*the same picture as 000.png"):
        looked(root, tmp_path)


def test_photos_in_folders_and_with_blanks_get_safe_names(folder, tmp_path):
    (folder / "day 2").mkdir()
    picture(4).save(folder / "day 2" / "IMG (1).JPG", "JPEG")
    assert looked(folder, tmp_path)["day 2/IMG (1).JPG"].photo == "day_2_IMG_1_.jpg"


def test_stems_are_distinct():
    names = ["a.jpg", "a.png", "a-1.jpg", "A.tif", "b c.jpg", "b_c.jpg"]
    stems = safe_stems(names)
    assert len({s.lower() for s in stems}) == len(names)
    assert stems[2] == "a-1"


@pytest.mark.parametrize(("make", "message"), [
    (lambda p: None, "does not exist"), (lambda p: p.write_text("x"), "is a file"), (lambda p: p.mkdir(), "no file")
])  # fmt: skip
def test_no_folder_of_photos(tmp_path, make, message):
    make(tmp_path / "x")
    with pytest.raises(CrossrayError, match=message):
        list_files(tmp_path / "x")


def test_what_a_file_is():
    assert what_else(b"\0\0\0\x18ftypmp42") == "not a photo, or cut off at its start"


def test_photos_are_turned_upright_and_keep_their_focal_length(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 255, (80, 160, 3), dtype=np.uint8)
    exif = Image.Exif()
    exif[0x0112] = 6  # the top of the photo is at its right
    exif.get_ifd(0x8769)[0xA405] = 50  # mm, as of a 35 mm film of 43.3 mm across
    Image.fromarray(pixels).save(tmp_path / "a.png", exif=exif)
    (tmp_path / "out").mkdir()
    turned = look(File(tmp_path / "a.png", "a.png", tmp_path / "out" / "turned"))
    assert turned.size == (80, 160)
    with Image.open(tmp_path / "out" / turned.photo) as image:
        assert image.getexif().get(0x0112, 1) == 1
        np.testing.assert_array_equal(np.asarray(image), np.rot90(pixels, -1))
    stored = look(File(tmp_path / "a.png", "a.png", tmp_path / "out" / "stored", upright=False))
    assert stored.size == (160, 80)
    for photo in (turned.photo, stored.photo):
        camera = import_pycolmap().infer_camera_from_image(tmp_path / "out" / photo)
        assert camera.has_prior_focal_length
        assert camera.focal_length_x == pytest.approx(50 / 43.27 * np.hypot(80, 160), rel=1e-3)


def test_a_photo_with_damaged_exif_is_a_photo(tmp_path):
    Image.new("RGB", (80, 70), "red").save(tmp_path / "a.jpg", exif=b"Exif\x00\x00garbage")
    seen = look(File(tmp_path / "a.jpg", "a.jpg", tmp_path / "out"))
    assert (seen.reason, seen.size) == ("", (80, 70))


@pytest.mark.parametrize("kind", ["TIFF", "JPEG", "PNG", "WEBP"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_each_orientation_of_each_format(tmp_path, kind, orientation):
    stored = np.zeros((70, 80, 3), np.uint8)
    stored[:35, :40], stored[:35, 40:], stored[35:, :40] = (255, 0, 0), (0, 255, 0), (0, 0, 255)
    turns = [stored, stored[:, ::-1], stored[::-1, ::-1], stored[::-1], stored.swapaxes(0, 1), np.rot90(stored, -1),
             np.rot90(stored, 2).swapaxes(0, 1), np.rot90(stored)]  # fmt: skip
    exif = Image.Exif()
    exif[0x0112] = orientation
    options = {"WEBP": {"lossless": True}, "JPEG": {"quality": 100, "subsampling": 0}}.get(kind, {})
    Image.fromarray(stored).save(tmp_path / "a", kind, exif=exif, **options)
    for upright, wanted in ((True, turns[orientation - 1]), (False, stored)):
        seen = look(File(tmp_path / "a", "a", tmp_path / f"out{upright}", upright))
        assert seen.size == wanted.shape[1::-1]
        with Image.open(tmp_path / seen.photo) as image:
            np.testing.assert_allclose(np.asarray(image).astype(int), wanted, atol=3)
