"""`crossray export`: the geometry of what it writes, that independent readers open it, and what it refuses."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from scipy.spatial.transform import Rotation
from tiny_run import cut_tiny, tiny_job

from model.fields.base import Level, Rays
from pipeline.checkpoint import MODEL
from pipeline.colmap import import_pycolmap
from pipeline.errors import CrossrayError
from pipeline.exporting import export, points
from pipeline.exporting.cameras import colmap_text, exported_camera, transforms
from pipeline.exporting.depth import preview, z_depth
from pipeline.exporting.export import RECORD, STARTED, WHAT, export_run
from pipeline.exporting.points import VERTEX, header, neighbours, stride_for, view_points, write_points
from pipeline.exporting.shown import END, Seen, Shown, surface
from pipeline.files import sha256_of
from pipeline.launch.run import claim_run
from pipeline.manifest import CameraRecord
from pipeline.painter import Painter
from pipeline.render import view_rays
from pipeline.train import train
from pipeline.work import Context

CPU = torch.device("cpu")
SCALE = 2.5


def camera_at(centre, rotation=np.eye(3), key="0", size=(24, 18), focal=(20.0, 22.0), middle=(11.5, 9.25), far=10.0):
    """A camera record, its pose OpenCV camera-to-world."""
    rows = np.column_stack([rotation, centre]).tolist()
    return CameraRecord(
        key=key, name=f"{key}.jpg", image_id=1, split="train", width=size[0], height=size[1], fx=focal[0], fy=focal[1],
        cx=middle[0], cy=middle[1], c2w=tuple(map(tuple, rows)), near=0.1, far=far, source_sha256="0" * 64,
    )  # fmt: skip


class Wall:
    """Stands for a `Shown`: an opaque plane z = `depth` of the world, and what `float_at` puts before one camera."""

    device, pixel_center = CPU, 0.5

    def __init__(self, depth=4.0, floating=None, spread=0.0, nothing_left_of=None):
        self.depth, self.floating, self.spread, self.hole = depth, floating, spread, nothing_left_of

    def look(self, rays: Rays) -> Seen:
        origins, directions = rays.origins.numpy().astype(float), rays.directions.numpy().astype(float)
        distance = (self.depth - origins[:, 2]) / directions[:, 2]
        hits = origins + distance[:, None] * directions
        if self.hole is not None:
            distance = np.where(hits[:, 0] < self.hole, 0, distance)
        if self.floating is not None:
            distance = np.where(np.linalg.norm(origins - self.floating, axis=1) < 1e-6, 0.5 * distance, distance)
        colours = np.stack([np.full(len(hits), 10), np.full(len(hits), 20), np.arange(len(hits)) % 256], axis=1)
        return Seen(colours.astype(np.uint8), distance.astype(np.float32), np.full(len(hits), self.spread, np.float32))


# Depth


def test_the_surface_is_where_half_of_the_light_is_reached():
    t = torch.tensor([[1.0, 2.0, 3.0, 4.0]]).expand(4, -1)
    weights = torch.tensor(
        [[0.2, 0.2, 0.5, 0.1], [0.97, 0.01, 0.01, 0.01], [0.3, 0.3, 0.2, 0.09], [0.25, 0.25, 0.25, 0.25]]
    )
    distance, spread = surface(Level(t, weights, torch.zeros(4, 4, 3)))
    assert distance.tolist() == [3, 1, 0, 2]  # the third: 0.89 in all
    assert spread.tolist() == [1, 0, 2, 2]


def test_no_ray_sees_nothing():
    """`Shown.look` of no rays is no colours, without a model's being asked."""
    shown = Shown.__new__(Shown)
    shown.levels = lambda rays: iter(())
    seen = shown.look(Rays(*(torch.empty(0, 3),) * 2, *(torch.empty(0),) * 2))
    assert [part.shape for part in seen] == [(0, 3), (0,), (0,)]


