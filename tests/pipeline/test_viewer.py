"""`crossray view`: what a browser sees and when, whose light it may take, what it saves; and all of it in Chromium."""

from __future__ import annotations

import contextlib
import io
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from dataclasses import replace
from math import pi, tan

import numpy as np
import pytest
import torch
from PIL import Image
from tiny_run import SPLITS, tiny_job
from tiny_scene import write_tiny_scene

from pipeline.cutting import cut_shards
from pipeline.errors import CrossrayError
from pipeline.launch.run import claim_run
from pipeline.launch.tasks import in_process
from pipeline.painter import Painter
from pipeline.render import View
from pipeline.train import train
from pipeline.viewer import appearance_tab, lights, view_tab
from pipeline.viewer import server as viewer_server
from pipeline.viewer.easel import Easel
from pipeline.viewer.gallery import open_gallery
from pipeline.viewer.lights import names_of, plain_name, read_photo, read_upload, thumbnail
from pipeline.viewer.place import Place, angle_of, evenly, quaternion
from pipeline.viewer.recording import Key, Light, film_of, path_file, render_line, save_path
from pipeline.viewer.server import check_address, serving, start_viser, view_run
from pipeline.viewer.standing import Pace, Standing, Wish, picture_of, steps_to
from pipeline.viewer.strip import chosen_style, strip_style
from pipeline.views.camera import Camera, camera_of
from pipeline.views.nerfstudio import read_camera_path
from pipeline.work import Context

