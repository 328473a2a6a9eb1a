"""`crossray render`: what it writes, that a frame is the painter's picture, that it goes on where it was, and what it
refuses."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
import torch
from PIL import Image
from tiny_run import cut_tiny, tiny_job

from pipeline import cli, film, painter
from pipeline.errors import CrossrayError
from pipeline.film import Order, as_frame, at_size, painter_of, render_film, shown, take
from pipeline.launch.run import claim_run
from pipeline.launch.tasks import one_gpu_if_any, ray_tasks
from pipeline.looks import even_weights, stops_of
from pipeline.painter import Painter, Picture, stripes_of
from pipeline.render import predicted_mask
from pipeline.train import train
from pipeline.video import about_video, write_video
from pipeline.views.camera import Camera, camera_of, resized
from pipeline.views.choose import read_path
from pipeline.work import Context

A, B = "photo_001.jpg", "photo_002.jpg"
FAST = {"field": "hash"}
METHODS = {"crossray": {}, "nerfw": FAST, "hanerf": FAST | {"encoder": "compact"}, "nerf": FAST}


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Finished runs of two steps, one a method, on one scene."""
    folder = cut_tiny(tmp_path_factory.mktemp("film"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CROSSRAY_CACHE", str(folder / "cache"))
        for method, model in METHODS.items():
            over = {"name": method, "model": model, "train": {"epochs": 1, "steps_per_epoch": 2}}
            job = tiny_job(folder, method, over)
            claim_run(job)
            train(job, Context())
    return folder


@pytest.fixture(autouse=True)
def _environment(trained, monkeypatch):
    monkeypatch.setenv("CROSSRAY_CACHE", str(trained / "cache"))
    painter_of.cache_clear()


@pytest.fixture
def run(trained):
    return trained / "runs" / "crossray"


@pytest.fixture
def crossray(monkeypatch, capsys):
    """crossray(*words): exit status, standard output, standard error without line breaks."""

    def call(*words: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["crossray", *map(str, words)])
        monkeypatch.setenv("COLUMNS", "400")
        status = 0
        try:
            cli.main()
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else 0
        out, err = capsys.readouterr()
        return status, out, err

    return call


def pixels_of(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image)


def film_frames(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as opened:
        return [frame.to_ndarray(format="rgb24") for frame in opened.decode(video=0)]


# What is written


@pytest.mark.parametrize("method", METHODS)
def test_a_still_is_what_the_painter_paints(trained, tmp_path, method):
    run, out = trained / "runs" / method, tmp_path / "stills"
    assert render_film(run, out, Order(view=A, what=("rgb", "accumulation"))) == [out]
    brush = Painter(run)
    index = [record.name for record in brush.photos.records].index(A)
    F = brush.read(A).F if method != "nerf" else None
    view = brush.view(brush.photos.records[index], F)
    assert np.array_equal(pixels_of(out / "rgb" / "photo_001.png"), brush.paint(view, [F])[0])
    expected = (view.accumulation.clamp(0, 1) * 255).round().byte().numpy()
    assert np.array_equal(pixels_of(out / "accumulation" / "photo_001.png"), expected)
    assert json.loads((out / "film.json").read_text())["step"] == 2


def test_the_views_of_a_split_each_in_its_own_light(run, tmp_path):
    render_film(run, tmp_path / "o", Order(view="train", what=("rgb", "mask")))
    brush = Painter(run)
    train = brush.photos.indices("train")
    assert len(list((tmp_path / "o" / "rgb").iterdir())) == len(train)
    for index in train:
        record = brush.photos.records[index]
        F = brush.read(record.name).F
        name = Path(record.name).with_suffix(".png")
        assert np.array_equal(pixels_of(tmp_path / "o/rgb" / name), brush.paint(brush.view(record), [F])[0])
        mask = (predicted_mask(brush.model, brush.photos, index) * 255).round().astype(np.uint8)
        assert np.array_equal(pixels_of(tmp_path / "o/mask" / name), mask)


def test_a_film_has_its_frames_its_rate_and_no_rest(run, tmp_path):
    out = tmp_path / "film.mp4"
    assert render_film(run, out, Order(frames=5, fps=12, size="32x24", appearance=A)) == [out]
    assert [p.name for p in tmp_path.iterdir()] == ["film.mp4"]
    frames = film_frames(out)
    assert len(frames) == 5
    assert frames[0].shape == (24, 32, 3)
    with av.open(str(out)) as opened:
        assert opened.streams.video[0].average_rate == 12
        assert opened.streams.video[0].codec.name == "h264"


def test_several_kinds_are_several_films(run, tmp_path):
    order = Order(frames=2, size="16x12", what=("rgb", "depth"))
    assert render_film(run, tmp_path / "a.mp4", order) == [tmp_path / "a-rgb.mp4", tmp_path / "a-depth.mp4"]


def test_an_appearance_goes_from_one_photo_to_the_other_over_a_film(run, tmp_path):
    order = Order(view=f"interpolate:{A}..{B}", frames=3, size="16x12", appearance=f"{A}..{B}")
    render_film(run, tmp_path / "f", order)
    brush = Painter(run)
    a, b = brush.read(A), brush.read(B)
    path = film.chosen_views(brush, order)
    for i, share in enumerate((0, 0.5, 1)):
        expected = brush.picture(path.frames[i].camera, brush.between(a, b, share)).rgb
        found = pixels_of(tmp_path / "f" / "rgb" / f"{i:05d}.png")
        assert np.abs(found.astype(int) - expected).max() <= 1


def test_a_path_that_was_written_gives_the_same_film_again(run, tmp_path):
    order = Order(view="orbit", frames=3, size="16x12", appearance=f"{A}..{B}")
    for layout in film.LAYOUTS:
        path = tmp_path / f"{layout}.json"
        render_film(run, path, replace(order, layout=layout))
        render_film(run, tmp_path / layout, Order(view=str(path)))
    render_film(run, tmp_path / "direct", order)
    for i in range(3):
        direct = pixels_of(tmp_path / "direct" / "rgb" / f"{i:05d}.png").astype(int)
        for layout in film.LAYOUTS:
            again = pixels_of(tmp_path / layout / "rgb" / f"{i:05d}.png")
            assert np.abs(direct - again).mean() < 0.5, layout
    brush = Painter(run)
    train = {r.name: camera_of(r) for r in brush.photos.records if r.split == "train"}
    assert read_path(tmp_path / "nerfstudio.json", brush.photos.manifest.scene.scale, train).appearances == (A, B)


def test_a_photo_of_another_place_is_an_appearance(run, tmp_path):
    other = tmp_path / "else..where.png"
    Image.fromarray(np.random.default_rng(1).integers(0, 256, (40, 50, 3), np.uint8)).save(other)
    render_film(run, tmp_path / "o", Order(view=A, appearance=str(other)))
    brush = Painter(run)
    record = next(record for record in brush.photos.records if record.name == A)
    expected = brush.picture(camera_of(record), brush.read(str(other)).F).rgb
    assert np.array_equal(pixels_of(tmp_path / "o" / "rgb" / "photo_001.png"), expected)
    assert not np.array_equal(expected, brush.picture(camera_of(record), brush.read(A).F).rgb)


# Going on


def test_frames_that_are_there_are_not_rendered_again(run, tmp_path, monkeypatch):
    order, out = Order(frames=4, size="16x12"), tmp_path / "f"
    taken = []

    def three(fn, specs):
        for spec in list(specs)[:3]:
            taken.append(spec.name)
            yield fn(spec)

    render_film(run, out, order, three)
    kept = (out / "rgb" / "00001.png").stat().st_mtime_ns

    def rest(fn, specs):
        for spec in specs:
            taken.append(spec.name)
            yield fn(spec)

    render_film(run, out, order, rest)
    assert taken == ["00000", "00001", "00002", "00003"]
    assert (out / "rgb" / "00001.png").stat().st_mtime_ns == kept


def test_a_film_that_was_stopped_goes_on_and_is_the_same(run, tmp_path):
    order = Order(frames=4, size="16x12")

    def stopped(fn, specs):
        yield fn(next(iter(specs)))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render_film(run, tmp_path / "a.mp4", order, stopped)
    assert not (tmp_path / "a.mp4").exists()
    render_film(run, tmp_path / "a.mp4", order)
    render_film(run, tmp_path / "b.mp4", order)
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()

    def never(fn, specs):
        raise AssertionError("a finished film is rendered again")

    assert render_film(run, tmp_path / "a.mp4", order, never) == [tmp_path / "a.mp4"]


def test_frames_of_another_film_are_never_mixed_in(run, tmp_path):
    out = tmp_path / "f"
    render_film(run, out, Order(frames=2, size="16x12"))
    for other in (Order(frames=3, size="16x12"), Order(frames=2, size="16x12", appearance=B)):
        with pytest.raises(CrossrayError, match="holds other pictures"):
            render_film(run, out, other)
    render_film(run, tmp_path / "a.mp4", Order(frames=2, size="16x12"))
    with pytest.raises(CrossrayError, match="not this film"):
        render_film(run, tmp_path / "a.mp4", Order(frames=3, size="16x12"))


@pytest.mark.slow
def test_ray_tasks_give_the_same_bytes(run, tmp_path):
    order = Order(frames=3, size="16x12", what=("rgb", "depth"))
    render_film(run, tmp_path / "here", order)
    with ray_tasks(1, needs=one_gpu_if_any) as mapper:
        render_film(run, tmp_path / "ray", order, mapper)
    files = sorted(p.relative_to(tmp_path / "here") for p in (tmp_path / "here").rglob("*.png"))
    assert len(files) == 6
    for name in files:
        assert (tmp_path / "here" / name).read_bytes() == (tmp_path / "ray" / name).read_bytes()


# Parts


def test_a_picture_in_stripes_is_the_same_picture(run, monkeypatch):
    brush = Painter(run)
    camera, F = camera_of(brush.photos.records[0]), brush.read(A).F
    whole = brush.picture(camera, F)
    monkeypatch.setattr(painter, "STRIPE", 5 * camera.width)
    assert [part.height for part in stripes_of(camera)][:2] == [5, 5]
    striped = brush.picture(camera, F)
    assert np.abs(whole.rgb.astype(int) - striped.rgb).max() <= 1
    assert np.allclose(whole.depth, striped.depth, rtol=1e-3)


def test_rows_longer_than_a_stripe_are_stripes_of_one_row():
    camera = Camera(2**19, 2, 1.0, 1.0, 1.0, 1.0, ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0)), 1.0, 2.0)
    assert [(part.height, part.cy) for part in stripes_of(camera)] == [(1, 1.0), (1, 0.0)]


def test_sizes():
    camera = Camera(40, 30, 20.0, 20.0, 20.0, 15.0, ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0)), 1.0, 2.0)
    assert at_size(camera, None) is camera
    assert (at_size(camera, "80").width, at_size(camera, "80").height) == (80, 60)
    wide = resized(camera, 160, 60)  # twice as large, and twice as wide beyond: the middle is the same
    assert (wide.fx, wide.fy, wide.cx, wide.cy) == (40.0, 40.0, 80.0, 30.0)
    for wrong in ("", "0", "-3", "10x", "axb", "1x2x3", "99999", "1e3"):
        with pytest.raises(CrossrayError, match="--size"):
            at_size(camera, wrong)