def test_the_end_of_a_ray_is_no_surface():
    shown = Shown.__new__(Shown)
    level = Level(torch.tensor([[9.4], [9.6]]), torch.ones(2, 1), torch.zeros(2, 1, 3))
    shown.levels = lambda rays: iter([level])
    shown.coloured = lambda level: np.zeros((2, 3), np.uint8)
    seen = shown.look(Rays(torch.zeros(2, 3), torch.ones(2, 3), torch.zeros(2), torch.full((2,), 10.0)))
    assert END == 0.95
    assert seen.distance.tolist() == pytest.approx([9.4, 0])


def test_depth_is_along_the_camera_s_axis():
    """A wall at z = 4 seen from z = 1 is at depth 3 in every pixel, and so is one at x = 4 from x = 1."""
    for rotation, forward in ((np.eye(3), 2), (Rotation.from_euler("y", 90, degrees=True).as_matrix(), 0)):
        rays = view_rays(camera_at(np.full(3, 1.0), rotation), 0.5, CPU)
        distance = (4 - rays.origins[:, forward]) / rays.directions[:, forward]
        depth = z_depth(distance.numpy(), rays, rotation[:, 2])
        assert depth.dtype == np.float32
        np.testing.assert_allclose(depth, 3, rtol=1e-6)
        assert distance.max() > 3.3


def test_a_depth_preview():
    depth = np.tile(np.linspace(1, 2, 50, dtype=np.float32), (4, 1))
    depth[0, 0] = 0
    picture = preview(depth)
    assert (picture.dtype, picture.shape) == (np.uint8, (4, 50, 3))
    assert picture[0, 0].tolist() == [0, 0, 0]
    near, far = picture[1, 0].astype(int), picture[1, -1].astype(int)
    assert near[2] > near[0]
    assert far[0] > far[2]
    assert not preview(np.zeros((3, 2), np.float32)).any()
    assert preview(np.full((3, 2), 7, np.float32)).any()


# Cameras


def poses(seed: int, count: int) -> list[CameraRecord]:
    rng = np.random.default_rng(seed)
    rotations = Rotation.random(count, rng=rng).as_matrix()
    return [camera_at(rng.normal(0, 3, 3), r, f"{i:03d}") for i, r in enumerate(rotations)]


@given(seed=st.integers(0, 2**32 - 1), scale=st.floats(1e-3, 1e3), pixel_center=st.sampled_from([0.0, 0.5]))
def test_cameras_travel_to_opencv_and_back(seed, scale, pixel_center):
    """A pixel's ray, read off transforms.json and off the COLMAP text, is the one that the model renders."""
    record = poses(seed, 1)[0]
    camera = exported_camera(record, scale, pixel_center)
    rays = view_rays(record, pixel_center, CPU)
    cols, rows = np.meshgrid(np.arange(24) + 0.5, np.arange(18) + 0.5)
    points = (rays.origins + 2 * rays.directions).numpy() * scale

    frame = transforms({"a.png": camera})["frames"][0]
    c2w = np.array(frame["transform_matrix"])
    x, y, z = ((points - c2w[:3, 3]) @ c2w[:3, :3]).T
    np.testing.assert_allclose(frame["fl_x"] * x / -z + frame["cx"], cols.ravel(), atol=1e-3)
    np.testing.assert_allclose(-frame["fl_y"] * y / -z + frame["cy"], rows.ravel(), atol=1e-3)

    texts = colmap_text({"a.png": camera})
    fx, fy, cx, cy = map(float, texts["cameras.txt"].splitlines()[-1].split()[4:])
    qw, qx, qy, qz, *t = map(float, texts["images.txt"].splitlines()[1].split()[1:8])
    x, y, z = (points @ Rotation.from_quat([qx, qy, qz, qw]).as_matrix().T + t).T
    np.testing.assert_allclose(fx * x / z + cx, cols.ravel(), atol=1e-3)
    np.testing.assert_allclose(fy * y / z + cy, rows.ravel(), atol=1e-3)


