"""Pairs, doubts about models, pinhole photos, nerfstudio's format, and native code that is stopped: by hand."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from plyfile import PlyData

from pipeline.colmap import import_pycolmap
from pipeline.errors import CrossrayError
from pipeline.ingest import mapping
from pipeline.ingest.agreement import differences, read_rotations
from pipeline.ingest.child import NativeError, in_child
from pipeline.ingest.features import all_pairs, nearest_pairs, next_pairs, who_shares
from pipeline.ingest.folder import Seen
from pipeline.ingest.mapping import Model, Try, components, find_poses, judge
from pipeline.ingest.picture import from_above
from pipeline.ingest.run import claimed, split_table
from pipeline.ingest.summary import Summary, other_places, reasons
from pipeline.ingest.transforms import camera_of, read_transforms, write_ply
from pipeline.ingest.undistort import looks_past, make_pinhole


def test_pairs():
    assert all_pairs(3) == {(0, 1), (0, 2), (1, 2)}
    sequence = next_pairs(40)
    assert {j for i, j in sequence if i == 0} == {*range(1, 11), 16, 32}
    assert all(i < j < 40 for i, j in sequence)
    angles = np.arange(50) * 0.1
    near = nearest_pairs(np.stack([np.cos(angles), np.sin(angles)], 1).astype(np.float32))
    assert {(10, j) for j in range(11, 20)} <= near
    assert (0, 31) not in near  # opposite


def test_components_take_strong_pairs_alone():
    pairs = {("a", "b"): 30, ("b", "c"): 99, ("c", "d"): 29, ("d", "e"): 30}
    assert components(list("abcdef"), pairs) == [{"a", "b", "c"}, {"d", "e"}]


def model_of(tmp_path, photos=8):
    from tiny_scene import write_tiny_scene

    root = write_tiny_scene(tmp_path / "tiny", photos)
    return import_pycolmap().Reconstruction(str(root / "dense" / "sparse"))


def test_a_bad_camera_is_dropped(tmp_path):
    model = model_of(tmp_path)
    model.cameras[102].params = [1e6 * 48, 1e6 * 48, 24, 18]
    verdict = judge(model, "m")
    assert list(verdict.bad) == ["photo_002.jpg"]
    assert "focal length of 1e+06 times" in verdict.bad["photo_002.jpg"]
    assert verdict.unsound == ""
    assert len(verdict.photos) == 7
    assert model.num_reg_images() == 7


def test_many_bad_cameras_make_the_rest_unbelievable(tmp_path):
    model = model_of(tmp_path)
    for number in (0, 1, 2):
        model.cameras[100 + number].params = [-48, -48, 24, 18]
    assert judge(model, "m").unsound.startswith("3 of 8 cameras cannot be")


@pytest.mark.real
@pytest.mark.parametrize("name", ["piazza9_collapsed", "sacre_coeur14"])
def test_real_wrong_models_are_unsound_or_cleaned(test_data, name):
    model = import_pycolmap().Reconstruction(str(test_data / "degenerate_colmap" / name / "sparse"))
    verdict = judge(model, "m")
    assert verdict.unsound or verdict.bad


def test_the_rest_is_adjusted_once_a_bad_camera_is_out(tmp_path):
    model = model_of(tmp_path)
    model.cameras[102].params = [1e6 * 48, 1e6 * 48, 24, 18]
    wrong = model.images[model.reg_image_ids()[0]]
    truth = wrong.cam_from_world().matrix()
    wrong.frame.rig_from_world = import_pycolmap().Rigid3d(
        wrong.cam_from_world().rotation, wrong.cam_from_world().translation + 0.02
    )
    before = model.compute_mean_reprojection_error()
    judge(model, "m")
    assert model.compute_mean_reprojection_error() < 0.2 * before
    assert not np.array_equal(wrong.cam_from_world().matrix(), truth)  # its world may have moved with it


def test_given_poses_and_lenses_stay_when_a_bad_camera_is_out(tmp_path):
    model = model_of(tmp_path)
    model.cameras[102].params = [1e6 * 48, 1e6 * 48, 24, 18]

    def given():
        images = [i for i in model.images.values() if i.name != "photo_002.jpg"]
        return np.concatenate([np.append(i.cam_from_world().matrix(), i.camera.params) for i in images])

    before = given()
    assert list(judge(model, "m", adjusted=None).bad) == ["photo_002.jpg"]
    np.testing.assert_array_equal(given(), before)


def test_differences_are_those_of_the_cameras_and_not_of_the_worlds(tmp_path):
    pycolmap = import_pycolmap()
    model = model_of(tmp_path)
    (tmp_path / "a").mkdir(), (tmp_path / "b").mkdir()
    model.write(tmp_path / "a")
    model.transform(pycolmap.Sim3d(2.0, pycolmap.Rotation3d([0.3, -0.2, 1.0]), [1.0, 2.0, 3.0]))
    tilted = next(i for i in model.images.values() if i.name == "photo_003.jpg")
    pose = tilted.cam_from_world()
    tilted.frame.rig_from_world = pycolmap.Rigid3d(
        pycolmap.Rotation3d([np.radians(7), 0, 0]) * pose.rotation, pose.translation
    )
    model.write(tmp_path / "b")
    found = differences(read_rotations(tmp_path / "a"), read_rotations(tmp_path / "b"))
    assert found.pop("photo_003.jpg") == pytest.approx(7, abs=1e-4)
    assert list(found.values()) == pytest.approx([0] * 7, abs=1e-4)
    two = dict(list(read_rotations(tmp_path / "a").items())[:2])
    assert differences(two, read_rotations(tmp_path / "b")) == {}


@pytest.fixture
def fake_run(monkeypatch):
    """Stands for the mapper: gives each try the models that a test names, which the names of their folders describe."""

    def rotations(folder):
        count, tilt = folder.name.split("-")
        return {photo: turned(float(tilt) * i) for i, photo in enumerate(PHOTOS[: int(count)])}

    monkeypatch.setattr(mapping, "read_rotations", rotations)

    def make(models, seen):
        def run(index, path):
            seen.append(index)
            path.mkdir(parents=True)
            name = path.name.partition("-")[2]
            (path / "verdict.json").write_text(json.dumps({"name": name, "models": models[index]}))

        return run

    return make


PHOTOS = [f"{i}.jpg" for i in range(10)]


def turned(degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def fake(count, unsound="", tilt=0.0):
    return {"folder": f"{count}-{tilt}", "photos": PHOTOS[:count], "points": 9, "error": 0.5,
            "unsound": unsound}  # fmt: skip


def test_tries_end_when_a_second_one_agrees(tmp_path, fake_run):
    ran: list[int] = []
    models = [[fake(10, "collapsed")], [fake(4)], [fake(10, tilt=1.0)], [fake(10)], [fake(10, tilt=0.9)], []]
    found = find_poses(tmp_path, 10, fake_run(models, ran))
    assert ran == [0, 1, 2, 3, 4]  # the third and the fourth differ by 2.5 degrees in the median
    assert found.tried.name == "fixed-distortion"
    assert len(found.model.photos) == 10
    assert found.median == pytest.approx(0.25)
    ran.clear()
    assert find_poses(tmp_path, 10, fake_run([], ran)).tries == found.tries  # what is there is read
    assert ran == []


def test_of_many_photos_one_try_suffices(tmp_path, fake_run, monkeypatch):
    monkeypatch.setattr(mapping, "FEW", 9)
    ran: list[int] = []
    found = find_poses(tmp_path, 10, fake_run([[fake(10)]], ran))
    assert (ran, found.apart) == ([0], {})


def test_tries_that_never_agree_are_used_and_told(tmp_path, fake_run):
    found = find_poses(tmp_path, 10, fake_run([[fake(10, tilt=2.0 * i)] for i in range(6)], []))
    assert len(found.tries) == 6
    assert found.median == pytest.approx(5)
    same, focal = {p: p for p in PHOTOS}, dict.fromkeys(PHOTOS, 1.0)
    summary = Summary("s", same, {}, 1, 0.1, 2.0, focal, [], [], {}, found.apart)
    assert "two tries differ by 5.0 degrees in the median" in summary.inexact
    exact = replace(summary, apart=dict.fromkeys(PHOTOS, 0.1))
    assert exact.inexact == ""
    assert exact.agreement() == "two tries differ by 0.10 degrees in the median, 0.10 at most (0.jpg)"
    assert replace(summary, apart={}).agreement() == "of one try alone"


def test_the_largest_of_the_sound_ones_else_all_tries_are_told(tmp_path, fake_run):
    results = [[fake(k)] for k in (3, 6, 4, 5, 3, 6)]
    found = find_poses(tmp_path / "a", 10, fake_run(results, []))
    assert (found.tried.name, len(found.model.photos)) == ("seed-1", 6)
    with pytest.raises(
        CrossrayError, match=r"no sound model(.|\n)*default: 9 photos, collapsed(.|\n)*seed-2: no model"
    ):
        find_poses(tmp_path / "b", 10, fake_run([[fake(9, "collapsed")], [], [], [], [], []], []))


def test_reasons(tmp_path):
    seen = [Seen("A", photo="a"), Seen("B", "a PDF"), Seen("C", photo="c"), Seen("D", photo="d"), Seen("E", photo="e"),
            Seen("F", photo="f")]  # fmt: skip
    chosen = Model("m", ["a"], 1, 0.1, {"d": "focal 1e6"})
    other = Model("n", ["e", "x", "y"], 1, 0.1)
    found = reasons(seen, chosen, [other], {("a", "c"): 14, ("a", "f"): 40})
    assert found == {
        "B": "a PDF",
        "C": "no overlap: 14 verified matches at most with any other photo",
        "D": "bad camera: focal 1e6",
        "E": "registered in another model, of 3 photos",
        "F": "no pose found: 40 verified matches at most, with A",
    }
    assert other_places(Try("t", tmp_path, [chosen, other]), chosen) == [other]


def test_other_photos_begin_anew_until_the_scene_is_there(tmp_path):
    out = tmp_path / "s"
    with claimed(out, {"digest": "1"}) as work:
        (work / "files.json").write_text("[]")
        with pytest.raises(CrossrayError, match="another ingest"), claimed(out, {"digest": "1"}):
            pass
    with claimed(out, {"digest": "1"}) as work:
        assert (work / "files.json").exists()
    with claimed(out, {"digest": "2"}) as work:
        assert not (work / "files.json").exists()
    (out / "s.tsv").write_text("")
    with pytest.raises(CrossrayError, match="changed since"), claimed(out, {"digest": "3"}):
        pass


def test_split():
    table = split_table([f"{i}" for i in range(9)], "s", 8).splitlines()
    assert table[0] == "filename\tid\tsplit\tdataset"
    assert [row.split("\t")[2] for row in table[1:]] == ["test"] + ["train"] * 7 + ["test"]
    assert "test" not in split_table(["a", "b"], "s", 0)


def test_pinhole_cameras_and_what_they_see():
    pycolmap = import_pycolmap()
    model = pycolmap.Reconstruction()
    for number, k in enumerate((0.0, 0.1), start=1):
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(camera_id=number, model="SIMPLE_RADIAL", width=100, height=80, params=[90, 50, 40, k])
        )
    make_pinhole(model)
    assert model.cameras[1].model.name == "PINHOLE"
    assert model.cameras[1].params.tolist() == [90, 90, 50, 40]
    assert model.cameras[2].model.name == "SIMPLE_RADIAL"
    straight = model.cameras[1]
    assert looks_past(straight, straight) == pytest.approx(-0.5)
    r = (49.5**2 + 39.5**2) / 90**2
    assert looks_past(model.cameras[2], straight) == pytest.approx(49.5 * (1 + 0.1 * r) - 50)  # 0.1 r^2 at the corner


def test_from_above():
    pose = np.eye(3, 4)  # looks along z, y down: right x, ahead z, up -y
    np.testing.assert_allclose(from_above(np.stack([pose, pose])), [[1, 0, 0], [0, 0, 1], [0, -1, 0]], atol=1e-12)


# nerfstudio


def written(tmp_path, **changes):
    (tmp_path / "a.png").touch()
    c2w = [[1, 0, 0, 5], [0, 1, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]]
    content = {"w": 100, "h": 80, "fl_x": 90.0, "k1": 0.1, "strange": 1,
               "frames": [{"file_path": "a.png", "transform_matrix": c2w, "fl_y": 91.0}]} | changes  # fmt: skip
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps(content))
    return path


def test_poses_of_transforms(tmp_path):
    ((file, (intrinsics, w2c)),) = read_transforms(written(tmp_path)).items()
    assert file == (tmp_path / "a.png").resolve()
    np.testing.assert_allclose(w2c, [[1, 0, 0, -5], [0, -1, 0, 6], [0, 0, -1, 7]])
    camera = camera_of(intrinsics, (100, 80), "a.png", 3)
    assert camera.model.name == "OPENCV"
    assert camera.params.tolist() == [90, 91, 50, 40, 0.1, 0, 0, 0]
    assert camera_of(intrinsics.model_copy(update={"k1": 0.0}), (100, 80), "a", 1).model.name == "PINHOLE"
    fish = intrinsics.model_copy(update={"camera_model": "OPENCV_FISHEYE"})
    assert camera_of(fish, (100, 80), "a", 1).params.tolist() == [90, 91, 50, 40, 0.1, 0, 0, 0]
    with pytest.raises(CrossrayError, match="50 x 40 pixels and its frame 100 x 80"):
        camera_of(intrinsics, (50, 40), "a.png", 1)
    with pytest.raises(CrossrayError, match="EQUIRECTANGULAR"):
        camera_of(intrinsics.model_copy(update={"camera_model": "EQUIRECTANGULAR"}), (100, 80), "a.png", 1)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frames": []}, "frames"),
        ({"fl_x": -1}, "fl_x"),
        ({"frames": [{"file_path": "b.png", "transform_matrix": np.eye(4).tolist()}]}, "photo b.png is not in"),
        ({"frames": [{"file_path": "a.png", "transform_matrix": (2 * np.eye(4)).tolist()}]}, "no rotation"),
        ({"frames": [{"file_path": "a", "transform_matrix": np.eye(4).tolist()}] * 2}, "two frames"),
    ],
)
def test_bad_transforms(tmp_path, changes, message):
    with pytest.raises(CrossrayError, match=message):
        read_transforms(written(tmp_path, **changes))


def test_points_as_another_reader_sees_them(tmp_path):
    write_ply(tmp_path / "p.ply", np.array([[1.0, 2, 3], [4, 5, 6]]), np.array([[7, 8, 9], [1, 2, 3]], np.uint8))
    vertices = PlyData.read(tmp_path / "p.ply")["vertex"]
    assert [list(v) for v in vertices] == [[1, 2, 3, 7, 8, 9], [4, 5, 6, 1, 2, 3]]


# a process of its own


@pytest.mark.slow
def test_how_a_child_ends(tmp_path):
    in_child(os.mkdir, str(tmp_path / "made"), log=tmp_path / "log")
    assert (tmp_path / "made").is_dir()
    with pytest.raises(NativeError, match="mkdir: FileExistsError"):
        in_child(os.mkdir, str(tmp_path / "made"), log=tmp_path / "log")
    with pytest.raises(NativeError, match="mkdir: died"):
        in_child(os.mkdir, str(tmp_path / "never"), log=tmp_path / "no folder" / "log")


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_an_interrupted_parent_leaves_no_child(tmp_path, number):
    script = tmp_path / "parent.py"
    script.write_text(
        "import os, signal, time\nfrom pathlib import Path\n"
        "def work(file):\n    Path(file).write_text(str(os.getpid()))\n    time.sleep(600)\n"
        "if __name__ == '__main__':\n"
        "    from pipeline.ingest.child import in_child\n"
        "    signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # a shell's background jobs ignore it
        f"    in_child(work, {str(tmp_path / 'pid')!r}, log=Path({str(tmp_path / 'log')!r}))\n"
    )
    file = tmp_path / "pid"
    environment = os.environ | {"PYTHONPATH": str(Path(mapping.__file__).parents[2])}
    parent = subprocess.Popen([sys.executable, script], env=environment, stderr=subprocess.DEVNULL)
    wait_until(lambda: file.exists() and file.read_text() != "")
    child = int(file.read_text())
    parent.send_signal(number)
    assert parent.wait(30) != 0
    wait_until(lambda: not running(child))


def wait_until(true, seconds=30):
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
        time.sleep(0.05)


def running(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_frames_of_a_film_share_a_camera(tmp_path):
    for name, size in (("a.png", (8, 6)), ("b.png", (8, 6)), ("c.png", (6, 8))):
        Image.new("RGB", size).save(tmp_path / name)
    assert who_shares(tmp_path, ["a.png", "b.png"], "sequential") == "SINGLE"
    assert who_shares(tmp_path, ["a.png", "b.png"], "auto") == "AUTO"
    assert who_shares(tmp_path, ["a.png", "b.png", "c.png"], "sequential") == "AUTO"