def test_depth_is_shown_by_its_logarithm():
    depth = np.array([[1.0, 2.0, 4.0, 9.0]], np.float32)
    picture = Picture(np.zeros((1, 4, 3), np.uint8), depth, np.array([[1, 1, 1, 0]], np.float32))
    assert shown(picture, "depth", 1.0, 4.0).tolist() == [[255, 128, 0, 0]]
    assert shown(picture, "accumulation", 1.0, 4.0).tolist() == [[255, 255, 255, 0]]


def test_weights_along_a_film():
    assert even_weights(1, 2) == [(1.0,), (1.0,)]
    assert even_weights(3, 5) == [(1, 0, 0), (0.5, 0.5, 0), (0, 1, 0), (0, 0.5, 0.5), (0, 0, 1)]
    assert even_weights(2, 1) == [(1.0, 0.0)]


def test_names_with_dots_in_an_appearance(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "x..y.jpg").touch()
    assert stops_of("a.jpg..x..y.jpg", ["a.jpg", "b.jpg"]) == ["a.jpg", "x..y.jpg"]
    assert stops_of("x..y.jpg", ["a.jpg"]) == ["x..y.jpg"]
    with pytest.raises(CrossrayError, match=r"'c\.jpg' is neither"):
        stops_of("a.jpg..c.jpg", ["a.jpg"])
    with pytest.raises(CrossrayError, match="can be read as"):
        stops_of("x..y.jpg", ["x", "y.jpg"])