def test_transforms_by_hand():
    """Looking along +x of the world with y up, 1 scene unit to the right of the origin, 2.5 COLMAP units each."""
    rotation = np.array([[0, 0, 1.0], [0, -1, 0], [1, 0, 0]])  # right is +z, down is -y, forward is +x
    camera = exported_camera(camera_at([0, 0, 1], rotation), 2.5, 0.0)
    content = transforms({"views/a.png": camera}, {"views/a.png": "depth/a.npy"}, "points.ply")
    assert content == {
        "camera_model": "OPENCV",
        "ply_file_path": "points.ply",
        "frames": [
            {
                "file_path": "views/a.png",
                "transform_matrix": [[0, 0, -1, 0], [0, 1, 0, 0], [1, 0, 0, 2.5], [0, 0, 0, 1]],
                "fl_x": 20.0,
                "fl_y": 22.0,
                "cx": 12.0,
                "cy": 9.75,
                "w": 24,
                "h": 18,
                "depth_file_path": "depth/a.npy",
            }
        ],
    }
    bare = transforms({"a.png": camera})
    assert "ply_file_path" not in bare
    assert "depth_file_path" not in bare["frames"][0]


def test_pycolmap_opens_the_cameras(tmp_path):
    records = poses(3, 5)
    cameras = {f"{r.key}.png": exported_camera(r, SCALE, 0.5) for r in records}
    for name, text in colmap_text(cameras).items():
        (tmp_path / name).write_text(text)
    model = import_pycolmap().Reconstruction(tmp_path)
    assert len(model.images) == 5
    assert len(model.points3D) == 0
    for image in model.images.values():
        record = next(r for r in records if f"{r.key}.png" == image.name)
        c2w, camera = image.cam_from_world().inverse().matrix(), model.cameras[image.camera_id]
        expected = np.array(record.c2w)
        np.testing.assert_allclose(c2w[:, :3], expected[:, :3], atol=1e-6)
        np.testing.assert_allclose(c2w[:, 3], SCALE * expected[:, 3], atol=1e-6)
        assert camera.model.name == "PINHOLE"
        assert (camera.width, camera.height, camera.params.tolist()) == (24, 18, [20.0, 22.0, 11.5, 9.25])


# Points


def test_strides_keep_to_the_budget():
    assert stride_for([(18, 24)], 432) == (1, 432)
    assert stride_for([(18, 24)], 431) == (2, 9 * 12)
    assert stride_for([(18, 24), (24, 18)], 97) == (3, 2 * 6 * 8)
    assert stride_for([(18, 24)], 1)[1] <= 1
    small = camera_at(np.zeros(3)).model_copy(update={"width": 6, "height": 4})
    stride, rays = stride_for([(18, 24), (4, 6)], 1)
    assert [len(view_rays(c, 0.5, CPU, stride).near) for c in (camera_at(np.zeros(3)), small)] == [rays, 0] == [1, 0]
    for budget in (1, 5, 50, 300):
        stride, rays = stride_for([(18, 24)], budget)
        assert rays == len(view_rays(camera_at(np.zeros(3)), 0.5, CPU, stride).near) <= budget


def side_by_side() -> list[CameraRecord]:
    return [camera_at([0.5 * i, 0, 0], key=str(i)) for i in range(5)]


def test_neighbours_stand_apart_and_look_the_same_way():
    cameras = side_by_side()
    assert neighbours(cameras, 0, 4.0) == [1, 2, 3, 4]
    assert neighbours(cameras, 2, 4.0) == [1, 3, 0, 4]
    assert neighbours(cameras, 0, 11.0) == [2, 3, 4]  # 0.05 of 11: the next stands too close
    back = camera_at([0.4, 0, 0], np.diag([-1.0, 1, -1]))
    assert neighbours([*cameras, back], 0, 4.0) == [1, 2, 3, 4]
    assert neighbours([cameras[0], cameras[0]], 0, 4.0) == []


