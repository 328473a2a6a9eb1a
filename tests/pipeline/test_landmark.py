"""The built-in landmark: same bytes always, and its truth is true."""

from __future__ import annotations

import hashlib
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from pipeline.errors import CrossrayError
from pipeline.landmark import Landmark, draw_photo, write_landmark
from pipeline.landmark import collection as landmark
from pipeline.landmark.light import draw_light, draw_response
from pipeline.landmark.photo import depth_map, photograph
from pipeline.landmark.scene import solids
from pipeline.landmark.tracer import (
    Pinhole,
    box,
    checker,
    ellipsoid,
    frustum,
    plain,
    pulse,
    sunlit,
    tapered,
    trace_grid,
    trace_points,
)

SMALL = {"train": 8, "val": 2, "test": 2, "size": 40, "seed": 3}
GREY = plain((0.5, 0.5, 0.5))
# At (0, -6, 0.5), looking along +y, level: rows of the rotation are right, down, forward.
LEVEL = Pinhole(64, 48, 64.0, 60.0, 32.0, 24.0, ((1, 0, 0), (0, 0, -1), (0, 1, 0)), (0.0, -6.0, 0.5))


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Landmark:
    return Landmark.read(write_landmark(tmp_path_factory.mktemp("landmark"), **SMALL))


def tree_hash(root: Path) -> dict[str, str]:
    return {
        str(p.relative_to(root)): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(root.rglob("*"))
        if p.is_file()
    }


def picture(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path))


# ---- the tracer, by hand


def hit_one(solid, origin, direction):
    o, d = (tuple(np.array([x], np.float32) for x in v) for v in (origin, direction))
    t = solid.hit(o, d)
    return float(t[0]), tuple(a + b * np.where(np.isinf(t), 0, t) for a, b in zip(o, d, strict=True))


@pytest.mark.parametrize(
    ("solid", "origin", "direction", "t", "normal"),
    [
        (box(-1, 1, -1, 1, 0, 2, GREY), (0.5, -4, 1), (0, 1, 0), 3.0, (0, -1, 0)),
        (box(-1, 1, -1, 1, 0, 2, GREY), (0, 0, 5), (0, 0, -2), 1.5, (0, 0, 1)),
        (ellipsoid((0, 0, 0), (1, 2, 1), GREY), (0, -5, 0), (0, 1, 0), 3.0, (0, -1, 0)),
        (ellipsoid((0, 0, 0), (1, 2, 1), GREY, yaw=math.pi / 2), (0, -5, 0), (0, 1, 0), 4.0, (0, -1, 0)),
        (frustum((0, 0), 0, 2, 1, 1, GREY), (-3, 0, 1), (1, 0, 0), 2.0, (-1, 0, 0)),
        (frustum((0, 0), 0, 2, 1, 0, GREY), (-3, 0, 1), (1, 0, 0), 2.5, (-2 / 5**0.5, 0, 1 / 5**0.5)),
        (frustum((0, 0), 0, 2, 1, 0.5, GREY), (0.2, 0, 3), (0, 0, -1), 1.0, (0, 0, 1)),
        (tapered((0, 0), 0, 0, 1, (2, 2), (1, 2), GREY), (-3, 0, 0.5), (1, 0, 0), 2.25, (-2 / 5**0.5, 0, 1 / 5**0.5)),
        (tapered((0, 0), 0, 0, 1, (2, 2), (2, 2), GREY, shift=0.5), (-3, 0, 0.5), (1, 0, 0), 2.25,
         (-2 / 5**0.5, 0, 1 / 5**0.5)),
    ],
)  # fmt: skip
def test_a_ray_meets_a_solid_where_geometry_says(solid, origin, direction, t, normal):
    found, point = hit_one(solid, origin, direction)
    assert found == pytest.approx(t, abs=1e-5)
    assert np.ravel(solid.normal(point)) == pytest.approx(normal, abs=1e-4)


@pytest.mark.parametrize(
    "solid", [box(-1, 1, -1, 1, 0, 2, GREY), ellipsoid((0, 0, 1), (1, 1, 1), GREY), frustum((0, 0), 0, 2, 1, 1, GREY)]
)
@pytest.mark.parametrize(
    ("origin", "direction"), [((3, 3, 1), (0, 1, 0)), ((0, -4, 1), (0, -1, 0)), ((0, 4, 3), (0, -1, 0))]
)
def test_a_ray_that_passes_by_or_leaves_misses(solid, origin, direction):
    assert hit_one(solid, origin, direction)[0] == math.inf