def test_a_film_file_tells_what_it_is_and_odd_sides_are_cut(tmp_path):
    path = tmp_path / "o.png"
    Image.fromarray(np.arange(5 * 7, dtype=np.uint8).reshape(5, 7)).save(path)
    assert as_frame(path).shape == (4, 6, 3)
    write_video(tmp_path / "a.mp4", [np.full((16, 32, 3), 20 * i, np.uint8) for i in range(4)], 24, '{"ä": 1}')
    assert about_video(tmp_path / "a.mp4") == '{"ä": 1}'
    means = [frame.mean() for frame in film_frames(tmp_path / "a.mp4")]
    assert np.allclose(means, [0, 20, 40, 60], atol=2)
    (tmp_path / "no.mp4").write_text("nothing")
    assert about_video(tmp_path / "no.mp4") is None


@pytest.mark.parametrize("size", [(64, 96), (720, 1280)])
def test_a_film_says_which_colours_it_has_and_has_them(tmp_path, size):
    """Players take a film that says nothing for BT.601 or BT.709 by its size: red would be another red."""
    colour = np.array([200, 30, 60], np.uint8)
    write_video(tmp_path / "a.mp4", [np.broadcast_to(colour, (*size, 3)).copy()], 24, "")
    with av.open(str(tmp_path / "a.mp4")) as opened:
        codec = opened.streams.video[0].codec_context
        assert (codec.color_range, codec.colorspace, codec.color_primaries, codec.color_trc) == (1, 1, 1, 1)
        y, u, v = (np.frombuffer(plane, np.uint8)[0] for plane in next(opened.decode(video=0)).planes)
    r, g, b = colour / 255  # ITU-R BT.709, 8 bits, limited range
    luma = 0.2126 * r + 0.7152 * g + 0.0722 * b
    expected = (16 + 219 * luma, 128 + 224 * (b - luma) / 1.8556, 128 + 224 * (r - luma) / 1.5748)
    assert np.allclose((y, u, v), expected, atol=1.5)


