"""Fixed masks: what is masked and what is not, interrupted runs go on, and nothing of others is overwritten."""

from __future__ import annotations

import hashlib
import json
import logging
import pickle
import re
import sys
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from tiny_scene import write_tiny_scene

from pipeline import cli
from pipeline.cutting import cut_shards, mask_path
from pipeline.files import sha256_of
from pipeline.launch import tasks
from pipeline.launch.tasks import in_process
from pipeline.manifest import read_manifest
from pipeline.masks import BATCH, MaskError, SceneMasks, make_masks, mask_file, read_masks, to_mask
from pipeline.patches import PatchPlan
from pipeline.scene import SceneError, read_scene
from pipeline.segmentation import Segmenter, SegmenterError, SegmenterRecord, find_segmenter
from pipeline.segmentation.tflite import TFLite
from pipeline.shards import read_shard

pytestmark = pytest.mark.slow  # a quarter of a minute together: not for every commit

PHOTOS = 10
SIZE = (48, 36)


@dataclass(frozen=True)
class Redness(Segmenter):
    """Transient is what is red: the photo's own red channel at half its size."""

    name: str = "redness"

    def describe(self, photos):
        return SegmenterRecord(name=self.name, sha256="0" * 64, classes={"red": 0})

    def probability(self, photo, pixels):
        asked.append(photo.name)
        return pixels[::2, ::2, 0] / np.float32(255)


asked: list[str] = []  # photos that Redness was asked for


@pytest.fixture
def root(tmp_path):
    asked.clear()
    return write_tiny_scene(tmp_path / "tiny", photos=PHOTOS)


def make(root, segmenter=Redness(), mapper=in_process, **more):
    return make_masks(root, segmenter, mapper=mapper, **more)


def contents(folder: Path) -> dict[str, bytes]:
    files = (p for p in sorted(folder.rglob("*")) if p.is_file() and p.name != ".lock")
    return {str(p.relative_to(folder)): p.read_bytes() for p in files}


def picture(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image)