def test_points_lie_on_the_wall_and_project_to_their_pixels():
    cameras = side_by_side()
    found = view_points(Wall(), cameras, 2, 3, SCALE)
    assert found.dtype == VERTEX
    assert len(found) == 8 * 6
    xyz = np.stack([found[n] for n in "xyz"], axis=1)
    np.testing.assert_allclose(xyz[:, 2], 4 * SCALE, rtol=1e-6)
    offset = xyz / SCALE - [1.0, 0, 0]
    cols, rows = np.meshgrid(np.arange(1, 24, 3) + 0.5, np.arange(1, 18, 3) + 0.5)
    np.testing.assert_allclose(20 * offset[:, 0] / offset[:, 2] + 11.5, cols.ravel(), atol=1e-4)
    np.testing.assert_allclose(22 * offset[:, 1] / offset[:, 2] + 9.25, rows.ravel(), atol=1e-4)
    assert found["red"].tolist() == [10] * 48
    assert found["blue"].tolist() == list(range(48))


def test_what_floats_before_one_camera_is_dropped():
    cameras = side_by_side()
    assert len(view_points(Wall(floating=np.array([1.0, 0, 0])), cameras, 2, 3, SCALE)) == 0
    assert len(view_points(Wall(floating=np.array([1.0, 0, 0])), cameras, 0, 3, SCALE)) > 20  # others: as they were


def test_what_stands_before_a_point_in_one_view_is_no_objection():
    """The nearest neighbour sees something else in front; the next one decides."""
    cameras = side_by_side()
    everything = view_points(Wall(), cameras, 0, 3, SCALE)
    hidden = view_points(Wall(floating=np.array([0.5, 0, 0])), cameras, 0, 3, SCALE)
    assert len(everything) > len(hidden) > 0.5 * len(everything)  # fewer: some were in the nearest picture alone


@pytest.mark.parametrize("share", [0, 2], ids=["nothing there", "something behind"])
def test_what_the_nearest_view_sees_through_is_dropped(share):
    """Whatever views farther away say; the points outside of its picture are in none of theirs."""

    class Seer(Wall):
        def look(self, rays):
            seen = super().look(rays)
            other = rays.origins[:, 0].numpy() == 0.5
            return seen._replace(distance=np.where(other, share * seen.distance, seen.distance))

    assert len(view_points(Wall(), side_by_side(), 0, 3, SCALE)) > 20
    assert len(view_points(Seer(), side_by_side(), 0, 3, SCALE)) == 0


def test_rays_of_two_surfaces_and_of_none_give_no_points():
    cameras = side_by_side()
    assert len(view_points(Wall(spread=0.3), cameras, 2, 3, SCALE)) == 0
    found = view_points(Wall(nothing_left_of=1.0), cameras, 2, 3, SCALE)
    assert 0 < len(found) < 48
    assert found["x"].min() >= SCALE * 0.99
    assert len(view_points(Wall(nothing_left_of=100.0), cameras, 2, 3, SCALE)) == 0
    assert len(view_points(Wall(), cameras[:1], 0, 3, SCALE)) == 0  # one view alone


def test_points_of_all_views_in_one_file(tmp_path, monkeypatch):
    from plyfile import PlyData

    cameras = side_by_side()
    asked = []
    whole = points.view_points

    def counted(shown, cameras, index, *rest):
        asked.append(index)
        if len(asked) == 3:
            raise KeyboardInterrupt
        return whole(shown, cameras, index, *rest)

    monkeypatch.setattr(points, "view_points", counted)
    path, work = tmp_path / "points.ply", tmp_path / "work"
    with pytest.raises(KeyboardInterrupt):
        write_points(path, Wall(), cameras, SCALE, 300, work)
    assert not path.exists()
    write_points(path, Wall(), cameras, SCALE, 300, work)
    assert asked == [0, 1, 2, 2, 3, 4]
    vertex = PlyData.read(path)["vertex"]
    expected = np.concatenate([whole(Wall(), cameras, i, 3, SCALE) for i in range(5)])
    assert len(expected) > 150
    for name in VERTEX.names:
        assert np.array_equal(vertex[name], expected[name])
    assert header(7).splitlines()[2] == "element vertex 7"