STEPS = {"crossray": 10, "nerf": 2, "hanerf": 2, "nerfw": 2}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The tiny scene, each photo in a light of its own."""
    folder = tmp_path_factory.mktemp("viewer")
    write_tiny_scene(folder / "scene", size=(96, 72), splits=SPLITS)
    tints = np.random.default_rng(3).uniform(20, 200, (6, 3))
    for path, tint in zip(sorted((folder / "scene" / "dense" / "images").iterdir()), tints, strict=True):
        Image.fromarray((0.2 * np.asarray(Image.open(path)) + tint).astype(np.uint8)).save(path)
    job = tiny_job(folder)
    cut_shards(job.scene.path, job.shards, downscale=2, reference_downscale=1, plan=job.patch, mapper=in_process)
    return folder


@pytest.fixture(autouse=True)
def _cache(folder, monkeypatch):
    monkeypatch.setenv("CROSSRAY_CACHE", str(folder / "cache"))


@pytest.fixture(scope="module")
def trained(folder):
    """trained(method): a run of it, made once."""

    def made(method):
        job = tiny_job(
            folder,
            method,
            {
                "name": method,
                "train": {"epochs": 1, "steps_per_epoch": STEPS[method]},
                **({"model": {"field": "hash"}} if method != "crossray" else {}),
            },
        )
        if not (folder / "runs" / method).exists():
            with pytest.MonkeyPatch.context() as patch:
                patch.setenv("CROSSRAY_CACHE", str(folder / "cache"))
                claim_run(job)
                train(job, Context())
        return folder / "runs" / method

    return made


@pytest.fixture
def run(trained, tmp_path):
    """run(method): a copy of a finished run, to write into."""
    return lambda method="crossray": shutil.copytree(trained(method), tmp_path / "runs" / method)


def png(size=(40, 30), colour=(20, 60, 220)):
    buffer = io.BytesIO()
    Image.new("RGB", size, colour).save(buffer, "PNG")
    return buffer.getvalue()


CAMERA = Camera(
    64, 48, 60.0, 60.0, 32.0, 24.0, ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0)), 0.5, 4.0
)


def moved(x, camera=CAMERA):
    (a, b, c) = camera.c2w
    return replace(camera, c2w=((*a[:3], float(x)), b, c))


class Fake:
    """A painter whose views say where they are: the feature of a pixel is (column, row of the whole picture)."""

    def __init__(self, coded=False):
        self.coded, self.views, self.paints = coded, [], 0

    def view(self, camera, F=None):
        self.views.append((camera, F))
        rows, cols = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
        rows = rows + CAMERA.cy * camera.fy / CAMERA.fy - camera.cy
        features = torch.stack([cols.flatten(), rows.flatten()], dim=1).float()
        ones = torch.ones(camera.height, camera.width)
        return View((camera.height, camera.width), features, 2 * ones, 0.5 * ones)

    def paint(self, view, appearances):
        self.paints += 1
        value = 0 if appearances[0] is None else int(appearances[0])
        return [np.concatenate([view.features.reshape(*view.size, 2).numpy(), np.full((*view.size, 1), value)], 2)]


def steady(rays_a_second):
    """A pace that measuring does not change."""
    pace = Pace(rays_a_second)
    pace.measured = lambda rays, seconds: None
    return pace


def until_idle(standing):
    pictures = []
    for _ in range(1000):
        if standing.idle:
            return pictures
        if (shown := standing.advance()) is not None:
            pictures.append(shown)
    raise AssertionError("it never comes to an end")


# What a browser sees


def test_steps_double_from_what_the_pace_allows():
    sizes = [(c.width, c.height) for c in steps_to(replace(CAMERA, width=640, height=480), 3000)]
    assert sizes == [(63, 47), (137, 103), (296, 222), (640, 480)]
    assert abs(sizes[0][0] * sizes[0][1] - 3000) < 60
    assert steps_to(CAMERA, 10**6) == [CAMERA]
    assert steps_to(replace(CAMERA, width=640, height=480), 1)[0].height == 24  # never smaller
    small = steps_to(CAMERA, 100)[0]
    assert small.fy / small.height == pytest.approx(CAMERA.fy / CAMERA.height)  # the same field of view


def test_a_standing_view_gets_sharper_and_comes_to_rest():
    painter = Fake()
    standing = Standing(painter, steady(8000), Wish(CAMERA, None))
    pictures = until_idle(standing)
    assert [p.step for p in pictures] == list(range(pictures[0].steps))
    assert pictures[-1].pixels.shape == (48, 64, 3)
    assert standing.advance() is None
    rows = pictures[-1].pixels[:, :, 1]  # all bands in their places
    np.testing.assert_allclose(rows, np.arange(48)[:, None] + np.zeros((48, 64)), atol=1e-4)
    assert max(c.width * c.height for c, _ in painter.views) <= 400  # a slice: 1 / 20 s


def test_a_finer_picture_is_given_up_when_the_camera_moves_and_a_coarse_one_is_not():
    painter = Fake()
    standing = Standing(painter, steady(8000), Wish(CAMERA, None))
    assert standing.advance() is None  # half of the coarse one
    standing.ask(camera=moved(1))
    shown = standing.advance()
    assert shown is not None  # it is finished all the same
    assert shown.step == 0
    assert {c.c2w for c, _ in painter.views} == {CAMERA.c2w}
    while standing.advance() is None:
        pass
    assert painter.views[-1][0].c2w == moved(1).c2w
    standing.advance()  # the next finer one has begun
    standing.ask(camera=moved(2))
    begun = len(painter.views)
    assert until_idle(standing)[0].step == 0
    assert {c.c2w for c, _ in painter.views[begun:]} == {moved(2).c2w}


def test_only_the_latest_wish_counts():
    painter = Fake()
    standing = Standing(painter, steady(10**6), Wish(CAMERA, None))
    for x in range(50):
        standing.ask(camera=moved(x))
    until_idle(standing)
    assert [c.c2w for c, _ in painter.views] == [moved(49).c2w]


def test_another_appearance_of_a_standing_view_is_only_painted():
    painter, a, b = Fake(), torch.tensor(1), torch.tensor(2)
    standing = Standing(painter, steady(8000), Wish(CAMERA, a))
    assert until_idle(standing)[-1].pixels[0, 0, 2] == 1
    rendered = len(painter.views)
    standing.ask(F=b)
    (shown,) = until_idle(standing)
    assert (shown.pixels[0, 0, 2], shown.step, len(painter.views)) == (2, shown.steps - 1, rendered)
    for what in ("depth", "accumulation"):
        standing.ask(what=what)
        (shown,) = until_idle(standing)
        assert shown.pixels.dtype == np.uint8
    assert (shown.pixels == 128).all()
    assert len(painter.views) == rendered


def test_an_appearance_that_comes_while_the_view_gets_sharper_does_not_start_it_again():
    painter, a, b = Fake(), torch.tensor(1), torch.tensor(2)
    standing = Standing(painter, steady(8000), Wish(CAMERA, a))
    while standing.advance() is None:
        pass
    standing.advance()
    standing.ask(F=b)
    pictures = until_idle(standing)
    assert [p.pixels[0, 0, 2] for p in pictures] == [2] * len(pictures)
    assert [p.step for p in pictures] == list(range(pictures[-1].steps))  # step 0 once more, painted
    assert sum(c.width * c.height for c, _ in painter.views) == sum(
        p.pixels.shape[0] * p.pixels.shape[1] for p in pictures
    )


def test_a_coded_model_renders_another_appearance_anew_coarse_first():
    painter, a, b = Fake(coded=True), torch.tensor(1), torch.tensor(2)
    standing = Standing(painter, steady(8000), Wish(CAMERA, a))
    until_idle(standing)
    rendered = len(painter.views)
    standing.ask(F=b)
    pictures = until_idle(standing)
    assert [p.step for p in pictures] == list(range(pictures[-1].steps))
    assert all(F is b for _, F in painter.views[rendered:])


def test_the_pace_follows_what_is_measured():
    pace = Pace(1000)
    for _ in range(30):
        pace.measured(500, 0.1)
    assert pace.rays_a_second == pytest.approx(5000, rel=1e-3)
    assert pace.rays(0.1) == pytest.approx(500, abs=1)
    assert Pace(1).rays(0.01) == 1


@pytest.mark.parametrize("method", ["crossray", "nerf", "hanerf", "nerfw"])
def test_a_sharp_picture_is_the_painter_s_own(trained, method):
    painter = Painter(trained(method))
    record = painter.photos.records[1]
    F = painter.read(record.name).F if painter.has_appearance else None
    standing = Standing(painter, steady(6000), Wish(camera_of(record), F))
    pictures = until_idle(standing)
    expected = painter.picture(camera_of(record), F).rgb
    assert len(pictures) > 1
    assert np.abs(pictures[-1].pixels.astype(int) - expected).max() <= 1  # rounding of sums in other blocks
    assert pictures[-1].pixels.dtype == np.uint8


# One thread for all


def test_the_easel_serves_all_and_survives_one_that_fails():
    class Broken(Fake):
        def view(self, camera, F=None):
            raise RuntimeError("broken")

    pace, sharp, easel = steady(8000), [threading.Event() for _ in range(3)], Easel()
    seen = [[], [], []]

    def deliver(who):
        def take(shown):
            seen[who].append(shown.step)
            if shown.step == shown.steps - 1:
                sharp[who].set()

        return take

    standing = [Standing(p, pace, Wish(CAMERA, None)) for p in (Fake(), Broken(), Fake())]
    try:
        for who, s in enumerate(standing):
            easel.add(who, s, deliver(who))
        assert sharp[0].wait(10)
        assert sharp[2].wait(10)
        assert seen[0] == sorted(seen[0])
        assert not seen[1]
        sharp[2].clear()
        easel.remove(0)
        standing[0].ask(camera=moved(1))
        standing[2].ask(camera=moved(1))
        easel.wake()
        assert sharp[2].wait(10)
        assert not standing[0].idle  # who left is forgotten
    finally:
        easel.close()
    assert not easel._thread.is_alive()


def test_the_easel_takes_turns():
    easel, order, done = Easel.__new__(Easel), [], None
    easel._standing, easel._wake, easel._open = {}, threading.Condition(), True
    for who in (1, 2, 3):
        easel._standing[who] = Standing(Fake(), steady(100), Wish(CAMERA, None)), done
    for _ in range(6):
        order.append(easel._next()[0])
    assert order == [1, 2, 3, 1, 2, 3]


# Where one stands


def test_the_camera_of_a_window(trained):
    painter = Painter(trained("crossray"))
    photos = painter.photos
    records = [photos.records[i] for i in photos.indices("train")]
    place = Place(records, np.array([[-1, -1, -1], [1, 1, 1.0]]))
    np.testing.assert_allclose(place.up, (0, -1, 0), atol=1e-6)  # tiny_scene: y is down
    camera = place.camera(np.array([1.0, 0, 0, 0]), np.array([0.1, 0.2, -4]), pi / 2, (1200, 800), 300)
    assert (camera.width, camera.height) == (300, 200)
    assert camera.fy == pytest.approx(100)  # 90 degrees: half the height
    assert (camera.cx, camera.cy) == (150, 100)
    np.testing.assert_allclose(camera.pose, np.column_stack([np.eye(3), (0.1, 0.2, -4)]), atol=1e-12)
    assert (
        place.camera(np.array([1.0, 0, 0, 0]), np.zeros(3), 1.0, (120, 80), 300).width == 120
    )  # not more than there is
    w = np.array([1.0, 0, 0, 0])
    for wrong in (
        (w, np.zeros(3), 1.0, (0, 80)),
        (0 * w, np.zeros(3), 1.0, (120, 80)),
        (w * np.nan, np.zeros(3), 1.0, (120, 80)),
        (w, np.full(3, np.inf), 1.0, (120, 80)),
        (w, np.zeros(3), np.nan, (120, 80)),
    ):
        assert place.camera(*wrong, 300) is None
    assert place.camera(w, np.array([1e155, 0, 0]), 1.0, (120, 80), 300) is None
    for angle in (-3.0, 0.0, 7.0):
        assert place.camera(w, np.zeros(3), angle, (120, 80), 300).fy > 0


def test_a_photo_s_place(trained):
    photos = Painter(trained("crossray")).photos
    record = photos.records[0]
    place = Place([record], np.array(photos.manifest.scene.box))
    assert place.start is record
    pose = np.array(record.c2w)
    camera = place.camera(quaternion(record), pose[:, 3], angle_of(record, 4 / 3), (record.width, record.height), 999)
    np.testing.assert_allclose(camera.pose, pose, atol=1e-9)
    assert (camera.near, camera.far) == pytest.approx((record.near, record.far))
    assert camera.fy == pytest.approx(record.fy)  # of its own aspect: its own field of view
    assert tan(angle_of(record, 0.5) / 2) == pytest.approx(
        record.width / 2 / record.fx / 0.5
    )  # narrow: all of its width
    ahead = place.look_at(record) - pose[:, 3]
    np.testing.assert_allclose(ahead / np.linalg.norm(ahead), pose[:, 2], atol=1e-9)


def test_bounds_are_those_of_the_nearest(trained):
    photos = Painter(trained("crossray")).photos
    records = [
        photos.records[0].model_copy(
            update={"c2w": ((1, 0, 0, float(x)), (0, 1, 0, 0), (0, 0, 1, 0)), "near": 1.0 + x, "far": 10.0 + x}
        )
        for x in range(10)
    ]
    place = Place(records, np.zeros((2, 3)))
    there = place.camera(np.array([1.0, 0, 0, 0]), np.array([8.0, 0, 0]), 1.0, (8, 8), 8)
    assert (there.near, there.far) == pytest.approx((9.0, 18.0))  # its own
    beside = place.camera(np.array([1.0, 0, 0, 0]), np.array([7.5, 0, 0]), 1.0, (8, 8), 8)
    assert 8 < beside.near < 9
    assert place.start.near in (5.0, 6.0)


def test_evenly():
    assert evenly(range(100), 24) == tuple(range(0, 100, 5))
    assert evenly([3, 4], 24) == (3, 4)
    assert evenly([], 24) == ()
    assert len(evenly(range(25), 24)) == 13


# Lights


def test_only_photos_of_the_scene_are_read_by_name(trained, tmp_path):
    painter = Painter(trained("crossray"))
    file = tmp_path / "secret.png"
    file.write_bytes(png())
    for name in (str(file), "../x.png", "/etc/passwd", ""):
        with pytest.raises(CrossrayError, match="is no photo of this scene"):
            read_photo(painter, name)
    assert read_photo(painter, "photo_003.jpg").F is not None  # a test photo
    assert names_of(painter)[0] == "photo_000.jpg"
    assert len(names_of(painter)) == 6
    assert names_of(Painter(trained("nerfw"))) == tuple(f"photo_{i:03d}.jpg" for i in (0, 1, 2, 5))


def test_a_photo_of_one_s_own(trained, monkeypatch):
    painter = Painter(trained("crossray"))
    read = read_upload(painter, "mine.png", png())
    assert read.F.shape == painter.read("photo_000.jpg").F.shape
    for content, part in (
        (b"not a picture", "mine.png: cannot be read as an image"),
        (b"", "mine.png"),
        (png()[:60], "mine.png"),
    ):
        with pytest.raises(CrossrayError, match=part) as error:
            read_upload(painter, "mine.png", content)
        assert "/tmp" not in str(error.value)
    monkeypatch.setattr(lights, "LARGEST_PHOTO", 1000)
    with pytest.raises(CrossrayError, match=r"mine.png: 40 x 30 pixels"):
        read_upload(painter, "mine.png", png())
    monkeypatch.setattr(lights, "LARGEST_FILE", 2**20)
    with pytest.raises(CrossrayError, match=r"mine.png: 2 MiB; at most 1 MiB"):
        read_upload(painter, "mine.png", bytes(2 * 2**20))


def test_names_that_browsers_send():
    assert plain_name("C:\\photos\\a.jpg") == "a.jpg"
    assert plain_name("../../etc/passwd") == "passwd"
    assert plain_name("a\nb\x00.jpg") == "ab.jpg"
    assert plain_name("/") == "photo"
    assert len(plain_name("x" * 500)) == 60


def test_the_strip_shows_the_photos_in_order():
    photos = [np.full((30, 200, 3), value, np.uint8) for value in (10, 200)]
    assert thumbnail(photos[0]).shape == (14, 96, 3)
    html = strip_style(photos)
    assert html.count("background-image:url(data:image/jpeg;base64,") == 2
    assert html.index("nth-child(1)") < html.index("nth-child(2)")
    assert "nth-child(2)" in chosen_style(1)
    assert chosen_style(None) == ""


# Recording


A, B, MINE = Light("a.jpg"), Light("b.jpg"), Light("mine.png", png())


def test_the_appearance_goes_along_with_the_camera():
    keys = [Key(CAMERA, ((A, 1.0),)), Key(moved(1), ((A, 0.25), (B, 0.75))), Key(moved(2), ((B, 1.0),))]
    film = film_of(keys, 1.0, {A: "a.jpg", B: "b.jpg"})
    assert len(film.frames) == 61
    assert film.appearances == ("a.jpg", "b.jpg")
    assert film.frames[0].weights == (1, 0)
    assert film.frames[30].weights == pytest.approx((0.25, 0.75))
    assert film.frames[-1].weights == (0, 1)
    assert film.frames[30].camera.pose[0, 3] == pytest.approx(1)
    for frame in film.frames[1:30]:  # as far in its light as on its way
        assert frame.weights[1] == pytest.approx(0.75 * frame.camera.pose[0, 3], abs=1e-6)
    assert film.frames[0].camera == CAMERA
    assert keys[1].said == "25% a.jpg + 75% b.jpg"


def test_one_key_view_is_one_frame_and_none_is_refused():
    film = film_of([Key(CAMERA)], 2.0, {})
    assert [frame.camera for frame in film.frames] == [CAMERA]
    assert film.frames[0].weights is None
    with pytest.raises(CrossrayError, match="no key view yet"):
        film_of([], 2.0, {})


def test_a_path_is_saved_and_read_again(tmp_path):
    keys = [Key(CAMERA, ((A, 1.0),)), Key(moved(1), ((MINE, 1.0),))]
    file = save_path(tmp_path, "evening-1", keys, 1.0, 7.0)
    assert file == tmp_path / "paths" / "evening-1.json"
    film = read_camera_path(file, 7.0, {"x": CAMERA})
    assert len(film.frames) == 31
    np.testing.assert_allclose(film.frames[-1].camera.pose, moved(1).pose, atol=1e-9)
    assert film.frames[-1].camera.fy == pytest.approx(CAMERA.fy)
    assert np.reshape(json.loads(file.read_text())["camera_path"][-1]["camera_to_world"], (4, 4))[
        0, 3
    ] == pytest.approx(7)
    first, own = film.appearances
    assert first == "a.jpg"
    (kept,) = (tmp_path / "paths" / "photos").iterdir()
    assert str(kept) == own
    assert (kept.read_bytes(), kept.suffix) == (MINE.content, ".png")
    assert render_line(tmp_path, file).startswith(f"crossray render {tmp_path} --view {file} --out ")


@pytest.mark.parametrize("name", ["", "a/b", "..", "../x", ".x", "a b", "x" * 65, "a.json", "-x", "é", "a\n"])
def test_a_path_has_a_plain_name(tmp_path, name):
    with pytest.raises(CrossrayError, match="is no name for a path"):
        path_file(tmp_path, name)
    with pytest.raises(CrossrayError):
        save_path(tmp_path, name, [Key(CAMERA)], 1.0, 1.0)
    assert not list(tmp_path.iterdir())


# The server


def test_a_taken_port_and_a_wrong_host_are_told(trained):
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(CrossrayError, match=f"--port {port}: cannot listen there"):
            view_run(trained("crossray"), port=port)
        with pytest.raises(CrossrayError, match=f"--port {port}: taken by another program"):
            start_viser("127.0.0.1", port, "x")  # taken between the check and now
    with pytest.raises(CrossrayError, match=r"--host no.such.host.invalid: no such address"):
        check_address("no.such.host.invalid", 0)
    with pytest.raises(CrossrayError, match="cannot listen there"):
        check_address("192.0.2.1", 0)
    with pytest.raises(CrossrayError, match="is not a run"):
        view_run(trained("crossray") / "checkpoints", port=0)


def test_nothing_is_shared_through_a_public_host():
    server = start_viser("127.0.0.1", 0, "x")
    try:
        assert server.request_share_url() is None
        assert server.get_host() == "127.0.0.1"
    finally:
        server.stop()


@pytest.mark.slow
def test_the_command_says_where_and_ctrl_c_ends_it_at_once(run):
    code = (
        f"from pathlib import Path; from pipeline.viewer.server import view_run; view_run(Path({str(run())!r}), port=0)"
    )
    environment = {k: v for k, v in os.environ.items() if k != "DISPLAY"} | {"PYTHONUNBUFFERED": "1"}
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    )
    try:
        said = []
        while not said or "Ctrl-C" not in said[-1]:
            said.append(process.stdout.readline())
            assert said[-1], process.stderr.read()
        begun = time.monotonic()
        process.send_signal(signal.SIGINT)
        rest, errors = process.communicate(timeout=10)
    finally:
        process.kill()
    assert time.monotonic() - begun < 3
    assert "crossray, step 10" in said[0]
    assert said[1].startswith("http://127.0.0.1:")
    assert "has no display" in said[2]
    assert rest == ""
    assert errors.strip().endswith("KeyboardInterrupt")


# In Chromium


WINDOW, HEIGHT = 800, 560


@pytest.fixture(scope="module")
def chromium():
    found = os.environ.get("CROSSRAY_CHROMIUM") or shutil.which("chromium")
    if not found:
        pytest.skip("no Chromium: install it, or name it by CROSSRAY_CHROMIUM")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        browser = playwright.chromium.launch(executable_path=found, args=flags)
        yield browser
        browser.close()


@pytest.fixture
def served(run):
    """served(method): a viewer of a run of its own."""
    open_now = contextlib.ExitStack()

    def serve(method="crossray"):
        return open_now.enter_context(serving(open_gallery(Painter(run(method)), 100), port=0))

    with open_now:
        yield serve


@pytest.fixture
def look(chromium):
    """look(viewer): a page of its own, and its panel; at the end no page may have told of an error."""
    errors = []
    with contextlib.ExitStack() as pages:

        def come(viewer):
            page = chromium.new_page(viewport={"width": WINDOW, "height": HEIGHT})
            pages.callback(page.close)
            page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
            page.on("pageerror", lambda error: errors.append(str(error)))
            known = set(viewer.panels)
            page.goto(viewer.address)
            until_true(page, lambda: set(viewer.panels) - known)
            return page, viewer.panels[max(viewer.panels)]

        yield come
    assert errors == []


def scene(page):
    """Mean colour of the scene that the browser shows, left of the panel and below notices."""
    shot = page.screenshot(clip={"x": 0, "y": 320, "width": 400, "height": 230})
    return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB"), np.float64).mean((0, 1))


def until(page, met, seconds=20):
    """The scene's mean colour, once it meets a condition."""
    end = time.monotonic() + seconds
    while not met(found := scene(page)):
        assert time.monotonic() < end, f"still {found}"
    return found