def edit_text(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def rename_photo(root: Path, old: str, new: str) -> None:
    """In the model and the split table; the file itself is the test's to move."""
    edit_text(root / "dense" / "sparse" / "images.txt", old, new)
    edit_text(root / "tiny.tsv", old, new)


# What is written


def test_a_mask_is_the_probability_of_its_photo(root):
    made = make(root)
    scene = read_scene(root)
    assert (made.folder, made.photos, made.made) == (root.resolve() / "masks", PHOTOS, PHOTOS)
    shares = []
    for photo in scene.photos:
        path = mask_path(scene, photo)  # where cutting shards looks for it
        assert path == mask_file(made.folder, photo)
        mask = picture(path)
        np.testing.assert_array_equal(mask, picture(photo.path)[::2, ::2, 0])
        shares.append(mask.mean() / 255)
    assert made.share == pytest.approx(np.mean(shares))


def test_the_record_says_who_made_what_from_what(root):
    make(root)
    text = (root / "masks" / "masks.json").read_text()
    record = SceneMasks.model_validate_json(text)
    assert (record.segmenter.name, record.segmenter.sha256, record.segmenter.classes) == (
        "redness", "0" * 64, {"red": 0},
    )  # fmt: skip
    scene = read_scene(root)
    assert list(record.photos) == [photo.name for photo in scene.photos]
    assert [r.photo for r in record.photos.values()] == [sha256_of(photo.path) for photo in scene.photos]
    assert str(root) not in text
    with Image.open(root / "masks" / "photo_003.png") as image:
        assert json.loads(image.info["crossray"]) == record.photos["photo_003.jpg"].model_dump()


def test_sharding_takes_the_masks(root, tmp_path):
    make(root)
    cut_shards(root, tmp_path / "s", downscale=3, plan=PatchPlan(size=4), mapper=in_process)
    samples = [s for shard in read_manifest(tmp_path / "s").shards for s in read_shard(tmp_path / "s", shard)]
    assert len(samples) == PHOTOS
    for sample in samples:
        with Image.open((root / "masks" / sample.camera.name).with_suffix(".png")) as image:
            expected = np.asarray(image.resize((16, 12), Image.Resampling.BILINEAR))
        np.testing.assert_array_equal(sample.mask, expected)


def test_the_same_masks_from_any_order_of_tasks(root, tmp_path):
    make(root)
    first = contents(root / "masks")
    other = write_tiny_scene(tmp_path / "again" / "tiny", photos=PHOTOS)
    make(other, mapper=lambda fn, specs: map(fn, reversed(list(pickle.loads(pickle.dumps(specs))))))
    assert contents(other / "masks") == first


@pytest.mark.parametrize(("share", "warned"), [(0.0, True), (0.1, False), (0.9, True)])
def test_a_share_that_is_hardly_right_is_a_warning(root, share, warned, monkeypatch):
    said = []
    monkeypatch.setattr(logging.getLogger("crossray"), "warning", lambda text, *values: said.append(text % values))
    monkeypatch.setattr(Redness, "probability", lambda *_: np.full((2, 2), share, np.float32))
    assert make(root).share == pytest.approx(share, abs=0.002)
    assert bool(said) == warned


# From a probability to a mask


def test_a_mask_of_two_pixels_by_hand():
    # 4 x 2 from 2 x 2: columns at 1/4, 3/4, 5/4, 7/4 pixels of the map, so weights 1, 3/4, 1/4, 0 of its left one.
    mask = to_mask(np.array([[0.0, 1.0], [0.0, 1.0]], np.float32), (2, 1))
    np.testing.assert_array_equal(mask, [[0, 255]])
    wide = to_mask(np.array([[0.0, 1.0]] * 4, np.float32), (8, 4))
    np.testing.assert_array_equal(wide, [[0, 64, 191, 255]] * 2)


@settings(deadline=None, max_examples=50)
@given(st.tuples(*[st.integers(1, 60)] * 2), st.tuples(*[st.integers(1, 60)] * 2), st.integers(0, 2**31))
def test_a_mask_has_the_aspect_of_its_photo_and_is_no_larger(map_size, photo_size, seed):
    probability = np.random.default_rng(seed).uniform(0.2, 0.7, map_size).astype(np.float32)
    mask = to_mask(probability, photo_size)
    assert mask.dtype == np.uint8
    height, width = mask.shape
    long_side = min(max(map_size), max(photo_size))
    assert max(width, height) == long_side
    assert min(width, height) == max(1, round(min(photo_size) * long_side / max(photo_size)))
    assert mask.min() >= np.rint(255 * probability.min()) - 1
    assert mask.max() <= np.rint(255 * probability.max()) + 1


def test_every_level_survives_and_nothing_leaves_the_range():
    levels = np.arange(256, dtype=np.uint8).reshape(16, 16)
    np.testing.assert_array_equal(to_mask(levels / np.float32(255), (16, 16)), levels)
    np.testing.assert_array_equal(to_mask(np.array([[-0.5, 1.0000001, 1.5]], np.float32), (3, 1)), [[0, 255, 255]])


# Again, and after an interruption


def test_a_second_run_makes_nothing_and_changes_no_byte(root):
    make(root)
    before = contents(root / "masks")
    times = {p: p.stat().st_mtime_ns for p in (root / "masks").glob("*.*")}
    asked.clear()
    again = make(root)
    assert (again.made, asked) == (0, [])
    assert contents(root / "masks") == before
    assert {p: p.stat().st_mtime_ns for p in (root / "masks").glob("*.*")} == times


def test_an_interrupted_run_goes_on_and_ends_the_same(root, tmp_path):
    def interrupted(fn, specs):
        yield fn(specs[0])
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make(root, mapper=interrupted)
    assert not (root / "masks" / "masks.json").exists()
    assert len(list((root / "masks").glob("*.png"))) == BATCH
    (root / "masks" / ".photo_005.png.123.tmp").write_bytes(b"half")  # of a process that was killed while writing
    asked.clear()
    made = make(root)
    assert made.made == len(asked) == PHOTOS - BATCH
    assert not list((root / "masks").glob(".*.tmp"))
    uninterrupted = write_tiny_scene(tmp_path / "again" / "tiny", photos=PHOTOS)
    make(uninterrupted)
    assert contents(root / "masks") == contents(uninterrupted / "masks")


def test_a_removed_mask_a_new_photo_and_a_lost_record_are_mended(root):
    make(root)
    before = contents(root / "masks")
    (root / "masks" / "photo_001.png").unlink()
    (root / "masks" / "masks.json").unlink()
    asked.clear()
    assert make(root).made == 1
    assert asked == ["photo_001.jpg"]
    assert contents(root / "masks") == before
    Image.new("RGB", SIZE, (255, 0, 0)).save(root / "dense" / "images" / "photo_002.jpg")
    asked.clear()
    assert make(root).made == 1
    assert asked == ["photo_002.jpg"]
    assert picture(root / "masks" / "photo_002.png").min() > 250


def test_a_newer_library_is_not_another_segmenter(root, monkeypatch):
    make(root)
    described = Redness().describe(())
    monkeypatch.setattr(Redness, "describe", lambda *_: described.model_copy(update={"versions": {"x": "2"}}))
    assert make(root).made == 0


# What is not ours


def test_masks_of_another_segmenter_are_refused_and_replaced_when_asked(root):
    make(root)
    before = contents(root / "masks")
    other = Redness("more-redness")
    with pytest.raises(MaskError, match=r"10 masks of another segmenter \(photo_000.png.* and 5 more\): --replace"):
        make(root, other)
    assert contents(root / "masks") == before
    assert make(root, other, replace=True).made == PHOTOS
    assert read_masks(root / "masks").segmenter.name == "more-redness"
    assert make(root, other, replace=True).made == 0


def test_an_interrupted_replacement_leaves_no_record_that_lies(root):
    def interrupted(fn, specs):
        fn(specs[0])
        raise KeyboardInterrupt

    make(root)
    other = Redness("more-redness")
    with pytest.raises(KeyboardInterrupt):
        make(root, other, replace=True, mapper=interrupted)
    assert not (root / "masks" / "masks.json").exists()
    with pytest.raises(MaskError, match="6 masks of another segmenter"):
        make(root, other)
    assert make(root, other, replace=True).made == PHOTOS - BATCH


@pytest.mark.parametrize("content", ["mask", "not an image"])
def test_masks_made_by_others_are_kept(root, content):
    path = root / "masks" / "photo_004.png"
    path.parent.mkdir()
    if content == "mask":
        Image.new("L", SIZE, 7).save(path)
    else:
        path.write_text("not an image")
    before = path.read_bytes()
    with pytest.raises(MaskError, match=r"did not make \(photo_004.png\).*--replace"):
        make(root)
    assert path.read_bytes() == before
    assert not asked
    assert make(root, replace=True).made == PHOTOS
    np.testing.assert_array_equal(picture(path), picture(root / "dense" / "images" / "photo_004.jpg")[::2, ::2, 0])


def test_a_mask_corrected_by_hand_is_kept(root):
    make(root)
    path = root / "masks" / "photo_004.png"
    with Image.open(path) as image:  # as an editor does that keeps texts
        from PIL.PngImagePlugin import PngInfo

        text = PngInfo()
        text.add_text("crossray", image.info["crossray"])
        Image.fromarray(np.asarray(image) // 2).save(path, pnginfo=text)
    before = path.read_bytes()
    with pytest.raises(MaskError, match=r"photo_004.png was changed.*--replace"):
        make(root)
    assert path.read_bytes() == before
    assert make(root, replace=True).made == 1


def test_a_damaged_mask_is_named(root):
    make(root)
    path = root / "masks" / "photo_004.png"
    path.write_bytes(path.read_bytes()[:-30])
    with pytest.raises(MaskError, match=r"photo_004.png"):
        make(root)


@pytest.mark.parametrize("name", ["notes.txt", "photo_000.jpg.png", "other/photo_000.png"])
@pytest.mark.parametrize("replace", [True, False])
def test_files_that_are_no_masks_are_never_touched(root, name, replace):
    path = root / "masks" / name
    path.parent.mkdir(parents=True)
    path.write_text("mine")
    with pytest.raises(MaskError, match=f"{name}.*move it away"):
        make(root, replace=replace)
    assert contents(root / "masks") == {name: b"mine"}


def test_a_record_that_is_not_ours_is_kept(root):
    path = root / "masks" / "masks.json"
    path.parent.mkdir()
    path.write_text('{"annotations": []}')
    with pytest.raises(MaskError, match=r"masks.json is damaged or not ours"):
        make(root)
    assert path.read_text() == '{"annotations": []}'
    make(root, replace=True)
    assert len(read_masks(root / "masks").photos) == PHOTOS


def test_our_masks_of_photos_that_left_the_scene_may_stay(root):
    make(root)
    table = root / "tiny.tsv"
    table.write_text("".join(line for line in table.read_text().splitlines(True) if "photo_009" not in line))
    made = make(root)
    assert (made.photos, made.made) == (PHOTOS - 1, 0)
    assert "photo_009.jpg" not in read_masks(root / "masks").photos


# Photos and their names


def test_a_damaged_or_missing_photo_is_named(root):
    path = root / "dense" / "images" / "photo_003.jpg"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(MaskError, match=r"photo_003.jpg cannot be read"):
        make(root)
    assert not (root / "masks" / "photo_003.png").exists()
    path.write_bytes(whole)
    assert make(root).made == PHOTOS - 3  # photos 0 to 2 are there
    path.unlink()
    with pytest.raises(SceneError, match=r"photo_003.jpg"):
        make(root)


def test_a_photo_that_goes_while_it_is_to_be_masked_is_named(root):
    def late(fn, specs):
        (root / "dense" / "images" / "photo_006.jpg").unlink()
        return map(fn, specs)

    with pytest.raises(MaskError, match=r"photo photo_006.jpg cannot be masked"):
        make(root, mapper=late)


def test_a_photo_of_another_size_than_its_camera_is_named(root):
    Image.new("RGB", (20, 20)).save(root / "dense" / "images" / "photo_003.jpg")
    with pytest.raises(MaskError, match=r"photo_003.jpg has 20 x 20 pixels"):
        make(root)


def test_photos_in_subfolders_have_masks_in_subfolders(root):
    images = root / "dense" / "images"
    (images / "day" / "1").mkdir(parents=True)
    (images / "photo_002.jpg").rename(images / "day" / "1" / "photo_002.jpg")
    rename_photo(root, "photo_002.jpg", "day/1/photo_002.jpg")
    make(root)
    assert (root / "masks" / "day" / "1" / "photo_002.png").is_file()
    assert make(root).made == 0


@pytest.mark.parametrize("name", ["../images/photo_002.jpg", "day/../photo_002.jpg"])
def test_a_name_with_dots_is_refused(root, name):
    """The scene accepts these, for the photo is inside its folder; the first one's mask would be beside its own."""
    (root / "dense" / "images" / "day").mkdir()
    rename_photo(root, "photo_002.jpg", name)
    before = contents(root)
    with pytest.raises(MaskError, match=f"{re.escape(name)}: its mask would lie outside"):
        make(root, replace=True)
    assert contents(root) == before


def test_a_link_in_the_folder_leads_nowhere(root, tmp_path):
    images = root / "dense" / "images"
    (images / "day").mkdir()
    (images / "photo_002.jpg").rename(images / "day" / "photo_002.jpg")
    rename_photo(root, "photo_002.jpg", "day/photo_002.jpg")
    (tmp_path / "elsewhere").mkdir()
    (root / "masks").mkdir()
    (root / "masks" / "day").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(MaskError, match=r"day/photo_002.jpg: its mask would lie outside"):
        make(root, replace=True)
    assert not list((tmp_path / "elsewhere").iterdir())


def test_a_mask_that_is_a_link_is_replaced_and_not_followed(root, tmp_path):
    (tmp_path / "precious").write_text("mine")
    (root / "masks").mkdir()
    (root / "masks" / "photo_002.png").symlink_to(tmp_path / "precious")
    make(root, replace=True)
    assert (tmp_path / "precious").read_text() == "mine"
    assert not (root / "masks" / "photo_002.png").is_symlink()


def test_two_photos_cannot_share_a_mask(root):
    images = root / "dense" / "images"
    (images / "photo_002.jpg").rename(images / "photo_001.png")
    rename_photo(root, "photo_002.jpg", "photo_001.png")
    with pytest.raises(MaskError, match=r"photo_001.jpg and photo_001.png would share the mask photo_001.png"):
        make(root)


def test_a_folder_that_cannot_be_written_says_so(root):
    (root / "masks").write_text("a file")
    with pytest.raises(MaskError, match="cannot be written"):
        make(root)


# Masks made elsewhere


@pytest.fixture
def elsewhere(root, tmp_path):
    """A folder of masks of the tiny scene: some by stem and some by full name, of several sizes and modes."""
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    rng = np.random.default_rng(0)
    for i in range(PHOTOS):
        size = SIZE if i % 2 else (24, 18)
        mask = Image.fromarray(rng.integers(0, 256, size[::-1], dtype=np.uint8))
        mask.save(folder / f"photo_{i:03d}{'.mask.png' if i == 4 else '.png' if i < 4 else '.jpg.png'}")
    return folder


def test_masks_of_a_folder_are_taken_as_they_are(root, elsewhere):
    made = make(root, find_segmenter(f"folder:{elsewhere}"))
    assert made.made == PHOTOS
    for i in range(PHOTOS):
        (given_mask,) = elsewhere.glob(f"photo_{i:03d}.*")
        np.testing.assert_array_equal(picture(root / "masks" / f"photo_{i:03d}.png"), picture(given_mask))
    assert make(root, find_segmenter(f"folder:{elsewhere}")).made == 0


def test_a_mask_that_changed_in_its_folder_is_taken_again(root, elsewhere):
    segmenter = find_segmenter(f"folder:{elsewhere}")
    make(root, segmenter)
    Image.new("L", SIZE, 200).save(elsewhere / "photo_001.png")
    assert make(root, segmenter).made == 1
    assert (picture(root / "masks" / "photo_001.png") == 200).all()


def test_masks_larger_than_their_photo_are_reduced_and_sixteen_bits_become_eight(root, elsewhere):
    Image.new("L", (480, 360), 9).save(elsewhere / "photo_000.png")
    Image.fromarray(np.full(SIZE[::-1], 200 * 257, np.uint16)).save(elsewhere / "photo_001.png")
    Image.fromarray(np.full(SIZE[::-1], True)).save(elsewhere / "photo_002.png")  # one bit
    make(root, find_segmenter(f"folder:{elsewhere}"))
    for i, level in enumerate((9, 200, 255)):
        mask = picture(root / "masks" / f"photo_{i:03d}.png")
        assert mask.shape == SIZE[::-1]
        assert (mask == level).all()


def test_every_mask_that_does_not_fit_is_listed_at_once(root, elsewhere):
    (elsewhere / "photo_000.png").unlink()
    Image.new("L", (48, 48)).save(elsewhere / "photo_001.png")
    Image.new("RGB", SIZE).save(elsewhere / "photo_002.png")
    (elsewhere / "photo_003.png").write_text("not an image")
    Image.new("L", SIZE).save(elsewhere / "photo_004.jpg.png")
    (elsewhere / "photo_005.jpg.png").unlink()
    with pytest.raises(SegmenterError) as caught:
        make(root, find_segmenter(f"folder:{elsewhere}"))
    lines = [line.strip() for line in str(caught.value).splitlines()]
    assert lines[0].endswith("6 of 10 photos have no mask that fits:")
    assert lines[1:] == [
        "photo_000.jpg: no mask",
        "photo_001.jpg is 48 x 36 and photo_001.png 48 x 48",
        "photo_002.jpg: photo_002.png is RGB, not grayscale",
        "photo_003.jpg: photo_003.png is not a PNG picture",
        "photo_004.jpg: photo_004.jpg.png and photo_004.mask.png: keep one",
        "and 1 more",
    ]
    assert not (root / "masks").exists()


@pytest.mark.parametrize(("width", "fits"), [(98, True), (97, False), (102, True), (103, False)])
def test_the_aspect_may_be_off_by_two_percent(tmp_path, width, fits):
    root = write_tiny_scene(tmp_path / "tiny", photos=2, size=(100, 100))
    for i in range(2):
        Image.new("L", (width, 100), 100).save(tmp_path / f"photo_{i:03d}.png")
    if not fits:
        with pytest.raises(SegmenterError, match="2 of 2"):
            make(root, find_segmenter(f"folder:{tmp_path}"))
        return
    make(root, find_segmenter(f"folder:{tmp_path}"))
    assert max(picture(root / "masks" / "photo_000.png").shape) <= 100


def test_a_cut_off_mask_of_a_folder_is_named(root, elsewhere):
    path = elsewhere / "photo_003.png"
    path.write_bytes(path.read_bytes()[:-60])
    with pytest.raises(SegmenterError, match=r"photo_003"):
        make(root, find_segmenter(f"folder:{elsewhere}"))


def test_the_scenes_own_masks_are_not_copied_onto_themselves(root, elsewhere):
    elsewhere.rename(root / "masks")
    for path in (root / "masks").glob("*.*.png"):
        path.rename(path.with_name(path.name.split(".")[0] + ".png"))
    before = contents(root / "masks")
    segmenter = find_segmenter(f"folder:{root / 'masks'}")
    with pytest.raises(MaskError, match="there may be nothing to do"):
        make(root, segmenter)
    with pytest.raises(MaskError, match="used as they are"):
        make(root, segmenter, replace=True)
    assert contents(root / "masks") == before


# The command


@pytest.fixture
def crossray(monkeypatch, capsys):
    """crossray(*words): what the command does in this process; exit status, standard output, standard error."""
    logger = logging.getLogger("crossray")
    before = logger.handlers[:], logger.level, logger.propagate
    monkeypatch.setenv("COLUMNS", "200")

    def run(*words: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["crossray", *map(str, words)])
        try:
            cli.main()
            status = 0
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else 0
        return status, *(re.sub(r"\x1b\[[0-9;]*m", "", text) for text in capsys.readouterr())

    yield run
    logger.handlers[:], logger.level, logger.propagate = before


@pytest.fixture
def without_ray(monkeypatch):
    @contextmanager
    def mapper():
        yield in_process

    monkeypatch.setattr(tasks, "ray_tasks", mapper)


def test_the_command_masks_says_how_much_and_what_is_next(crossray, without_ray, root, elsewhere):
    status, out, _ = crossray("mask", root, "--with", f"folder:{elsewhere}")
    assert status == 0
    (line, following) = out.strip().splitlines()
    share = np.mean([picture(p).mean() / 255 for p in (root / "masks").glob("*.png")])
    assert line == f"{root}/masks: 10 photos, {100 * share:.2f} % masked on average; 10 made now"
    assert following.startswith("crossray run jobs/")
    assert f"--set scene.path={root}" in following
    assert "--set model.transient=fixed" in following
    assert "0 made now" in crossray("mask", root, "--with", f"folder:{elsewhere}")[1]


def test_the_command_refuses_with_one_message(crossray, without_ray, root, elsewhere, tmp_path):
    crossray("mask", root, "--with", f"folder:{elsewhere}")
    Image.new("L", SIZE).save(root / "masks" / "photo_000.png")
    for words, part in (
        (["--with", "deeplab"], "did you mean 'deeplabv3'?"),
        (["--with", f"folder:{tmp_path / 'nowhere'}"], "nowhere: no such folder"),
        (["--with", f"folder:{elsewhere}"], "--replace"),
    ):
        status, out, err = crossray("mask", root, *words)
        assert status == 2
        assert part in err
        assert "Traceback" not in out + err
    status, out, _ = crossray("mask", root, "--with", f"folder:{elsewhere}", "--replace")
    assert (status, "; 1 made now" in out) == (0, True)


def test_the_command_explains_itself(crossray):
    status, out, _ = crossray("mask", "--help")
    assert status == 0
    for part in ("--with", "--replace", "deeplabv3", "tflite:FILE", "folder:DIR"):
        assert part in out


# The real network on real photos


CROWD, EMPTY = "48542127_4157749181.jpg", "92342560_2757258130.jpg"


@pytest.fixture
def two_photos(test_data, tmp_path):
    """Two photos of the Reichstag: one with a crowd in front of it, one of the dome and the sky."""
    pytest.importorskip("ai_edge_litert", reason="the tflite extra is not installed")
    root = tmp_path / "reichstag"
    root.mkdir()
    (root / "dense").symlink_to(test_data / "reichstag" / "dense")
    rows = [f"{name}\t{i}\ttrain\treichstag" for i, name in enumerate((CROWD, EMPTY))]
    (root / "reichstag.tsv").write_text("\n".join(["filename\tid\tsplit\tdataset", *rows]) + "\n")
    return root


@pytest.mark.real
@pytest.mark.slow  # starts Ray
def test_the_tflite_network_finds_the_crowd(crossray, two_photos, test_data):
    network = test_data / "segmentation" / "deeplabv3_257_mv_gpu.tflite"
    status, out, err = crossray("mask", two_photos, "--with", f"tflite:{network}")
    assert status == 0, err
    assert "2 photos" in out
    crowd, empty = (picture((two_photos / "masks" / name).with_suffix(".png")) / 255 for name in (CROWD, EMPTY))
    assert crowd.shape == (190, 257)  # 1052 x 777, its longer side the network's
    assert 0.1 < crowd.mean() < 0.3
    assert crowd[120:, 150:].mean() > 0.5  # the people in front, at the right
    assert crowd[:100].mean() < 0.02  # the building and the sky
    assert empty.mean() < 0.005
    record = read_masks(two_photos / "masks")
    assert record.segmenter.sha256 == hashlib.sha256(network.read_bytes()).hexdigest()
    assert record.segmenter.classes["bicycle"] == 2  # misspelt in the file beside the model
    assert make(two_photos, TFLite(network)).made == 0  # in another process, from the same network
