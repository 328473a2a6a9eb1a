"""From photos to a posed scene, on a landmark whose true poses are known, and on real photos."""

from __future__ import annotations

import json
import logging
import shutil
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.colmap import import_pycolmap
from pipeline.errors import CrossrayError
from pipeline.ingest import ingest
from pipeline.ingest.child import in_child
from pipeline.landmark import Landmark, write_landmark
from pipeline.scene import read_scene

SIZE = 512


@pytest.fixture(scope="module")
def landmark(tmp_path_factory):
    root = tmp_path_factory.mktemp("ingest")
    write_landmark(root / "landmark", train=24, val=1, test=1, size=SIZE)
    return root / "landmark"


@pytest.fixture(scope="module")
def folder(landmark):
    """The landmark's photos among files that are none, and two photos of noise, which overlap with nothing."""
    folder = landmark.parent / "photos"
    shutil.copytree(landmark / "dense" / "images", folder)
    (folder / "bill.pdf").write_bytes(b"%PDF-1.4 ...")
    (folder / "phone.heic").write_bytes(b"\0\0\0\x18ftypheic" + b"\0" * 50)
    Image.new("RGB", (1, 1)).save(folder / "dot.png")
    shutil.copy(folder / "00003.png", folder / "again.png")
    for seed in (1, 2):
        noise = np.random.default_rng(seed).integers(0, 256, (60, 80, 3), dtype=np.uint8)
        Image.fromarray(noise).resize((320, 240)).save(folder / f"noise{seed}.jpg")
    return folder


class Stopped(Exception):
    """Stands for the power cut after a step."""


@pytest.fixture(scope="module")
def stopped(folder):
    """An ingest that is stopped after each of its native steps, and started again until it is done: how often each
    step was done."""
    done: Counter[str] = Counter()

    def native(fn, *args, **options):
        in_child(fn, *args, **options)
        step = f"{fn.__name__} {args[-1]}" if fn.__name__ == "run_try" else fn.__name__
        done[step] += 1
        if done[step] == 1:
            raise Stopped

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pipeline.ingest.run.in_child", native)
        for _ in range(20):
            try:
                ingest(folder, folder.parent / "scene", mapper=map)
                break
            except Stopped:
                continue
    return done


@pytest.fixture(scope="module")
def scene(folder, stopped):
    return folder.parent / "scene"


@pytest.mark.slow
def test_no_step_is_done_twice_however_often_it_is_stopped(scene, stopped):
    assert stopped.pop("match") <= 2  # stopped before it was marked as done: COLMAP leaves out the pairs that are there
    assert {"make_database", "run_try 0", "run_try 1", "undistort"} <= stopped.keys()
    assert set(stopped.values()) == {1}


def angles(a, b):
    """Degrees between the relative rotations of all pairs of two lists of rotations."""
    a, b = np.stack(a), np.stack(b)
    relative = [(x[:, None] @ x[None].swapaxes(-1, -2)) for x in (a, b)]
    trace = np.einsum("ijkl,ijkl->ij", *relative)
    return np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))[np.triu_indices(len(a), 1)]


def off(centres, true):
    """Distances of centres (n, 3) from the true ones after the similarity that fits best, in shares of the extent."""
    a, b = centres - centres.mean(0), true - true.mean(0)
    u, s, v = np.linalg.svd(b.T @ a)
    signs = np.array([1, 1, np.sign(np.linalg.det(u @ v))])
    scale = (s * signs).sum() / (a**2).sum()
    return np.linalg.norm(scale * a @ (u * signs @ v).T - b, axis=1) / np.linalg.norm(b, axis=1).max()


@pytest.mark.slow
def test_the_landmark_is_posed(landmark, scene):
    truth, read = Landmark.read(landmark), read_scene(scene)
    assert len(read.photos) >= 23
    assert read.photos[0].split == "test"
    assert read.photos[1].split == "train"
    names = [p.name for p in read.photos]
    assert set(names) <= set(truth.names())
    cameras = [truth.camera(n) for n in names]
    errors = angles([p.c2w[:, :3].T for p in read.photos], [np.array(c.rotation) for c in cameras])
    assert np.median(errors) < 2
    assert np.median(off(np.stack([p.c2w[:, 3] for p in read.photos]), np.array([c.centre for c in cameras]))) < 0.05


@pytest.mark.slow
def test_what_became_of_each_file(folder, scene):
    summary = json.loads((scene / "ingest" / "summary.json").read_text())
    files = {p.name for p in folder.iterdir()}
    assert set(summary["registered"].values()) | set(summary["rejected"]) == files
    rejected = summary["rejected"]
    assert "PDF" in rejected["bill.pdf"]
    assert "HEIC" in rejected["phone.heic"]
    assert "too small" in rejected["dot.png"]
    assert rejected["again.png"] == "the same picture as 00003.png"
    assert rejected["noise1.jpg"].startswith("no overlap")
    assert Image.open(scene / "ingest" / "cameras.png").size[0] > 500


@pytest.mark.slow
def test_no_pixel_is_black_by_undistortion(scene):
    pycolmap = import_pycolmap()
    model = pycolmap.Reconstruction(str(scene / "dense" / "sparse"))
    assert {c.model.name for c in model.cameras.values()} == {"PINHOLE"}
    for image in model.images.values():
        with Image.open(scene / "dense" / "images" / image.name) as photo:
            camera = model.cameras[image.camera_id]
            assert photo.size == (camera.width, camera.height)
            pixels = np.asarray(photo.convert("RGB")).max(2)
        assert max((side < 4).mean() for side in (pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1])) < 0.2