def until_true(page, met, seconds=20):
    """Wait for something on the server's side; the page goes on meanwhile."""
    end = time.monotonic() + seconds
    while not met():
        assert time.monotonic() < end
        page.title()


def settled(page, panel):
    """The scene's mean colour, once the browser shows the server's sharp picture."""
    until_true(page, lambda: panel.standing is not None and panel.standing.idle)
    found = until(page, lambda found: panel.standing.idle and close_to(sent(panel), 1.5)(found))
    page.wait_for_function("document.querySelector('.crossray-status').innerText.endsWith(', sharp')")
    return found


def sent(panel):
    """The mean colour of the picture that stands now, where `scene` looks."""
    view, wish = panel.standing._kept.view, panel.standing.wish
    picture = Image.fromarray(picture_of(panel.standing.painter, view, wish))
    return np.asarray(picture.resize((WINDOW, HEIGHT), Image.Resampling.BILINEAR), np.float64)[320:550, :400].mean(
        (0, 1)
    )


def far_from(colour, least=2.0):
    return lambda found: np.abs(found - colour).max() > least


def close_to(colour, most=1.0):
    return lambda found: np.abs(found - colour).max() <= most


def farthest(panel, gallery):
    """The thumbnail in whose light the view looks most unlike what it is now."""
    kept, painter = panel.standing._kept.view, gallery.painter
    pictures = painter.paint(kept, [painter.read(name).F for name in gallery.strip])
    colours = np.array([picture.mean((0, 1)) for picture in pictures])
    return gallery.strip[int(np.abs(colours - colours[0]).max(1).argmax())]