def test_pictures_of_two_sizes_are_no_film(tmp_path):
    with pytest.raises(CrossrayError, match="10 x 8 pixels after those of 6 x 4"):
        write_video(tmp_path / "a.mp4", [np.zeros((4, 6, 3), np.uint8), np.zeros((8, 10, 3), np.uint8)], 24, "")
    assert list(tmp_path.iterdir()) == []


def test_a_shot_whose_files_are_there_leaves_them(run, tmp_path):
    brush = Painter(run)
    views = film.chosen_views(brush, Order(view=A))
    (shot,) = film.shots_of(brush, views, film.chosen_looks(brush, Order(view=A), views), ("rgb", "depth"), tmp_path)
    take(shot)
    shot.files["rgb"].write_text("kept")
    shot.files["depth"].unlink()
    take(shot)
    assert shot.files["rgb"].read_text() == "kept"
    assert shot.files["depth"].exists()


# What is refused


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--out", "o", "--view", "nowhere"], "--view nowhere: neither"),
        (["--out", "o", "--view", "photo_01.jpg"], "did you mean 'photo_001.jpg'?"),
        (["--out", "o", "--what", "rgb,normals"], "--what rgb,normals: give some of rgb, depth"),
        (["--out", "o", "--what", "mask"], "only photos have masks"),
        (["--out", "o.mp4", "--view", "test"], "gives single pictures"),
        (["--out", "o.gif"], "--out o.gif: a folder for PNGs"),
        (["--out", "o", "--size", "0x3"], "--size 0x3"),
        (["--out", "o", "--appearance", "own"], "a frame of a film is no photo's view"),
        (["--out", "o", "--appearance", "missing.jpg"], "'missing.jpg' is neither an image file"),
        (["--out", "o", "--frames", "0"], "0 frames"),
        (["--out", "o", "--fps", "-1"], "-1 frames per second"),
        (["--out", "o.mp4", "--fps", "0"], "0 frames per second: it needs 0.001 to 1000"),
        (["--out", "o.mp4", "--fps", "0.0004"], "0.0004 frames per second"),
        (["--out", "o.mp4", "--fps", "1e20"], "1e+20 frames per second"),
        (["--out", "o.mp4", "--size", "16x1"], "a film of 16 x 1 pixels; each side needs two"),
        (["--out", "o.mp4", "--size", "20000x10"], "16384 at most"),
        (["--out", "o", "--size", "9" * 5000], "16384 at most"),
        (["--out", "p.json", "--path-format", "blender"], "--path-format blender"),
        (["--out", "o", "--step", "7"], "no checkpoint of step 7"),
    ],
)
def test_wrong_input_is_one_message_and_writes_nothing(crossray, run, tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    status, _, err = crossray("render", run, *words)
    assert status == 2
    assert message in err
    assert "Traceback" not in err
    assert list(tmp_path.iterdir()) == []


def test_what_a_method_cannot_show_is_refused(trained, tmp_path):
    for method, order, message in (
        ("nerf", Order(view=A, appearance=A), "none to choose"),
        ("nerf", Order(view=A, what=("mask",)), "has no masks"),
        ("nerfw", Order(view="test"), "reads no other"),
        ("hanerf", Order(view="test", what=("mask",)), "has none of"),
    ):
        with pytest.raises(CrossrayError, match=message):
            render_film(trained / "runs" / method, tmp_path / "o", order)
        assert not (tmp_path / "o").exists()


def test_a_path_is_never_written_over_another_file(run, tmp_path):
    path, order = tmp_path / "path.json", Order(frames=2, size="16x12")
    render_film(run, path, order)
    before = path.read_bytes()
    assert render_film(run, path, order) == [path]
    for other in (replace(order, frames=3), replace(order, layout="nerfbaselines")):
        with pytest.raises(CrossrayError, match="not this path"):
            render_film(run, path, other)
    assert path.read_bytes() == before


@pytest.mark.parametrize("method", ["crossray", "nerfw", "nerf"])
def test_a_path_whose_frames_lack_weights_is_refused_or_given_an_appearance(trained, tmp_path, method):
    path = tmp_path / "path.json"
    render_film(trained / "runs" / "crossray", path, Order(frames=2, size="16x12", appearance=f"{A}..{B}"))
    content = json.loads(path.read_text())
    del content["camera_path"][1]["appearance_weights"]
    path.write_text(json.dumps(content))
    run, order = trained / "runs" / method, Order(view=str(path))
    if method == "nerf":  # has no appearance, and reads none
        assert render_film(run, tmp_path / "o", order) == [tmp_path / "o"]
        return
    with pytest.raises(CrossrayError, match="frame 1 has no appearance_weights"):
        render_film(run, tmp_path / "o", order)
    assert render_film(run, tmp_path / "o", replace(order, appearance=A)) == [tmp_path / "o"]


def test_kinds_in_another_order_or_twice_are_the_same_films(run, tmp_path):
    order = Order(frames=2, size="16x12", what=("rgb", "depth"))
    films = render_film(run, tmp_path / "a.mp4", order)
    for what in (("depth", "rgb"), ("rgb", "depth", "rgb")):
        assert render_film(run, tmp_path / "a.mp4", replace(order, what=what)) == films


def test_a_record_that_is_no_text_is_of_something_else(run, tmp_path):
    (tmp_path / "film.json").write_bytes(b"\xff\xfe")
    with pytest.raises(CrossrayError, match="holds other pictures"):
        render_film(run, tmp_path, Order(frames=1, size="16"))


def test_a_damaged_frame_is_named(run, tmp_path):
    out, order = tmp_path / "a.mp4", Order(frames=2, size="16x12")

    def damaged(fn, specs):
        for spec in specs:
            yield fn(spec)
        spec.files["rgb"].write_bytes(spec.files["rgb"].read_bytes()[:40])

    with pytest.raises(CrossrayError, match=r"a\.mp4\.frames/rgb/00001\.png is damaged"):
        render_film(run, out, order, damaged)
    assert not out.exists()
    (tmp_path / "a.mp4.frames" / "rgb" / "00001.png").unlink()
    assert render_film(run, out, order) == [out]
    with pytest.raises(CrossrayError, match="removed meanwhile"):
        as_frame(tmp_path / "gone.png")


def test_a_folder_of_other_things_is_left_alone(run, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(CrossrayError, match="holds other things"):
        render_film(run, tmp_path, Order(frames=1, size="16"))
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]


def test_without_numbers_there_is_no_picture(run, tmp_path, monkeypatch):
    brush = painter_of(run, 2)
    monkeypatch.setattr(brush, "read", lambda name: replace_F(Painter.read(brush, name)))
    with pytest.raises(ValueError, match="NaN"):
        brush.paint(brush.view(brush.photos.records[0]), [brush.read(A).F])


def replace_F(read):
    return read._replace(F=torch.full_like(read.F, float("nan")))