@pytest.mark.slow
def test_the_same_again_does_nothing(folder, scene, caplog):
    before = {p: p.stat().st_mtime_ns for p in scene.rglob("*") if p.is_file() and p.name != ".lock"}
    logging.getLogger("crossray").propagate = True
    with caplog.at_level("INFO"):
        ingest(folder, scene, mapper=map)
    assert "nothing to do" in caplog.text
    assert before == {p: p.stat().st_mtime_ns for p in scene.rglob("*") if p.is_file() and p.name != ".lock"}


@pytest.mark.slow
def test_other_options_or_photos_are_refused(folder, scene):
    with pytest.raises(CrossrayError, match="matching auto there, nearest asked"):
        ingest(folder, scene, mapper=map, matching="nearest")
    (folder / "late.jpg").write_bytes(b"x")
    try:
        with pytest.raises(CrossrayError, match="something else"):
            ingest(folder, scene, mapper=map)
    finally:
        (folder / "late.jpg").unlink()


@pytest.mark.slow
def test_out_as_transforms_and_in_again(scene, tmp_path):
    """The poses come back as they were; the points are triangulated anew."""
    ingest(scene / "transforms.json", tmp_path / "again", mapper=map)
    first, again = (read_scene(s) for s in (scene, tmp_path / "again"))
    suffix = "dense_images_"
    ours = {p.name: p for p in first.photos}
    assert len(again.photos) >= 0.8 * len(ours)
    for photo in again.photos:
        before = ours[photo.name.removeprefix(suffix)]
        np.testing.assert_allclose(photo.c2w[:, :3], before.c2w[:, :3], atol=1e-5)
        np.testing.assert_allclose(photo.c2w[:, 3] * again.scale, before.c2w[:, 3] * first.scale, atol=1e-4)
        assert photo.intrinsics == pytest.approx(before.intrinsics)


def noise(path, seed):
    pixels = np.random.default_rng(seed).integers(0, 256, (12, 16, 3), dtype=np.uint8)
    Image.fromarray(pixels).resize((128, 96)).save(path)


@pytest.mark.slow
def test_no_overlap_is_one_message_and_no_scene(tmp_path):
    (tmp_path / "photos").mkdir()
    for seed in range(3):
        noise(tmp_path / "photos" / f"{seed}.png", seed)
    with pytest.raises(CrossrayError, match=r"no sound model of the photos(.|\n)*default: no model(.|\n)*seed-2"):
        ingest(tmp_path / "photos", tmp_path / "scene", mapper=map)
    assert [p.name for p in (tmp_path / "scene").iterdir()] == ["ingest"]


def test_where_the_scene_may_not_go(tmp_path):
    photos = tmp_path / "photos"
    photos.mkdir()
    for seed in range(3):
        noise(photos / f"{seed}.png", seed)
    (tmp_path / "file").write_text("x")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("x")
    for out, message in (
        (tmp_path / "file", "is a file"),
        (tmp_path / "full", "holds thesis.tex"),
        (photos / "scene", "is in the folder of the photos"),
        (tmp_path / "file" / "scene", "cannot be written"),
        (Path("/proc/scene"), "cannot be written"),
    ):
        with pytest.raises(CrossrayError, match=message):
            ingest(photos, out, mapper=map)
    assert (tmp_path / "full" / "thesis.tex").read_text() == "x"
    with pytest.raises(CrossrayError, match="--test-every 1"):
        ingest(photos, tmp_path / "scene", mapper=map, test_every=1)
    with pytest.raises(CrossrayError, match="--matching all: there are auto"):
        ingest(photos, tmp_path / "scene", mapper=map, matching="all")


@pytest.mark.slow
@pytest.mark.real
def test_sacre_coeur_mixed_with_another_place(test_data, landmark, tmp_path):
    """All ten real photos are posed as in the known model; those of the other place are named."""
    photos = tmp_path / "photos"
    shutil.copytree(test_data / "sacre_coeur" / "images", photos)
    for name in ("00000.png", "00001.png", "00002.png", "00003.png"):
        shutil.copy(landmark / "dense" / "images" / name, photos / name)
    summary = ingest(photos, tmp_path / "scene", mapper=map)
    assert len(summary.registered) == 10
    assert summary.rejected.keys() == {"00000.png", "00001.png", "00002.png", "00003.png"}
    pycolmap = import_pycolmap()
    known = pycolmap.Reconstruction(str(test_data / "sacre_coeur" / "sparse"))
    ours = {i.name: i for i in pycolmap.Reconstruction(str(tmp_path / "scene" / "dense" / "sparse")).images.values()}
    pairs = [(i, ours[i.name]) for i in known.images.values()]
    rotations = [[i.cam_from_world().rotation.matrix() for i in one] for one in zip(*pairs, strict=True)]
    assert angles(*rotations).max() < 0.5
    centres = [np.stack([i.projection_center() for i in one]) for one in zip(*pairs, strict=True)]
    assert off(centres[1], centres[0]).max() < 0.02
    for before, after in pairs:
        assert after.camera.focal_length_x == pytest.approx(before.camera.focal_length_x, rel=0.03)