def choose(page, label, name):
    """Choose in a dropdown, as a user does."""
    page.get_by_label(label, exact=True).click()
    page.get_by_role("option", name=name, exact=True).click()


@pytest.mark.slow
def test_a_click_on_a_thumbnail_changes_the_picture_and_the_slider_blends(served, look):
    viewer = served()
    page, panel = look(viewer)
    first = settled(page, panel)
    assert np.ptp(first) > 5  # a picture, and no grey page
    assert page.get_by_role("button", name="photo_").count() == 4
    other = farthest(panel, viewer.gallery)
    rendered = panel.standing._kept.view
    page.get_by_role("button", name=other).click()
    until(page, far_from(first))
    second = settled(page, panel)
    assert panel.standing._kept.view is rendered  # painted, not rendered
    page.get_by_role("button", name=viewer.gallery.strip[0]).click()
    until(page, close_to(first))
    choose(page, "Blend with", other)
    slider = page.get_by_role("slider")
    until(page, lambda found: far_from(first, 1.0)(found) and far_from(second, 1.0)(found))
    middle = settled(page, panel)
    share = ((middle - first) @ (second - first)) / ((second - first) @ (second - first))
    assert 0.05 < share < 0.95
    slider.focus()
    page.keyboard.press("End")
    until(page, close_to(second))
    page.keyboard.press("Home")
    until(page, close_to(first))