def test_a_cloud_without_a_point_is_a_file(tmp_path):
    from plyfile import PlyData

    write_points(tmp_path / "p.ply", Wall(nothing_left_of=100.0), side_by_side(), SCALE, 10, tmp_path / "work")
    assert len(PlyData.read(tmp_path / "p.ply")["vertex"]) == 0


# The command


METHODS = {
    "baked": ("crossray", {"model": {"statistics": "running"}}),
    "view": ("crnerf", {}),
    "coded": ("hanerf", {}),
    "embedded": ("nerfw", {}),
    "plain": ("nerf", {}),
}
PHOTO = "photo_001.jpg"


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return cut_tiny(tmp_path_factory.mktemp("export"))


@pytest.fixture
def trained(scene, monkeypatch):
    """trained(name): the finished run of two steps of a row of METHODS. Its field is fog, which counts as one surface
    wherever two views roughly agree about it.
    """
    monkeypatch.setattr("pipeline.exporting.shown.OPAQUE", 1e-6)
    monkeypatch.setattr(points, "SPREAD", 10.0)
    monkeypatch.setattr(points, "AGREE", 0.2)

    def run(name: str) -> Path:
        folder = scene / "runs" / name
        if not folder.exists():
            method, over = METHODS[name]
            job = tiny_job(scene, method, {"name": name, "train": {"epochs": 1, "steps_per_epoch": 2}} | over)
            claim_run(job)
            train(job, Context())
        return folder

    return run


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_every_method_is_exported_and_opened_again(trained, tmp_path, name):
    import trimesh
    from plyfile import PlyData

    run, out = trained(name), tmp_path / "out"
    record = export_run(run, out, appearance=None if name == "plain" else PHOTO, view="all", points=400)
    assert json.loads((out / RECORD).read_text()) == record
    assert {p.name for p in out.iterdir()} == {
        "views", "depth", "points.ply", "colmap", "transforms.json", "README.txt", RECORD,
    }  # fmt: skip
    there = {str(p.relative_to(out)) for p in out.rglob("*") if p.is_file()} - {RECORD}
    assert record["files"] == {name: sha256_of(out / name) for name in there}
    painter = Painter(run)
    photos, scale = painter.photos, painter.photos.manifest.scene.scale
    assert (record["run"], record["step"], record["counts"]["views"]) == (name, 2, 6)
    assert record["checkpoint_sha256"] == painter.checkpoint.meta["sha256"][MODEL]
    assert record["appearance"] == (
        None if name == "plain" else {"photo": PHOTO, "sha256": photos.records[1].source_sha256}
    )
    F = None if name == "plain" else painter.read(PHOTO).F

    content = json.loads((out / "transforms.json").read_text())
    model = import_pycolmap().Reconstruction(out / "colmap")
    assert {f"views/{i.name}" for i in model.images.values()} == {f["file_path"] for f in content["frames"]}
    for frame, camera in zip(content["frames"], photos.records, strict=True):
        view = painter.view(camera, F)
        (expected,) = painter.paint(view, [F])
        with Image.open(out / frame["file_path"]) as image:
            picture = np.asarray(image)
        assert picture.shape == (18, 24, 3)
        assert np.abs(picture.astype(int) - expected).max() <= 1
        depth = np.load(out / frame["depth_file_path"])
        assert (depth.dtype, depth.shape) == (np.float32, (18, 24))
        there = depth > 0
        assert there.any()
        assert depth.max() < scale * camera.far
        assert depth[there].min() > 0.9 * scale * camera.near
        with Image.open(out / frame["depth_file_path"].replace("npy", "png")) as image:
            assert (np.asarray(image).any(axis=-1) == there).all()
        np.testing.assert_allclose(np.array(frame["transform_matrix"])[:3, 3], scale * np.array(camera.c2w)[:, 3])
    vertex = PlyData.read(out / content["ply_file_path"])["vertex"]
    assert len(vertex) == record["counts"]["points"] > 0
    cloud = trimesh.load(out / "points.ply")
    np.testing.assert_allclose(cloud.vertices, np.stack([vertex[n] for n in "xyz"], axis=1))
    assert np.array_equal(np.asarray(cloud.colors)[:, 0], vertex["red"])


