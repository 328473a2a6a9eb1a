"""Posed scenes: every layout and split table that we read, the golden cameras and bounds, and models that are
wrong.
"""

from __future__ import annotations

import logging
import math
import shlex
import shutil
import subprocess
import sys

import numpy as np
import pytest
from tiny_scene import RADIUS, STEP, photo_names, tiny_points, write_tiny_scene

from pipeline.scene import (
    SceneError,
    check_model,
    find_model,
    find_table,
    fingerprint,
    is_collapsed,
    photo_key,
    read_scene,
)


@pytest.fixture
def root(tmp_path):
    return write_tiny_scene(tmp_path / "tiny")


def edit(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def test_cameras_bounds_and_scale_by_hand(root):
    scene = read_scene(root)
    assert scene.name == "tiny"
    assert scene.num_points == 60
    assert [p.name for p in scene.photos] == photo_names(6)
    assert [p.split for p in scene.photos] == ["train", "train", "train", "test", "train", "train"]
    points, fars = tiny_points(), []
    for i, photo in enumerate(scene.photos):
        a = i * STEP
        z = RADIUS + points @ [-math.sin(-a), 0, math.cos(-a)]
        near, far = np.percentile(z, [0.1, 99.9])
        fars.append(far)
        assert photo.image_id == 6 - i
        assert photo.intrinsics == (48.0, 48.0, 24.0, 18.0)
        assert photo.near * scene.scale == pytest.approx(near, rel=1e-6)
        assert photo.far * scene.scale == pytest.approx(far, rel=1e-6)
        centre = np.array([-math.sin(a), 0, -math.cos(a)]) * RADIUS / scene.scale
        np.testing.assert_allclose(photo.c2w[:, 3], centre, atol=1e-6)
        np.testing.assert_allclose(photo.c2w[:, 2], -centre / np.linalg.norm(centre), atol=1e-6)
        assert photo.c2w.dtype == np.float32
    assert scene.scale == pytest.approx(max(fars) / 5, rel=1e-6)
    np.testing.assert_allclose(scene.box, np.percentile(points, [1, 99], axis=0) / scene.scale, rtol=1e-5)


def test_a_shared_camera_is_found_by_its_own_id(tmp_path):
    scene = read_scene(write_tiny_scene(tmp_path / "s", shared_camera=True))
    assert {p.intrinsics for p in scene.photos} == {(48.0, 48.0, 24.0, 18.0)}


@pytest.mark.parametrize("layout", ["sparse", "sparse/0", "dense/sparse", "dense/sparse/0", "."])
@pytest.mark.parametrize("binary", [False, True])
def test_every_layout_reads_the_same(tmp_path, root, layout, binary):
    import pycolmap

    before = read_scene(root)
    images = "dense/images" if layout.startswith("dense") else "images"
    moved = tmp_path / "moved"
    shutil.copytree(root / "dense" / "images", moved / images)
    shutil.copy(root / "tiny.tsv", moved)
    (moved / layout).mkdir(parents=True, exist_ok=True)
    model = pycolmap.Reconstruction(str(root / "dense" / "sparse"))
    (model.write_binary if binary else model.write_text)(str(moved / layout))
    after = read_scene(moved)
    assert after.scale == pytest.approx(before.scale, rel=1e-9)
    assert [(p.key, p.split) for p in after.photos] == [(p.key, p.split) for p in before.photos]
    for a, b in zip(after.photos, before.photos, strict=True):
        np.testing.assert_allclose(a.c2w, b.c2w, atol=1e-6)


def test_the_largest_of_several_models_is_read_and_named(tmp_path, root, caplog):
    small = write_tiny_scene(tmp_path / "small", photos=3)
    sparse = root / "dense" / "sparse"
    sparse.rename(root / "dense" / "one")
    sparse.mkdir()
    shutil.copytree(small / "dense" / "sparse", sparse / "0")
    (root / "dense" / "one").rename(sparse / "1")
    with caplog.at_level(logging.INFO, "crossray"):
        assert len(read_scene(root).photos) == 6
    assert "dense/sparse/1" in caplog.text.split("reading")[1]


def test_the_other_column_order_empty_ids_and_photos_without_pose(root, caplog):
    names = photo_names(6)
    rows = ["id\tsplit\tfilename\tdataset", f"7\ttest\t{names[0]}\tx", f"\ttrain\t{names[1]}\tx"]
    rows += [f"8\ttrain\t{names[2]}\tx", f"9\tval\t{names[4]}\tx", "10\ttrain\tlost.jpg\tx"]
    (root / "tiny.tsv").write_text("\n".join(rows) + "\n")
    with caplog.at_level(logging.INFO, "crossray"):
        scene = read_scene(root)
    assert {p.name: p.split for p in scene.photos} == {names[0]: "test", names[2]: "train", names[4]: "val"}
    assert [p.key[:7] for p in scene.photos] == ["000000-", "000001-", "000002-"]
    assert "1 rows without an id" in caplog.text
    assert any(r.levelno == logging.WARNING and "lost.jpg" in r.getMessage() for r in caplog.records)


def test_without_a_table_every_eighth_photo_is_for_testing(tmp_path):
    scene = read_scene(write_tiny_scene(tmp_path / "s", photos=10, tsv=False))
    assert scene.name == "s"
    assert [i for i, p in enumerate(scene.photos) if p.split == "test"] == [0, 8]


def test_the_scale_is_that_of_the_photos_kept(root):
    rows = "\n".join(f"{n}\t1\ttrain\tx" for n in photo_names(6)[:2])
    (root / "tiny.tsv").write_text("filename\tid\tsplit\tdataset\n" + rows + "\n")
    scene = read_scene(root)
    assert max(p.far for p in scene.photos) == pytest.approx(5, rel=1e-6)


@pytest.mark.parametrize(
    ("row", "words"),
    [("x.jpg\t1\ttest\tx", "no photo is left"), ("photo_000.jpg\t1\ttest\tx", "no training photo")],
)
def test_nothing_to_train_on_is_an_error(root, row, words):
    (root / "tiny.tsv").write_text("filename\tid\tsplit\tdataset\n" + row + "\n")
    with pytest.raises(SceneError, match=words):
        read_scene(root)


def test_tables_that_cannot_be_read_are_named(root):
    shutil.copy(root / "tiny.tsv", root / "other.tsv")
    with pytest.raises(SceneError, match=r"other\.tsv, tiny\.tsv"):
        read_scene(root)
    (root / "other.tsv").unlink()
    edit(root / "tiny.tsv", "1002.0\ttrain", "1002.0\ttraining")
    with pytest.raises(SceneError, match=r"line 4.*training.*photo_002"):
        read_scene(root)
    edit(root / "tiny.tsv", "filename\tid\tsplit", "filename\tid\tpart")
    with pytest.raises(SceneError, match="no column split"):
        read_scene(root)


@pytest.mark.parametrize(
    ("kind", "parameters", "words"),
    [
        ("SIMPLE_PINHOLE", "48 24 18", None),
        ("SIMPLE_RADIAL", "48 24 18 0", None),
        ("RADIAL", "48 24 18 0 0", None),
        ("OPENCV", "48 48 24 18 0 0 0 0", None),
        (
            "SIMPLE_RADIAL",
            "48 24 18 0.01",
            r"(?s)camera 102 of photo photo_002.jpg is distorted \(k=0.01\).*undistort_images",
        ),
        ("OPENCV", "48 48 24 18 0 0 0.1 0", r"k=0, 0, 0.1, 0"),
        ("SIMPLE_RADIAL_FISHEYE", "48 24 18 0", "not a pinhole"),
    ],
)
def test_only_undistorted_cameras_pass(root, kind, parameters, words):
    edit(
        root / "dense/sparse/cameras.txt",
        "102 PINHOLE 48 36 48.0 48.0 24.0 18.0",
        f"102 {kind} 48 36 {parameters}",
    )
    if words is None:
        assert read_scene(root).photos[2].intrinsics == (48.0, 48.0, 24.0, 18.0)
    else:
        with pytest.raises(SceneError, match=words):
            read_scene(root)


def test_missing_parts_are_named(tmp_path, root):
    with pytest.raises(SceneError, match="no such folder"):
        read_scene(tmp_path / "nowhere")
    (root / "dense/images/photo_004.jpg").unlink()
    with pytest.raises(SceneError, match=r"photo photo_004\.jpg"):
        read_scene(root)
    shutil.rmtree(root / "dense/images")
    with pytest.raises(SceneError, match="no photos"):
        read_scene(root)
    (root / "dense/sparse/points3D.txt").unlink()
    with pytest.raises(SceneError, match="no COLMAP model"):
        read_scene(root)


def test_a_photo_outside_the_scene_is_refused(root, tmp_path):
    (tmp_path / "secret.jpg").write_bytes(b"x")
    edit(root / "dense/sparse/images.txt", "photo_001.jpg", "../../../secret.jpg")
    edit(root / "tiny.tsv", "photo_001.jpg", "../../../secret.jpg")
    with pytest.raises(SceneError, match=r"secret\.jpg"):
        read_scene(root)


@pytest.mark.parametrize("name", ["a" * 300 + ".jpg", "photo.of.002.jpg", "photo 002.jpg", "Brücke in Köln.jpg"])
def test_any_name_of_a_photo_is_read_or_refused_by_name(root, name):
    import pycolmap

    sparse = root / "dense" / "sparse"
    model = pycolmap.Reconstruction(str(sparse))
    next(image for image in model.images.values() if image.name == "photo_002.jpg").name = name
    for path in sparse.iterdir():
        path.unlink()
    model.write_binary(str(sparse))  # in COLMAP's text format a blank ends a name
    edit(root / "tiny.tsv", "photo_002.jpg", name)
    if len(name) < 256:
        photo = root / "dense/images/photo_002.jpg"
        photo.rename(photo.with_name(name))
        assert name in [p.name for p in read_scene(root).photos]
    else:
        with pytest.raises(SceneError, match=r"photo aaa.* is not in .*images; put it there"):
            read_scene(root)


def test_two_photos_of_one_name_are_refused(root):
    edit(root / "dense/sparse/images.txt", "photo_002.jpg", "photo_001.jpg")
    with pytest.raises(SceneError, match=r"images 5 and 4 are both named photo_001\.jpg|cannot be read"):
        read_scene(root)


def test_photos_may_be_left_out(root):
    whole = read_scene(root)
    (root / "dense/images/photo_004.jpg").unlink()
    scene = read_scene(root, without={"photo_001.jpg": "torn", "nobody.jpg": "never there"}, drop_missing=True)
    assert scene.dropped == {"photo_001.jpg": "torn", "photo_004.jpg": "photo photo_004.jpg is missing"}
    splits = {p.name: p.split for p in whole.photos}
    assert {p.name: p.split for p in scene.photos} == {n: s for n, s in splits.items() if n not in scene.dropped}
    with pytest.raises(SceneError, match=r"no training photo .* were left out, .*\(torn\)"):
        read_scene(root, without=dict.fromkeys(splits, "torn"))


def test_a_model_cut_short_is_an_error_that_names_it(root):
    import pycolmap

    sparse = root / "dense" / "sparse"
    pycolmap.Reconstruction(str(sparse)).write_binary(str(sparse))
    for path in sparse.glob("*.txt"):
        path.unlink()
    content = (sparse / "points3D.bin").read_bytes()
    (sparse / "points3D.bin").write_bytes(content[: len(content) // 2])
    with pytest.raises(SceneError, match=r"dense/sparse.*cannot be read"):
        read_scene(root)


def test_models_that_are_wrong_are_refused_before_photos_are_looked_for(root):
    shutil.rmtree(root / "dense" / "images")
    sparse = root / "dense" / "sparse"
    cameras, images, points = (sparse / f"{n}.txt" for n in ("cameras", "images", "points3D"))
    healthy = {p: p.read_text() for p in (cameras, images, points)}

    edit(cameras, "103 PINHOLE 48 36 48.0 48.0", "103 PINHOLE 48 36 48.0 -48.0")
    with pytest.raises(SceneError, match=r"camera 103 of photo photo_003\.jpg has a focal length of -1"):
        read_scene(root)
    cameras.write_text(healthy[cameras])

    points.write_text("")
    lines = healthy[images].splitlines()
    images.write_text("\n".join("" if i % 2 else line for i, line in enumerate(lines)) + "\n")
    with pytest.raises(SceneError, match="no 3-D points"):
        read_scene(root)

    points.write_text("\n".join(line.rsplit(" ", 2)[0] for line in healthy[points].splitlines()) + "\n")
    images.write_text("\n".join("" if i == 11 else line for i, line in enumerate(lines)) + "\n")
    with pytest.raises(SceneError, match=r"photo_005\.jpg is registered and sees no 3-D point"):
        read_scene(root)


def test_collapsed_cameras_are_told_from_cameras_on_a_circle():
    angles = np.linspace(0, 1, 9)
    circle = np.stack([np.sin(angles), np.zeros(9), np.cos(angles)], axis=1)
    points = np.random.default_rng(0).normal(size=(50, 3))
    assert not is_collapsed(circle, points)
    assert not is_collapsed(circle[:1], points)
    assert is_collapsed(circle * 1e-4, points)  # no baseline
    assert is_collapsed(np.concatenate([circle * 1e-4, [[1, 0, 0]]]), points * 1e-4)  # one outlier stretches the scene


def test_keys_are_short_plain_and_in_order():
    assert photo_key(12, "Sub.Folder/Crème Brûlée (1).JPG") == "000012-cr-me-br-l-e-1-"
    assert len(photo_key(1, "a" * 300 + ".jpg")) == 47


@pytest.mark.real
@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("sacre_coeur14", "camera|photo"),
        ("piazza9_collapsed", "camera|photo"),
        ("sacre_coeur15_15of15", "camera|photo"),
        ("piazza9_empty_view", "camera|photo"),
    ],
)
def test_real_degenerate_models_are_refused(test_data, name, words):
    with pytest.raises(SceneError, match=words) as refusal:
        read_scene(test_data / "degenerate_colmap" / name)
    assert "no photos" not in str(refusal.value)


@pytest.mark.real
def test_real_collapsed_centres_are_seen_without_the_focal_lengths(test_data):
    import pycolmap

    def centres_and_points(folder):
        model = pycolmap.Reconstruction(str(test_data / folder))
        images = [model.images[i] for i in model.reg_image_ids()]
        return np.stack([i.projection_center() for i in images]), np.stack([p.xyz for p in model.points3D.values()])

    assert is_collapsed(*centres_and_points("degenerate_colmap/piazza9_collapsed/sparse"))
    assert not is_collapsed(*centres_and_points("sacre_coeur/sparse"))
    assert not is_collapsed(*centres_and_points("reichstag/dense/sparse"))


@pytest.mark.real
def test_real_raw_photos_are_healthy_and_distorted(test_data):
    import pycolmap

    check_model(pycolmap.Reconstruction(str(test_data / "sacre_coeur" / "sparse")))
    with pytest.raises(SceneError, match=r"is distorted \(k=0\.0"):
        read_scene(test_data / "sacre_coeur")


@pytest.mark.real
@pytest.mark.slow
def test_the_command_that_undistorts_makes_a_scene(test_data, tmp_path):
    raw = tmp_path / "raw photos"
    shutil.copytree(test_data / "sacre_coeur", raw, copy_function=shutil.copyfile)
    with pytest.raises(SceneError) as refusal:
        read_scene(raw)
    command = str(refusal.value).splitlines()[-1].strip()
    assert command.startswith("python -c ")
    subprocess.run(command.replace("python", shlex.quote(sys.executable), 1), shell=True, check=True)
    scene = read_scene(raw)
    assert len(scene.photos) == 8  # of 10: two have no id in the split table


@pytest.mark.real
def test_real_split_tables_of_six_scenes(test_data, caplog):
    from pipeline.scene import read_splits

    counts = {
        "brandenburg": (763, 10),
        "sacre": (830, 21),
        "trevi": (1689, 19),
        "hagia": (835, 29),
        "prague": (2083, 27),
        "taj_mahal": (899, 27),
    }
    for name, (train, test) in counts.items():
        table = test_data / "nerfw_splits" / f"{name}.tsv"
        cells = {cell for line in table.read_text().splitlines() for cell in line.split("\t")}
        splits = list(read_splits(table, dict.fromkeys(cells)).values())
        assert (splits.count("train"), splits.count("test")) == (train, test), name


@pytest.mark.real
def test_golden_colmap_scene(test_data, golden):
    expected = golden("colmap_scene")
    scene = read_scene(test_data / "reichstag")
    assert scene.name == "reichstag"
    assert scene.num_points == expected["out/num_points"].item()
    assert scene.scale == pytest.approx(expected["out/scale_factor"].item(), abs=1e-5)
    photos = {p.name: p for p in scene.photos}
    assert len(photos) == 74
    for i, name in enumerate(expected["in/image_names"]):
        photo = photos[str(name)]
        assert photo.split == expected["in/split"][i]
        assert photo.image_id == expected["in/image_ids"][i]
        right_up_back = photo.c2w * np.array([1, -1, -1, 1], np.float32)
        np.testing.assert_allclose(right_up_back, expected["out/c2w"][i], rtol=0, atol=3e-6)
        assert photo.near == pytest.approx(expected["out/near"][i].item(), abs=3e-6)
        assert photo.far == pytest.approx(expected["out/far"][i].item(), abs=3e-6)


def test_the_fingerprint_is_that_of_all_files_that_pose_the_photos(tmp_path):
    write_tiny_scene(tmp_path / "scene", photos=3)
    folder = find_model(tmp_path / "scene")[0]
    before = fingerprint(tmp_path / "scene")
    assert fingerprint(tmp_path / "scene") == before
    (folder / "frames.bin").write_bytes(b"1")
    other = fingerprint(tmp_path / "scene")
    assert other != before
    (folder / "frames.bin").write_bytes(b"2")
    assert fingerprint(tmp_path / "scene") not in (before, other)


def test_links_in_a_circle_are_no_photos(tmp_path):
    write_tiny_scene(tmp_path / "scene", photos=3)
    photo = read_scene(tmp_path / "scene").photos[0].path
    photo.unlink()
    photo.symlink_to(photo.name)
    with pytest.raises(SceneError, match=photo.name):
        read_scene(tmp_path / "scene")


def test_a_quote_in_the_split_table_is_a_letter(tmp_path):
    write_tiny_scene(tmp_path / "scene", photos=3)
    table = find_table(tmp_path / "scene")
    names = [photo.name for photo in read_scene(tmp_path / "scene").photos]
    head, *rows = table.read_text().splitlines(keepends=True)
    table.write_text("".join([head, '"not-there.jpg\t9\ttrain\ttiny\n', *rows]))
    assert [photo.name for photo in read_scene(tmp_path / "scene").photos] == names