@pytest.mark.slow
def test_a_photo_of_one_s_own_is_taken_and_garbage_is_told(served, look, monkeypatch):
    viewer = served()
    page, panel = look(viewer)
    before = settled(page, panel)

    def upload(name, content):
        page.set_input_files("input[type=file]", {"name": name, "mimeType": "image/png", "buffer": content})

    upload("blue.png", png(colour=(5, 10, 250)))
    until(page, far_from(before))
    after = settled(page, panel)
    assert page.get_by_label("Appearance", exact=True).last.input_value() == "my photo: blue.png"
    upload("garbage.png", b"garbage")
    page.get_by_text("garbage.png: cannot be read as an image").wait_for()
    monkeypatch.setattr(appearance_tab, "LARGEST_FILE", 2000)
    upload("huge.png", bytes(4 * 2**20))
    page.get_by_text("huge.png: 4 MiB").wait_for()
    assert not panel.client.gui._current_file_upload_states
    upload("red.png", png(colour=(250, 10, 5)))  # the button works again
    until(page, far_from(after))


@pytest.mark.slow
def test_a_path_is_recorded(served, look):
    viewer = served()
    page, panel = look(viewer)
    page.get_by_role("tab", name="Film").click()
    page.get_by_role("button", name="Save path").click()
    page.get_by_text("there is no key view yet").wait_for()
    page.get_by_role("button", name="Add key view").click()
    page.locator(".crossray-keys li").nth(0).wait_for()
    page.get_by_role("tab", name="View").click()
    choose(page, "Fly to", "photo_005.jpg")
    page.get_by_role("button", name="Take the appearance of photo_005.jpg").click()
    settled(page, panel)
    page.get_by_role("tab", name="Film").click()
    page.get_by_role("button", name="Add key view").click()
    page.locator(".crossray-keys li").nth(1).wait_for()
    page.get_by_role("textbox").last.fill("../evil")
    page.get_by_role("button", name="Save path").click()
    page.get_by_text("is no name for a path").wait_for()
    page.get_by_role("textbox").last.fill("mine")
    page.get_by_role("button", name="Save path").click()
    line = page.locator(".crossray-saved code").inner_text()
    folder = viewer.gallery.painter.run / "paths"
    assert [path.name for path in folder.iterdir()] == ["mine.json"]
    assert f"--view {folder / 'mine.json'} " in line
    photos = viewer.gallery.painter.photos
    cameras = {record.name: camera_of(record) for record in photos.records}
    film = read_camera_path(folder / "mine.json", photos.manifest.scene.scale, cameras)
    assert film.appearances[-1] == "photo_005.jpg"
    last, photo = film.frames[-1].camera.pose, cameras["photo_005.jpg"].pose
    np.testing.assert_allclose(last[:, 3], photo[:, 3], atol=1e-4)  # where it was taken
    assert last[:, 2] @ photo[:, 2] > 0.9999
    page.get_by_role("button", name="Remove the last").click()
    until_true(page, lambda: page.locator(".crossray-keys li").count() == 1)
    assert len(panel.path.keys) == 1
    page.get_by_role("button", name="Clear").click()
    page.get_by_text("no key view yet", exact=True).wait_for()