@pytest.mark.slow
def test_a_point_lies_at_its_depth_in_its_pixel(trained, tmp_path, monkeypatch):
    """Points of a view that all agree to, put back into the depth map of the same view by its transforms.json."""
    from plyfile import PlyData

    monkeypatch.setattr(points, "agreed", lambda shown, cameras, views, positions: np.ones(len(positions), bool))
    out = tmp_path / "out"
    export_run(trained("view"), out, appearance=PHOTO, view="photo_000.jpg")
    (frame,) = json.loads((out / "transforms.json").read_text())["frames"]
    depth, colours = np.load(out / frame["depth_file_path"]), np.asarray(Image.open(out / frame["file_path"]))
    there = depth > 0
    vertex = PlyData.read(out / "points.ply")["vertex"][: there.sum()]  # the first training view's come first
    w2c = np.linalg.inv(np.array(frame["transform_matrix"]))
    x, y, z = (np.stack([vertex[n] for n in "xyz"], axis=1) @ w2c[:3, :3].T + w2c[:3, 3]).T
    u, v = frame["fl_x"] * x / -z + frame["cx"], frame["cy"] - frame["fl_y"] * y / -z
    rows, cols = np.nonzero(there)
    np.testing.assert_allclose(u, cols + 0.5, atol=1e-3)
    np.testing.assert_allclose(v, rows + 0.5, atol=1e-3)
    np.testing.assert_allclose(-z, depth[there], rtol=1e-4)
    for channel, name in enumerate(("red", "green", "blue")):
        assert np.abs(vertex[name].astype(int) - colours[there][:, channel]).max() <= 1


@pytest.mark.slow
def test_again_does_what_is_missing(trained, tmp_path, monkeypatch, caplog):
    run, out = trained("baked"), tmp_path / "out"
    looked = []
    look = Shown.look
    monkeypatch.setattr(Shown, "look", lambda self, rays: looked.append(1) or look(self, rays))
    caplog.set_level("INFO", "crossray")

    first = export_run(run, out, ["views", "cameras"])
    assert first["appearance"]["photo"] == "photo_000.jpg"
    assert "appearance: photo_000.jpg, the first training photo" in caplog.text
    assert first["counts"] == {"views": 1}
    assert len(looked) == 1
    frame = json.loads((out / "transforms.json").read_text())["frames"][0]
    assert "depth_file_path" not in frame

    assert export_run(run, out, ["views"])["what"] == ["cameras", "views"]  # what is there stays
    assert export_run(run, out, ["views", "cameras"]) == first
    assert len(looked) == 1

    second = export_run(run, out, ["depth"])
    assert second["what"] == ["depth", "cameras", "views"]
    assert json.loads((out / "transforms.json").read_text())["frames"][0]["depth_file_path"].startswith("depth/")
    assert len(looked) == 2

    (picture,) = (out / "views").iterdir()
    whole = picture.read_bytes()
    picture.write_bytes(whole[:-7])
    (out / "README.txt").unlink()
    assert export_run(run, out, ["depth"])["files"] == second["files"]
    assert picture.read_bytes() == whole
    assert len(looked) == 3
    assert not (out / STARTED).exists()