def test_what_stands_between_a_point_and_the_sun_shades_it():
    post = box(-0.1, 0.1, -0.1, 0.1, 0, 1, GREY)
    points = tuple(np.array(v, np.float32) for v in ([0.5, 1.5, -0.5, 0.5], [0, 0, 0, 0.3], [0, 0, 0, 0]))
    low = math.sqrt(0.5)  # the sun stands 45 degrees high over -x: the shadow reaches x = 1.1
    assert sunlit(points, [post], (-low, 0.0, low)).tolist() == [False, True, True, True]


def test_scattered_and_gridded_rays_agree():
    grid = trace_grid(LEVEL, solids(), 1)
    v, u = np.mgrid[0:48, 0:64] + 0.5
    points = trace_points(LEVEL, solids(), u.ravel(), v.ravel())
    assert np.array_equal(points.t, grid.t.ravel())


@settings(deadline=None, max_examples=25)
@given(st.floats(-5, 5), st.floats(0.05, 3), st.floats(0.1, 0.9), st.floats(0.3, 2))
def test_pulse_is_the_average_of_stripes_over_the_footprint(x, w, duty, period):
    fine = x - w / 2 + (np.arange(20000) + 0.5) * (w / 20000)
    assert pulse(np.array(x), period, duty, w) == pytest.approx((fine / period % 1 < duty).mean(), abs=2e-3)


def test_a_board_seen_from_far_away_is_even():
    x = np.linspace(0, 10, 50)
    assert checker(x, 0.1, 0.5, 1e-3, 1e-3).std() > 0.3
    assert checker(x, 0.1, 0.5, 49.7, 0.01).std() < 0.02


# ---- files


def test_same_seed_same_bytes_however_the_photos_are_batched(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(landmark, "BATCH", 5)
    again = write_landmark(tmp_path / "again", **SMALL, mapper=lambda fn, specs: map(fn, reversed(list(specs))))
    assert tree_hash(again) == tree_hash(scene.root)


def test_another_seed_makes_other_photos(scene):
    a, b = (draw_photo(seed, 0, "train", 40, 0.0) for seed in (3, 4))
    assert a == scene.record("00000.png")
    assert a.camera != b.camera
    assert a.light != b.light


@pytest.mark.slow
def test_an_interrupted_run_is_finished_to_the_same_bytes(scene, tmp_path):
    def dies(fn, specs):
        yield fn(next(iter(specs)))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_landmark(tmp_path, **SMALL, mapper=dies)
    with pytest.raises(CrossrayError, match="no complete landmark"):
        Landmark.read(tmp_path)
    (tmp_path / "truth" / "00001.clean.png").unlink()
    (tmp_path / "dense" / "images" / ".00004.png.77.tmp").write_bytes(b"half a pho")
    kept = tmp_path / "dense" / "images" / "00000.png"
    written = kept.stat().st_mtime_ns
    write_landmark(tmp_path, **SMALL)
    assert tree_hash(tmp_path) == tree_hash(scene.root)
    assert kept.stat().st_mtime_ns == written


def test_a_complete_landmark_is_left_alone(scene):
    def never(fn, specs):
        raise AssertionError("nothing is to be done")

    assert write_landmark(scene.root, **SMALL, mapper=never) == scene.root


def test_other_arguments_in_the_same_folder_are_refused(scene):
    with pytest.raises(CrossrayError, match="size 40 there, 48 asked"):
        write_landmark(scene.root, **(SMALL | {"size": 48}))


def test_a_folder_with_another_scene_is_refused(tmp_path):
    (tmp_path / "dense").mkdir()
    with pytest.raises(CrossrayError, match="not the built-in landmark"):
        write_landmark(tmp_path, **SMALL)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"train": 5}, "10 to 10,000"),
        ({"train": 10_000}, "10 to 10,000"),
        ({"train": 0, "val": 20}, "at least one of them for training"),
        ({"val": -1}, "negative"),
        ({"size": 8}, "size 8"),
        ({"seed": -1}, "seed -1"),
        ({"sun_jitter": -1.0}, "sun_jitter"),
        ({"sun_jitter": math.nan}, "sun_jitter"),
    ],
)
def test_arguments_out_of_range_are_refused_before_anything_is_written(tmp_path, wrong, message):
    with pytest.raises(CrossrayError, match=message):
        write_landmark(tmp_path / "new", **(SMALL | wrong))
    assert not (tmp_path / "new").exists()