@pytest.mark.slow
def test_cameras_in_the_scene_are_clicked_and_what_is_shown_is_chosen(served, look, monkeypatch):
    monkeypatch.setattr(view_tab, "FRUSTUM", 0.5)  # large enough to be hit from afar
    viewer = served()
    page, panel = look(viewer)
    colours = settled(page, panel)
    page.get_by_role("tab", name="View").click()
    choose(page, "Show", "Depth (near is bright)")
    until(page, lambda found: np.ptp(found) < 0.01)  # grey
    choose(page, "Show", "Colours")
    until(page, close_to(colours))
    page.get_by_role("checkbox").click()
    place = viewer.gallery.place
    until_true(page, lambda: {n for n, f in panel.view._frusta.items() if f.visible} == others(place))
    back = 2.5 * np.array(place.start.c2w)[:, 3]  # so that all stand before it
    panel.client.camera.position = back
    until_true(page, lambda: panel.standing.wish.camera.pose[:, 3] == pytest.approx(back) and panel.standing.idle)
    target = next(record for record in place.records if record.name == "photo_005.jpg")  # left, not under the panel
    pose = np.array(target.c2w)
    take = page.get_by_role("button", name=f"Take the appearance of {target.name}")
    click_until(page, pixel_of(panel, pose[:, 3] + 0.1 * pose[:, 2]), take)
    take.click()
    until_true(page, lambda: np.allclose(panel.client.camera.position, np.array(target.c2w)[:, 3], atol=1e-4))
    assert panel.appearance.first.value == target.name
    page.get_by_role("button", name="Back to the start").click()
    page.get_by_role("checkbox").click()
    until_true(page, lambda: np.allclose(panel.client.camera.position, np.array(place.start.c2w)[:, 3], atol=1e-4))
    until_true(page, lambda: not any(frustum.visible for frustum in panel.view._frusta.values()))