@pytest.mark.slow
def test_an_interrupted_export_goes_on(trained, tmp_path, monkeypatch):
    run, out = trained("baked"), tmp_path / "out"
    export_run(run, out, ["cameras"], view="train", points=50)
    written = []
    write_view = export.write_view

    def interrupted(*words):
        if len(written) == 2:
            raise KeyboardInterrupt
        written.append(1)
        write_view(*words)

    monkeypatch.setattr(export, "write_view", interrupted)
    with pytest.raises(KeyboardInterrupt):
        export_run(run, out, view="train", points=50)
    assert not (out / RECORD).exists()
    with pytest.raises(CrossrayError, match="holds an export of another"):
        export_run(run, out, view="test", points=50)
    monkeypatch.setattr(export, "write_view", lambda *words: written.append(1) or write_view(*words))
    record = export_run(run, out, view="train", points=50)
    assert len(written) == 4
    assert record["what"] == list(WHAT)
    assert len(list((out / "views").iterdir())) == 4
    assert not [p for p in out.iterdir() if p.name.startswith(".")]


@pytest.mark.slow
def test_wrong_input_is_one_message(trained, tmp_path):
    run, out = trained("baked"), tmp_path / "out"
    for words, part in (
        ({"what": ["pionts"]}, "--what pionts: there is nothing of this name to export; did you mean 'points'"),
        ({"what": []}, "--what: nothing to export"),
        ({"points": 0}, "--points 0: at least 1"),
        ({"view": "tset"}, "--view tset: no photo of the scene is of this split or name; there are train, val, test"),
        ({"view": "photo_01.jpg"}, "did you mean 'photo_0"),
        ({"appearance": "none.jpg"}, "none.jpg: neither an image file"),
        ({"appearance": "n" * 300}, "nnn: neither an image file"),
        ({"what": ["points"], "points": 1}, "--points 1: not one ray of each of"),
        ({"step": 7}, "no checkpoint of step 7"),
    ):
        with pytest.raises(CrossrayError, match=part):
            export_run(run, out, **words)
    assert not out.exists()
    with pytest.raises(CrossrayError, match=r"--appearance photo_001.jpg: .* has none to choose"):
        export_run(trained("plain"), out, appearance=PHOTO)
    with pytest.raises(CrossrayError, match="embedding has learned"):
        export_run(trained("embedded"), out, appearance="photo_003.jpg")


@pytest.mark.slow
def test_a_folder_that_holds_something_else_is_left_alone(trained, tmp_path):
    run, out = trained("baked"), tmp_path / "out"
    (out / "views").mkdir(parents=True)
    (out / "views" / "mine.png").write_text("mine")
    with pytest.raises(CrossrayError, match=r"holds views and no export.json, so it is no export"):
        export_run(run, out)
    shutil.rmtree(out / "views")
    (out / ".views.12.tmp").write_text("what a killed writer left")
    export_run(run, out, ["cameras"])
    for other in ({"appearance": PHOTO}, {"view": "val"}, {"points": 5}):
        with pytest.raises(CrossrayError, match="holds an export of another checkpoint, appearance"):
            export_run(run, out, ["cameras"], **other)
    with pytest.raises(CrossrayError, match="holds an export of another"):
        export_run(trained("view"), out, ["cameras"])
    said = json.loads((out / RECORD).read_text())
    for content in ("{", "[]", json.dumps(said | {"step": 3}), json.dumps({"what": []})):
        (out / RECORD).write_text(content)
        with pytest.raises(CrossrayError, match=r"export.json is damaged"):
            export_run(run, out, ["cameras"])
    assert (out / "transforms.json").exists()


@pytest.mark.slow
def test_baked_and_painted_pictures_agree(trained):
    painter = Painter(trained("view"))
    F = painter.read(PHOTO).F
    camera = painter.photos.records[3]
    shown = Shown(painter, F)
    assert shown.baked is not None
    seen = shown.look(view_rays(camera, shown.pixel_center, CPU))
    (expected,) = painter.paint(painter.view(camera), [F])
    assert np.abs(seen.colours.reshape(expected.shape).astype(int) - expected).max() <= 1