def test_the_split_file_lists_every_photo(scene):
    header, *rows = (scene.root / "landmark.tsv").read_text().splitlines()
    assert header.split("\t") == ["filename", "id", "split", "dataset"]
    names, ids, splits, dataset = zip(*(row.split("\t") for row in rows), strict=True)
    assert list(names) == scene.names()
    assert [int(i) for i in ids] == list(range(1, 13))
    assert [splits.count(s) for s in ("train", "val", "test")] == [8, 2, 2]
    assert set(dataset) == {"landmark"}
    assert sorted(p.name for p in (scene.root / "dense" / "images").iterdir()) == sorted(names)


def test_unknown_names_and_splits_are_named(scene):
    with pytest.raises(CrossrayError, match=r"nobody\.png"):
        scene.mask("nobody.png")
    with pytest.raises(CrossrayError, match="validation"):
        scene.names("validation")


# ---- truth


def test_truth_of_a_photo_in_its_own_light_is_the_stored_clean_picture(scene):
    for name in scene.names():
        stored = picture(scene.root / "truth" / f"{name[:-4]}.clean.png")
        assert np.array_equal(scene.truth(name, name), stored)


def test_truth_takes_the_camera_of_one_and_the_light_of_the_other(scene):
    a, b = scene.names()[:2]
    ra, rb = scene.record(a), scene.record(b)
    crossed = scene.truth(a, b)
    assert crossed.shape == (ra.camera.height, ra.camera.width, 3)
    assert np.array_equal(crossed, photograph(ra.camera, rb.light, rb.response)[0])
    assert np.abs(crossed.astype(int) - scene.truth(a, a)).mean() > 5


def test_the_mask_is_where_tourists_changed_the_photo(scene):
    changed = 0
    for name in scene.names():
        photo = picture(scene.root / "dense" / "images" / name).astype(int)
        clean = picture(scene.root / "truth" / f"{name[:-4]}.clean.png").astype(int)
        mask = scene.mask(name)
        assert np.array_equal(mask, np.abs(photo - clean).max(2) > 10)
        assert mask.any() or len(scene.record(name).crowd) < 2
        changed += mask.sum()
    assert changed > 0


def test_tourists_cast_shadows_beside_themselves(scene):
    """Take one standing in noon sun: pixels darken that no tourist's body covers."""
    record = draw_photo(3, 0, "train", 96, 0.0)
    light = draw_light(np.random.default_rng(0), 0.0, record.light.towards_sun)
    response = draw_response(np.random.default_rng(0), light)
    person = landmark.Tourist("person", 0.5, -3.6, 0.0, 0.285, ((0.9, 0.9, 0.9),) * 5)
    clean, photo = photograph(LEVEL, light, response, [person])
    u, v, _ = LEVEL.project(np.array([[0.664, -3.405, 0.0]]))  # where the chest's shadow falls
    row, column = int(v[0]), int(u[0])
    assert photo[row, column].astype(int).sum() < clean[row, column].astype(int).sum() - 60


def test_depth_of_the_ground_is_that_of_similar_triangles():
    depth = depth_map(LEVEL)
    for row in (40, 44, 47):
        assert depth[row, 20] == pytest.approx(60.0 * 0.5 / (row + 0.5 - 24), rel=1e-5)
    assert np.isinf(depth[0, 0])


def test_depth_of_the_entablature_is_its_distance():
    """Its front is the plane y = -0.89, between z = 1.3 and 1.5: seen from y = -6, 5.11 away."""
    u, v, z = LEVEL.project(np.array([[0.3, -0.89, 1.4]]))
    assert z[0] == pytest.approx(5.11)
    assert depth_map(LEVEL)[int(v[0]), int(u[0])] == pytest.approx(5.11, rel=1e-5)


def test_only_the_depth_of_the_sky_is_infinite(scene):
    for name in scene.names():
        depth = scene.depth(name)
        camera = scene.camera(name)
        assert depth.shape == (camera.height, camera.width)
        assert depth.dtype == np.float32
        assert depth[np.isfinite(depth)].min() > 0.3
        assert np.isfinite(depth).mean() > 0.4