def others(place):
    return {record.name for record in place.records} - {place.start.name}


def click_until(page, pixel, appears):
    """Click into the scene as a user does: again where the browser had not drawn yet what the server sent."""
    from playwright.sync_api import TimeoutError as NotYet

    for _ in range(10):
        page.mouse.click(*pixel)
        try:
            return appears.wait_for(timeout=5_000)
        except NotYet:
            continue
    raise AssertionError(f"{appears} did not appear")


def pixel_of(panel, point):
    """Where a point is in the browser's window."""
    camera = panel.camera()
    x, y, z = camera.pose[:, :3].T @ (point - camera.pose[:, 3])
    scale = panel.client.camera.image_width / camera.width
    return scale * (camera.fx * x / z + camera.cx), scale * (camera.fy * y / z + camera.cy)


@pytest.mark.slow
def test_two_browsers_do_not_disturb_each_other_and_are_forgotten(served, look):
    viewer = served()
    (one, mine), (two, other) = look(viewer), look(viewer)
    before = settled(one, mine)
    assert close_to(before)(settled(two, other))
    two.get_by_role("button", name=farthest(other, viewer.gallery)).click()
    until(two, far_from(before))
    camera = other.standing.wish.camera
    two.mouse.move(200, 400)
    two.mouse.down()
    two.mouse.move(300, 420, steps=20)
    two.mouse.up()
    until_true(two, lambda: other.standing.wish.camera != camera)  # it turned
    settled(two, other)
    assert close_to(before)(settled(one, mine))
    two.close()
    until_true(one, lambda: list(viewer.panels.values()) == [mine])
    assert len(viewer._easel._standing) == 1
    one.get_by_role("button", name=farthest(mine, viewer.gallery)).click()
    until(one, far_from(before))


@pytest.mark.slow
def test_one_browser_too_many_is_told(served, chromium, monkeypatch):
    monkeypatch.setattr(viewer_server, "MOST_BROWSERS", 0)
    page = chromium.new_page()
    viewer = served()
    page.goto(viewer.address)
    page.get_by_text("browsers look at this run already: close one, and reload").wait_for()
    assert not viewer.panels
    page.close()


@pytest.mark.slow
def test_a_run_without_appearances_has_no_controls_for_them(served, look):
    page, panel = look(served("nerf"))
    settled(page, panel)
    assert page.get_by_role("tab").all_inner_texts() == ["View", "Film"]


@pytest.mark.slow
@pytest.mark.parametrize("method", ["hanerf", "nerfw"])
def test_a_coded_model_is_rendered_anew(served, look, method):
    viewer = served(method)
    page, panel = look(viewer)
    settled(page, panel)
    kept = panel.standing._kept.view
    page.get_by_role("button", name=viewer.gallery.strip[-1]).click()
    until_true(page, lambda: panel.standing._kept.view is not kept and panel.standing.idle)
    assert page.get_by_role("button", name="Use my own photo").count() == (method == "hanerf")