def test_the_sun_stands_still_unless_told_otherwise(scene):
    assert len({scene.record(n).light.towards_sun for n in scene.names()}) == 1
    still, moved = (draw_photo(3, 1, "train", 40, jitter) for jitter in (0.0, 25.0))
    assert still.camera == moved.camera
    angle = math.degrees(math.acos(np.dot(still.light.towards_sun, moved.light.towards_sun)))
    assert 1 < angle < 90
    noon = draw_light(np.random.default_rng(0), 0.0, still.light.towards_sun)
    later = draw_light(np.random.default_rng(0), 0.0, moved.light.towards_sun)
    a, b = (photograph(still.camera, light, still.response)[0].astype(int) for light in (noon, later))
    assert (np.abs(a - b).max(2) > 25).mean() > 0.02


# ---- the COLMAP model


def test_colmap_reads_cameras_poses_and_points_back(scene):
    pycolmap = pytest.importorskip("pycolmap")
    model = pycolmap.Reconstruction(scene.root / "dense" / "sparse")
    assert sorted(image.name for image in model.images.values()) == scene.names()
    assert model.num_points3D() > 500
    agree = []
    for image_id, image in model.images.items():
        assert image.camera_id != image_id
        record, camera = scene.record(image.name), model.cameras[image.camera_id]
        assert camera.model_name == record.model
        assert (camera.width, camera.height) == (record.camera.width, record.camera.height)
        assert image.projection_center() == pytest.approx(record.camera.centre, abs=1e-9)
        depth = scene.depth(image.name)
        seen = [(p.xy, model.points3D[p.point3D_id].xyz) for p in image.points2D if p.has_point3D()]
        assert len(seen) > 30
        for xy, xyz in seen:
            assert np.abs(image.project_point(xyz) - xy).max() < 1
            u, v, z = record.camera.project(xyz[None])
            # Next to an edge the pixel's centre may lie on another surface than the point: look around it.
            row, column = int(v[0]), int(u[0])
            around = depth[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
            if around.shape == (3, 3):
                agree.append(0.97 * around.min() < z[0] < 1.03 * around.max())
    assert np.mean(agree) > 0.99
    assert {record.model for record in map(scene.record, scene.names())} == {"PINHOLE", "SIMPLE_PINHOLE"}


# ---- the collection as a whole


@pytest.mark.parametrize("seed", range(3))
def test_held_out_views_lie_within_the_training_ones(seed):
    angles = {"train": [], "test": []}
    for index in range(64):
        split = "train" if index < 48 else "test"
        _, camera = landmark._draw_camera(np.random.default_rng((seed, index)), index * 0.618034 % 1, split, 96)
        angles[split].append(math.atan2(camera.centre[0], -0.6 - camera.centre[1]))
    assert max(map(abs, angles["test"])) < max(map(abs, angles["train"]))
    assert max(angles["train"]) - min(angles["train"]) > math.radians(105)


@pytest.mark.slow
def test_crowds_cover_the_wanted_share_and_no_photo_is_burnt_or_black(tmp_path):
    scene = Landmark.read(write_landmark(tmp_path, size=96))
    share = {split: np.mean([scene.mask(n).mean() for n in scene.names(split)]) for split in ("train", "test")}
    assert 0.06 <= share["train"] <= 0.10
    assert share["test"] < share["train"]
    assert max(scene.mask(n).mean() for n in scene.names()) <= 0.35
    for name in scene.names():
        photo = picture(tmp_path / "dense" / "images" / name)
        assert (photo == 255).any(2).mean() <= 0.03
        assert photo.mean() > 25


@pytest.mark.slow
def test_one_view_differs_strongly_between_appearances(tmp_path):
    """The best picture that ignores the appearance is 16 to 18 dB away from the truth."""
    record = draw_photo(0, 60, "test", 96, 0.0)
    stack = []
    for index in range(24):
        other = draw_photo(0, index, "train", 96, 0.0)
        stack.append(photograph(record.camera, other.light, other.response)[0] / 255)
    spread = np.mean((np.array(stack) - np.mean(stack, 0)) ** 2)
    assert 15.5 < -10 * math.log10(spread) < 18
