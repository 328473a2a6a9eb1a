"""Camera paths: loops and flights stay where photos were taken, files are read and written as their formats say, and
`--view` finds what it names or says why not."""

from __future__ import annotations

import contextlib
import itertools
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation, Slerp

from pipeline.errors import CrossrayError
from pipeline.views.camera import Camera, posed, resized
from pipeline.views.choose import Stills, read_path, readings, stops_of, views_of
from pipeline.views.geometry import focus_of, looking, up_of, weighted_median
from pipeline.views.nerfstudio import read_camera_path, write_camera_path
from pipeline.views.path import CameraPath, Frame, path_of
from pipeline.views.smooth import between, bounds_at, orbit, there_and_back, together, travel_times, unrolled
from pipeline.views.trajectory import read_trajectory, write_trajectory

UP = np.array([0.0, -1.0, 0.0])  # the world of these tests is like a level camera's: y down
LENS = Camera(48, 32, 40.0, 40.0, 24.0, 16.0, ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0)), 0.5, 9.0)
few = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def camera_at(centre, towards, lens=LENS) -> Camera:
    """A level camera at a point that looks towards another one."""
    forward = np.asarray(towards, float) - centre
    rotation = looking(forward / np.linalg.norm(forward), UP)
    return posed(lens, np.column_stack([rotation, centre]))


def ring(degrees, radius=4.0, inwards=True) -> list[Camera]:
    """Cameras around the origin, at azimuths in degrees: 0 is at z = -radius and looks along +z."""
    a = np.radians(degrees)
    centres = np.column_stack([radius * np.sin(a), 0 * a, -radius * np.cos(a)])
    return [camera_at(c, (0, 0, 0) if inwards else 2 * c) for c in centres]


def poses_of(cameras) -> np.ndarray:
    return np.array([camera.pose for camera in cameras])


def angle_between(a, b) -> np.ndarray:
    """Degrees between unit vectors, elementwise."""
    return np.degrees(np.arccos(np.clip((a * b).sum(-1), -1, 1)))


def assert_usable(cameras) -> None:
    """Every camera is finite and its rotation proper."""
    poses = poses_of(cameras)
    assert np.isfinite(poses).all()
    R = poses[:, :, :3]
    np.testing.assert_allclose(np.swapaxes(R, 1, 2) @ R, np.broadcast_to(np.eye(3), R.shape), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(R), 1, atol=1e-9)
    for c in cameras:
        assert all(math.isfinite(v) for v in (c.fx, c.fy, c.cx, c.cy, c.near, c.far))
        assert c.fx > 0
        assert c.fy > 0
        assert c.near < c.far


def jumps(cameras, closed=True) -> tuple[np.ndarray, np.ndarray]:
    """How far, and by how many degrees, each frame is from the next one, and of a loop the last from the first."""
    poses = poses_of([*cameras, *cameras[:1]] if closed else cameras)
    moved = np.linalg.norm(np.diff(poses[:, :, 3], axis=0), axis=1)
    return moved, angle_between(poses[1:, :, 2], poses[:-1, :, 2])


# ------------------------------------------------------------------------------------------------------ geometry


def test_looking_is_level_and_looks_forward():
    R = looking(np.array([1.0, 0, 0]), UP)
    np.testing.assert_allclose(R, [[0, 0, 1], [0, 1, 0], [-1, 0, 0]])  # right of +x is -z, down is +y
    straight_up = looking(UP, UP)
    np.testing.assert_allclose(straight_up.T @ straight_up, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(straight_up[:, 2], UP)


def test_weighted_median_resists_an_outlier():
    points = np.array([[0.0, 0], [1, 0], [0, 1], [1, 1], [100, 100]])
    median = weighted_median(points, np.full((1, 5), 0.2))[0]
    assert np.abs(median).max() < 1.2  # the mean is at 20.4


def test_focus_is_where_most_axes_meet():
    cameras = [camera_at(c, (1, 0.5, 2)) for c in ((0, 0, 0), (3, 0, 0), (-2, 0, 0), (0, -1, -1), (2, 0, -3))]
    cameras.append(camera_at((5, 0, 0), (9, 0, -3)))  # looks elsewhere
    np.testing.assert_allclose(focus_of(poses_of(cameras), 3.0), (1, 0.5, 2), atol=0.05)


def test_focus_of_parallel_axes_is_as_far_as_assumed():
    cameras = [camera_at((x, 0, 0), (x, 0, 1)) for x in (-1.0, 0.0, 1.0)]
    np.testing.assert_allclose(focus_of(poses_of(cameras), 5.0), (0, 0, 5), atol=1e-6)


def tilted_up() -> list[Camera]:
    """Cameras on an arc that look 20 degrees up."""
    return [camera_at(c.pose[:, 3], (0, -4 * math.tan(math.radians(20)), 0)) for c in ring(range(-60, 61, 10))]


def test_up_is_vertical_though_all_photos_are_tilted():
    """The mean of their own up leans back, away from the building."""
    poses = poses_of(tilted_up())
    assert angle_between(up_of(poses), UP) < 3
    own = -poses[:, :, 1].mean(0)
    assert angle_between(own / np.linalg.norm(own), UP) > 10


def test_up_ignores_photos_that_were_rolled():
    cameras = tilted_up()
    roll = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    rolled = [posed(c, np.column_stack([c.pose[:, :3] @ roll, c.pose[:, 3]])) for c in cameras[::4]]
    assert angle_between(up_of(poses_of(cameras + rolled)), UP) < 4


def test_up_of_cameras_that_look_down_is_across_their_view():
    """As from the air: their x axes span the ground, and what is upright to it is where they look."""
    yaws = np.radians(range(-60, 61, 20))
    down = [camera_at((i, -5, 0), (i + math.sin(a), 0, math.cos(a))) for i, a in enumerate(yaws)]
    poses = poses_of(down)
    assert np.median(angle_between(up_of(poses), poses[:, :, 2])) > 60


# --------------------------------------------------------------------------------------------------------- orbit


def test_orbit_follows_an_arc_and_comes_back():
    frames = orbit(ring(range(-60, 61, 5)), 120)
    assert_usable(frames)
    p = poses_of(frames)
    azimuth = np.degrees(np.arctan2(p[:, 0, 3], -p[:, 2, 3]))
    assert np.abs(azimuth).max() <= 60
    assert azimuth.max() > 45  # cameras at an end have neighbours on one side only
    assert azimuth.min() < -45
    radius = np.linalg.norm(p[:, :, 3], axis=1)
    assert radius.min() > 3.75  # a local mean of an arc lies a little inside of it: 4 cos 12 degrees = 3.91
    assert radius.max() <= 4
    towards = -p[:, :, 3] / radius[:, None]
    assert angle_between(p[:, :, 2], towards).max() < 1  # looks at what they look at
    np.testing.assert_allclose(p[1:, :, 3], p[:0:-1, :, 3], atol=1e-9)  # back along the same way
    moved, turned = jumps(frames)
    assert moved.max() < 2 * moved.mean()
    assert turned.max() < 2 * turned.mean()
    assert moved[0] < 0.1 * moved.max()  # slow where it turns round
    assert np.abs(np.diff(moved)).max() < 0.1 * moved.max()


def test_orbit_is_a_full_circle_where_cameras_surround_the_place():
    frames = orbit(ring(range(0, 360, 15)), 100)
    assert_usable(frames)
    p = poses_of(frames)
    azimuth = np.unwrap(np.arctan2(p[:, 0, 3], -p[:, 2, 3]))
    assert abs(abs(azimuth[-1] - azimuth[0]) - 2 * math.pi * 0.99) < 0.01
    moved, turned = jumps(frames)
    np.testing.assert_allclose(moved, moved.mean(), rtol=0.1)
    np.testing.assert_allclose(turned, 3.6, rtol=0.1)


def test_the_seam_of_a_circle_is_as_smooth_as_the_rest():
    frames = orbit(ring(range(0, 360, 45)), 160)  # eight cameras: a rounded octagon
    p = poses_of(frames)[:, :, 3]
    bends = np.linalg.norm(np.roll(p, -1, 0) - 2 * p + np.roll(p, 1, 0), axis=1).reshape(8, 20)
    np.testing.assert_allclose(bends, np.broadcast_to(bends[3], bends.shape), atol=0.3 * bends.max())


def test_orbit_of_a_room_looks_outwards():
    cameras = ring(range(0, 360, 15), radius=1.0, inwards=False)
    frames = orbit(cameras, 60)
    assert_usable(frames)
    p = poses_of(frames)
    outwards = p[:, :, 3] / np.linalg.norm(p[:, :, 3], axis=1, keepdims=True)
    assert angle_between(p[:, :, 2], outwards).max() < 3
    assert jumps(frames)[1].max() < 12


def test_orbit_turns_on_the_spot_where_all_photos_are_from_one():
    cameras = [posed(c, np.column_stack([c.pose[:, :3], (1, 2, 3)])) for c in ring(range(-80, 81, 10))]
    frames = orbit(cameras, 60)
    assert_usable(frames)
    p = poses_of(frames)
    np.testing.assert_allclose(p[:, :, 3], np.broadcast_to((1, 2, 3), (60, 3)), atol=1e-9)
    assert angle_between(p[:, None, :, 2], p[None, :, :, 2]).max() > 120


def test_orbit_does_not_cross_a_gap():
    """Two groups on opposite sides: the way between them would lead through what they look at."""
    frames = orbit(ring([*range(-40, 41, 5), *range(170, 191, 5)]), 40)
    p = poses_of(frames)
    assert np.linalg.norm(p[:, :, 3], axis=1).min() > 3.6
    assert np.abs(np.degrees(np.arctan2(p[:, 0, 3], -p[:, 2, 3]))).max() <= 40


def test_orbit_ignores_one_stray_camera():
    stray = camera_at((0, -30, -80), (0, 0, 0))
    frames = orbit([*ring(range(-60, 61, 5)), stray], 60)
    assert np.linalg.norm(poses_of(frames)[:, :, 3], axis=1).max() < 4.2


@few
@given(
    st.integers(0, 2**32 - 1),
    st.integers(12, 60),
    st.floats(20, 180),
    st.sampled_from([1e-3, 1.0, 1e3]),
)
def test_orbit_stays_among_the_cameras_and_looks_as_they_do(seed, count, half, scale):
    """Photos of a place from an arc, at distances from 3 to 5 and heights that vary, each with an aim of its own: every
    centre lies in their hull, and no further from a photo than photos are from each other; every view is one that the
    photos nearby have, too."""
    rng = np.random.default_rng(seed)
    a = np.radians(np.linspace(-half, half, count))
    r = rng.uniform(3, 5, count)
    centres = np.column_stack([r * np.sin(a), rng.uniform(-0.5, 0.5, count), -r * np.cos(a)]) * scale
    lens = replace(LENS, near=0.5 * scale, far=9 * scale)
    cameras = [camera_at(c, rng.uniform(-0.4, 0.4, 3) * scale, lens) for c in centres]
    frames = orbit(cameras, 90)
    assert_usable(frames)
    p, c = poses_of(frames), poses_of(cameras)
    hull = ConvexHull(centres).equations
    assert (p[:, :, 3] @ hull[:, :3].T + hull[:, 3]).max() < 1e-5 * scale
    distance = np.linalg.norm(p[:, None, :, 3] - c[None, :, :, 3], axis=2)
    line = np.vstack([centres, centres[:1]]) if 360 - 2 * half <= 60 else centres  # a gap of 60 degrees is crossed
    apart = np.linalg.norm(np.diff(line, axis=0), axis=1).max()
    assert distance.min(1).max() <= apart
    nearest = distance.argsort(1)[:, :8]
    turned = angle_between(p[:, None, :, 2], c[nearest][..., 2])
    assert turned.min(1).max() < 35  # half of what a gap may be, and their own aims
    moved, turn = jumps(frames)
    assert moved.max() < 4 * max(moved.mean(), 1e-9)
    assert turn.max() < 20
    level = angle_between(p[:, :, 0], UP)
    assert np.abs(level - 90).max() < 6


@st.composite
def any_cameras(draw):
    """1 to 6 cameras that stand and look anyhow: in one spot, on a line, apart, straight up."""
    count = draw(st.integers(1, 6))
    scale = draw(st.sampled_from([1e-4, 1.0, 1e4]))
    grid = st.integers(-2, 2)
    rows = st.tuples(grid, grid, grid)
    turns = st.tuples(*[st.integers(-4, 4).map(lambda k: 45.0 * k)] * 3)
    together = draw(st.booleans())
    place = draw(rows)
    cameras = []
    for _ in range(count):
        centre = np.array(place if together else draw(rows)) * scale
        rotation = Rotation.from_euler("xyz", draw(turns), degrees=True).as_matrix()
        lens = replace(LENS, near=draw(st.floats(0.01, 1)) * scale, far=draw(st.floats(1.5, 10)) * scale)
        cameras.append(posed(lens, np.column_stack([rotation, centre])))
    return cameras


@settings(few, max_examples=80)
@given(any_cameras(), st.integers(1, 12))
def test_orbit_of_any_cameras_is_usable_and_within_their_box(cameras, count):
    frames = orbit(cameras, count)
    assert len(frames) == count
    assert_usable(frames)
    p, c = poses_of(frames)[:, :, 3], poses_of(cameras)[:, :, 3]
    slack = 1e-6 * (1 + np.abs(c).max())
    assert (p >= c.min(0) - slack).all()
    assert (p <= c.max(0) + slack).all()


@pytest.mark.parametrize("count", [1, 2, 3])
def test_orbit_of_few_cameras_keeps_to_them(count):
    cameras = ring([0, 30, 60][:count])
    frames = orbit(cameras, 50)
    assert_usable(frames)
    p = poses_of(frames)
    assert np.linalg.norm(p[:, :, 3], axis=1).min() > 3.6
    if count == 1:
        np.testing.assert_allclose(p, np.broadcast_to(cameras[0].pose, p.shape), atol=1e-6)
    else:
        assert angle_between(p[:, None, :, 2], p[None, :, :, 2]).max() > 20 * (count - 1)


def test_orbit_of_cameras_on_a_line_goes_along_it():
    cameras = [camera_at((x, 0, 0), (x, 0, 1)) for x in np.linspace(-2, 2, 9)]
    p = poses_of(orbit(cameras, 60))
    assert np.ptp(p[:, 0, 3]) > 2.5
    np.testing.assert_allclose(p[:, 1:, 3], 0, atol=1e-9)
    assert angle_between(p[:, :, 2], np.array([0.0, 0, 1])).max() < 10


def test_orbit_sees_what_the_median_photo_sees_across_its_shorter_side():
    landscape, portrait = LENS, replace(LENS, width=32, height=48, cx=16.0, cy=24.0)  # 32 pixels at f = 40, both
    arc = ring(range(-30, 31, 10))
    lens = orbit([posed(portrait if i % 2 else landscape, c.pose) for i, c in enumerate(arc)], 4)[0]
    assert (lens.width, lens.height, lens.cx, lens.cy) == (48, 32, 24, 16)
    assert lens.fx == lens.fy == pytest.approx(40)
    small = orbit(arc, 4, (30, 20))[0]
    assert (small.width, small.height) == (30, 20)
    assert small.fy == pytest.approx(25)


def test_orbit_refuses():
    with pytest.raises(CrossrayError, match="there is none"):
        orbit([], 10)
    with pytest.raises(CrossrayError, match="0 frames"):
        orbit([LENS], 0)
    with pytest.raises(CrossrayError, match="0 x 5"):
        orbit([LENS], 3, (0, 5))


def slow_bounds(cameras, centre):
    """Means of logarithms, by Franke and Little's weights: the nine nearest cameras, one by one."""
    distances = sorted((float(np.linalg.norm(c.pose[:, 3] - centre)), i) for i, c in enumerate(cameras))
    end = distances[8][0]
    weights = [((end - d) / (end * d)) ** 2 for d, _ in distances[:8]]
    logs = [(math.log(cameras[i].near), math.log(cameras[i].far)) for _, i in distances[:8]]
    return [math.exp(sum(w * n[k] for w, n in zip(weights, logs, strict=True)) / sum(weights)) for k in (0, 1)]


def test_bounds_are_those_of_the_nearest_cameras():
    cameras = [replace(camera_at((x, 0, 0), (x, 0, 1)), near=1 + x, far=10 + x) for x in range(20)]
    places = np.array([(x, 0.1, 0.2) for x in np.linspace(-1.3, 21.7, 24)])
    np.testing.assert_allclose(bounds_at(cameras, places), [slow_bounds(cameras, p) for p in places], rtol=1e-5)
    standing = np.array([c.pose[:, 3] for c in cameras])
    np.testing.assert_allclose(bounds_at(cameras, standing)[3], (4, 13), rtol=1e-6)  # where a camera is: its own
    np.testing.assert_allclose(bounds_at(cameras[:2], np.array([[0.5, 0, 0]])), [(math.sqrt(2), math.sqrt(110))])
    np.testing.assert_allclose(bounds_at(cameras[:1], np.array([[9.0, 0, 0], [0.0, 0, 0]])), [(1, 10)] * 2)
    np.testing.assert_allclose(bounds_at([cameras[0]] * 20, np.zeros((1, 3))), [(1, 10)])


def test_bounds_change_smoothly():
    rng = np.random.default_rng(0)
    cameras = [
        replace(camera_at(rng.uniform(-1, 1, 3), (0, 0, 9)), near=rng.uniform(0.1, 1), far=rng.uniform(2, 9))
        for _ in range(40)
    ]
    way = np.linspace(-1, 1, 4000)[:, None] * np.array([0.7, 0.5, -0.6])
    steps = np.abs(np.diff(np.log(bounds_at(cameras, way)), axis=0))
    assert steps.max() < 0.02  # no jump where one camera takes another's place among the nearest


def test_orbit_of_few_cameras_apart_is_a_flight_among_those_together():
    """Eight photos, placed as the training photos of a real small collection: three beside the place, two before it,
    three from afar by telephoto."""
    target = (-0.1, 0.3, 2.0)
    beside = [camera_at(c, target) for c in ((-0.79, 0.47, 1.48), (-0.89, 0.33, 1.2), (-0.85, 0.34, 1.23))]
    before = [camera_at(c, target) for c in ((-0.35, 0.4, 1.41), (-0.17, 0.24, 0.9))]
    tele = replace(LENS, fx=150.0, fy=150.0, near=2.3, far=4.7)
    afar = [camera_at(c, target, tele) for c in ((0.63, -0.45, -1.65), (0.74, -0.47, -1.67), (0.74, -0.45, -1.64))]
    frames = orbit([*afar, *before, *beside], 40)
    assert_usable(frames)
    assert len(frames) == 40
    p = poses_of(frames)[:, :, 3]
    ends = poses_of(beside)[:, :, 3]
    assert (p >= ends.min(0) - 1e-9).all()
    assert (p <= ends.max(0) + 1e-9).all()
    assert np.ptp(p, axis=0) == pytest.approx(np.ptp(ends, axis=0), rel=0.05)  # past all of them
    np.testing.assert_allclose(p[1:20], p[:20:-1])  # there and back, without the first frame twice
    moved = jumps(frames)[0]
    assert max(moved[0], moved[19], moved[20]) < 0.3 * moved.max()  # slow where it turns
    assert {f.near for f in frames} == {LENS.near}  # none of the telephotos'


def test_a_burst_is_one_stop():
    """20 photos in each of three spots, and six alone: the flight passes the spots."""
    spots = [camera_at(c, (0, 0, 0)) for c in ((4, 0, 0), (3.9, 0, 0.6), (3.7, 0, 1.1))]
    alone = [camera_at((4 * math.cos(a), 0, 4 * math.sin(a)), (0, 0, 0)) for a in (1.3, 2.2, 3.1, 4.0, 4.9, 5.6)]
    poses = poses_of([*(s for s in spots for _ in range(20)), *alone])
    assert sorted(k // 20 for k in together(poses, np.zeros((66, 3)))) == [0, 1, 2]
    assert len(together(poses_of(alone), np.zeros((6, 3)))) == 1


def test_stops_follow_each_other_across_the_back():
    angles = np.radians([178, -170, 160, -178, 170])
    assert np.degrees(angles[unrolled(angles)]).round().tolist() == [160, 170, 178, -178, -170]
    assert unrolled(np.array([0.3])).tolist() == [0]


@pytest.mark.parametrize("count", [1, 2, 3, 4, 7])
def test_there_and_back_is_a_loop_of_any_length(count):
    x = poses_of(there_and_back([camera_at((i, 0, -4), (i, 0, 0)) for i in range(2)], count, LENS))[:, 0, 3]
    share = np.array([1 - abs(1 - 2 * k / count) for k in range(count)])
    np.testing.assert_allclose(x, share * share * (3 - 2 * share), atol=1e-9)


def test_a_zoom_takes_its_time():
    stops = ring([0, 30, 30])
    zoomed = [*stops[:2], replace(stops[2], fx=160.0, fy=160.0)]
    plain, slower = travel_times(stops), travel_times(zoomed)
    assert plain[2] - plain[1] == pytest.approx(1e-2)
    turn, zoom = math.radians(30), 0.5 * math.log(4)
    assert slower[2] - slower[1] == pytest.approx(zoom / ((turn + zoom) / 2) + 1e-2)


def test_a_flight_shows_no_more_than_its_photos():
    portrait = replace(LENS, width=32, height=48, cx=16.0, cy=24.0)
    cameras = [camera_at((0.1 * i, 0, -4), (0, 0, 0), portrait) for i in range(2)]
    frames = there_and_back(cameras, 5, replace(LENS, width=48, height=32, cx=24.0, cy=16.0))
    for frame in frames:
        assert frame.width / frame.fx <= portrait.width / portrait.fx + 1e-9
        assert frame.height / frame.fy <= portrait.height / portrait.fy + 1e-9


# ------------------------------------------------------------------------------------------------------- flights


def test_between_two_cameras():
    a = replace(ring([0])[0], near=0.1, far=4.0)
    b = replace(ring([90])[0], fx=160.0, fy=160.0, near=0.4, far=16.0)
    frames = between([a, b], 101)
    assert_usable(frames)
    assert frames[0] == a
    assert frames[-1] == b
    middle, early = frames[50], frames[25]
    np.testing.assert_allclose(middle.pose[:, 3], (2, 0, -2), atol=1e-12)  # of (0, 0, -4) and (4, 0, 0)
    assert (middle.fx, middle.near, middle.far) == pytest.approx((80, 0.2, 8))  # geometric means
    # at a quarter of the time, eased: 3/16 - 2/64 = 5/32 of the way
    np.testing.assert_allclose(early.pose[:, 3], (4 * 5 / 32, 0, -4 + 4 * 5 / 32), atol=1e-12)
    slerp = Slerp([0, 1], Rotation.from_matrix(poses_of([a, b])[:, :, :3]))
    np.testing.assert_allclose(early.pose[:, :3], slerp(5 / 32).as_matrix(), atol=1e-9)
    moved, _ = jumps(frames, closed=False)
    assert moved[0] < 0.05 * moved.max()
    assert moved[-1] < 0.05 * moved.max()


def test_between_takes_the_size_of_the_first_stop():
    a, b = ring([0, 30])
    b = replace(b, width=96, height=96, cx=50.0, cy=48.0)
    frames = between([a, b], 5)
    assert {(f.width, f.height) for f in frames} == {(48, 32)}
    assert frames[-1] == resized(b, 48, 32)
    assert frames[-1].fx == pytest.approx(40 / 3)


@few
@given(any_cameras().filter(lambda c: len(c) > 1), st.integers(1, 40))
def test_between_any_stops(stops, count):
    frames = between(stops, count)
    assert len(frames) == count
    assert_usable(frames)
    assert frames[0] == stops[0]
    if count > 1:
        assert frames[-1] == stops[-1]
    p, c = poses_of(frames)[:, :, 3], poses_of(stops)[:, :, 3]
    slack = 1e-9 * (1 + np.abs(c).max())
    assert (p >= c.min(0) - slack).all()
    assert (p <= c.max(0) + slack).all()


def test_between_several_stops_passes_each_without_a_jerk():
    stops = ring([0, 20, 60, 90])
    frames = between(stops, 400)
    p = poses_of(frames)
    for stop in stops:
        off = np.linalg.norm(p[:, :, 3] - stop.pose[:, 3], axis=1)
        assert off.min() < 0.03
        assert angle_between(p[off.argmin(), :, 2], stop.pose[:, 2]) < 0.5
    moved, turned = jumps(frames, closed=False)
    assert np.abs(np.diff(moved)).max() < 0.05 * moved.max()
    assert np.abs(np.diff(turned)).max() < 0.05 * turned.max()


def test_between_refuses():
    with pytest.raises(CrossrayError, match="two cameras"):
        between([LENS], 5)
    with pytest.raises(CrossrayError, match="-1 frames"):
        between([LENS, LENS], -1)


# --------------------------------------------------------------------------------------------------------- paths


def test_a_path_has_one_size_and_fitting_weights():
    with pytest.raises(CrossrayError, match="0 frames"):
        CameraPath(())
    with pytest.raises(CrossrayError, match="nan frames per second"):
        path_of([LENS], math.nan)
    with pytest.raises(CrossrayError, match=r"frame 1 .* 24 x 16 pixels, the first has 48 x 32"):
        path_of([LENS, resized(LENS, 24, 16)])
    for weights in ((0.5,), (1.0, 0.0), (-1.0, 2.0, 0.0), (0.5, 0.2, 0.2), ()):
        with pytest.raises(CrossrayError, match=r"frame 0 .* appearance weights"):
            CameraPath((Frame(LENS, weights),), 24, ("a", "b", "c"))
    assert CameraPath((Frame(LENS, (0.25, 0.75)),), 24, ("a", "b")).size == (48, 32)


# --------------------------------------------------------------------------------------------------------- files

TRAIN = {f"photo {i}.jpg": replace(camera_at((i, 0, 0), (i, 0, 1)), near=0.5 + i, far=10.0 + i) for i in range(3)}

# 200 x 100 pixels, 90 degrees upright: f = 50 / tan 45. The camera stands at (2, 4, 6) COLMAP units, at scale 2 at
# (1, 2, 3); its OpenGL axes x, y, z are the world's y, z, x, so that OpenCV's y and z are -z and -x.
NERFSTUDIO = """
{
  "camera_type": "perspective", "render_height": 100, "render_width": 200, "fps": 24, "seconds": 1, "keyframes": [],
  "is_cycle": false, "smoothness_value": 0.5, "crop": null,
  "camera_path": [
    {"camera_to_world": [0, 0, 1, 2,  1, 0, 0, 4,  0, 1, 0, 6,  0, 0, 0, 1], "fov": 90, "aspect": 2,
     "render_time": 0.0, "appearance_weights": [0.25, 0.75]},
    {"camera_to_world": [1, 0, 0, 0,  0, 1, 0, 0,  0, 0, 1, 0,  0, 0, 0, 1], "fov": 60, "aspect": 2}
  ],
  "appearances": [{"image": "photo 0.jpg"}, {"image": "/tmp/evening.jpg"}]
}
"""
AS_OPENCV = ((0, 0, -1, 1), (1, 0, 0, 2), (0, -1, 0, 3))

TRAJECTORY = """
{
  "format": "nerfbaselines-v1", "camera_model": "pinhole", "image_size": [200, 100], "fps": 3,
  "source": {"type": "interpolation", "interpolation": "kochanek-bartels", "keyframes": []},
  "frames": [
    {"pose": [0, 0, -1, 2,  1, 0, 0, 4,  0, -1, 0, 6], "intrinsics": [50, 60, 101, 49],
     "appearance_weights": [1, 0, 0]},
    {"pose": [0, 0, -1, 2,  1, 0, 0, 4,  0, -1, 0, 6], "intrinsics": [50, 60, 101, 49], "appearance_weights": []},
    {"pose": [0, 0, -1, 2,  1, 0, 0, 4,  0, -1, 0, 6], "intrinsics": [50, 60, 101, 49],
     "appearance_weights": [-0.1, 0.5, 0.5]}
  ],
  "appearances": [{"embedding_train_index": 2}, {"embedding_train_index": 0}, {"image": "evening.jpg"}]
}
"""


@pytest.fixture
def file(tmp_path):
    """file(text): a path file that holds it."""

    def write(text):
        path = tmp_path / "path.json"
        path.write_text(text if isinstance(text, str) else json.dumps(text))
        return path

    return write


def test_nerfstudio_file_by_hand(file):
    path = read_camera_path(file(NERFSTUDIO), 2.0, TRAIN)
    first, second = path.frames
    np.testing.assert_allclose(first.camera.pose, AS_OPENCV, atol=1e-12)
    np.testing.assert_allclose(second.camera.pose, np.diag((1, -1, -1, 0))[:3], atol=1e-12)
    lens = first.camera
    assert (lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy) == pytest.approx((200, 100, 50, 50, 100, 50))
    assert second.camera.fy == pytest.approx(50 * math.sqrt(3))  # 50 / tan 30
    assert [[lens.near, lens.far]] == bounds_at(list(TRAIN.values()), np.array([AS_OPENCV])[:, :, 3]).tolist()
    assert (path.fps, path.appearances) == (24, ("photo 0.jpg", "/tmp/evening.jpg"))
    assert first.weights == (0.25, 0.75)
    assert second.weights is None


def test_nerfbaselines_file_by_hand(file):
    path = read_trajectory(file(TRAJECTORY), 2.0, TRAIN)
    first, second, third = path.frames
    np.testing.assert_allclose(first.camera.pose, AS_OPENCV, atol=1e-12)
    lens = first.camera
    assert (lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy) == (200, 100, 50, 60, 101, 49)
    assert path.fps == 3
    assert path.appearances == ("photo 2.jpg", "photo 0.jpg", "evening.jpg")
    assert first.weights == (1, 0, 0)
    assert second.weights is None
    assert third.weights == (0, 0.5, 0.5)  # a spline went below 0


def test_nerfstudio_reads_what_we_write(tmp_path):
    """Its reader in few words: focal length from fov and height, matrices row by row, OpenGL axes."""
    frames = orbit(ring(range(-40, 41, 10)), 50)
    write_camera_path(tmp_path / "path.json", path_of(frames, 25), 3.0)
    content = json.loads((tmp_path / "path.json").read_text())
    assert content["camera_type"] == "perspective"
    assert content["seconds"] == 2
    assert (content["render_width"], content["render_height"]) == (48, 32)
    assert len(content["keyframes"]) == 24
    assert content["keyframes"][-1]["matrix"] == content["camera_path"][-1]["camera_to_world"]
    for entry, frame in zip(content["camera_path"], frames, strict=True):
        c2w = np.array(entry["camera_to_world"]).reshape(4, 4)
        np.testing.assert_allclose(c2w[:3, 3], 3 * frame.pose[:, 3])
        np.testing.assert_allclose(c2w[:3, 2], -frame.pose[:, 2])  # looks along -z
        assert 16 / np.tan(entry["fov"] * np.pi / 180 / 2) == pytest.approx(frame.fy)
        assert entry["aspect"] == 1.5


def test_nerfbaselines_reads_what_we_write(tmp_path):
    """By its own code where it is installed; else by the lines of it that matter."""
    frames = [Frame(c, (0.25, 0.75)) for c in orbit(ring(range(-40, 41, 10)), 10)]
    names = ("photo 2.jpg", "photo 0.jpg")
    write_trajectory(tmp_path / "path.json", CameraPath(tuple(frames), 25, names), 3.0, list(TRAIN))
    content = json.loads((tmp_path / "path.json").read_text())
    try:
        from nerfbaselines.io import load_trajectory
    except ImportError:
        assert content["format"] == "nerfbaselines-v1"
        loaded = content | {
            "frames": [{k: np.array(v, np.float32) for k, v in frame.items()} for frame in content["frames"]]
        }
    else:
        with (tmp_path / "path.json").open() as opened:
            loaded = load_trajectory(opened)
    assert loaded["camera_model"] == "pinhole"
    assert tuple(loaded["image_size"]) == (48, 32)
    assert [a["embedding_train_index"] for a in loaded["appearances"]] == [2, 0]
    for entry, frame in zip(loaded["frames"], frames, strict=True):
        pose = entry["pose"].reshape(-1, 4)
        np.testing.assert_allclose(pose[:, :3], frame.camera.pose[:, :3], atol=1e-6)
        np.testing.assert_allclose(pose[:, 3], 3 * frame.camera.pose[:, 3], rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(entry["intrinsics"], (40, 40, 24, 16), rtol=1e-6)
        np.testing.assert_allclose(entry["appearance_weights"], (0.25, 0.75))


def test_an_image_file_keeps_all_appearances_from_being_numbered(tmp_path):
    """nerfbaselines wants a number for all appearances of a file, or for none."""
    film = CameraPath((Frame(LENS, (0.5, 0.5)),), 25, ("photo 1.jpg", "evening.jpg"))
    write_trajectory(tmp_path / "path.json", film, 1.0, list(TRAIN))
    content = json.loads((tmp_path / "path.json").read_text())
    assert content["appearances"] == [{"image": "photo 1.jpg"}, {"image": "evening.jpg"}]
    assert read_trajectory(tmp_path / "path.json", 1.0, TRAIN).appearances == film.appearances


@st.composite
def films(draw):
    """Paths with centred lenses, and appearances or none."""
    side = st.integers(1, 400)
    width, height = draw(side), draw(side)
    names = draw(st.lists(st.text(max_size=8), max_size=3))
    frames = []
    for _ in range(draw(st.integers(1, 30))):
        f = draw(st.floats(0.1, 20)) * height
        turn = Rotation.from_euler("xyz", draw(st.tuples(*[st.floats(-180, 180)] * 3)), degrees=True).as_matrix()
        centre = draw(st.tuples(*[st.floats(-100, 100)] * 3))
        lens = replace(LENS, width=width, height=height, fx=f, fy=f, cx=width / 2, cy=height / 2)
        parts = [draw(st.integers(0, 5)) + (i == 0) for i in range(len(names))]
        weights = tuple(p / sum(parts) for p in parts) if parts and draw(st.booleans()) else None
        frames.append(Frame(posed(lens, np.column_stack([turn, centre])), weights))
    return CameraPath(tuple(frames), draw(st.floats(0.1, 240)), tuple(names))


@few
@given(film=films(), scale=st.sampled_from([0.01, 1.0, 37.5]))
@pytest.mark.parametrize("kind", ["nerfstudio", "nerfbaselines"])
def test_what_is_written_is_read_again(kind, film, scale, tmp_path):
    path = tmp_path / "path.json"
    if kind == "nerfstudio":
        write_camera_path(path, film, scale)
    else:
        write_trajectory(path, film, scale, list(TRAIN))
    again = read_path(path, scale, TRAIN)
    assert again.fps == film.fps
    assert again.appearances == film.appearances
    assert again.size == film.size
    for a, b in zip(film.frames, again.frames, strict=True):
        np.testing.assert_allclose(b.camera.pose, a.camera.pose, atol=1e-6)
        for key in ("fx", "fy", "cx", "cy"):
            assert getattr(b.camera, key) == pytest.approx(getattr(a.camera, key), rel=1e-6)
        assert (a.weights is None) == (b.weights is None)
        assert b.weights is None or b.weights == pytest.approx(a.weights, abs=1e-6)


def changed(text, where, value):
    """The JSON with the value at a key path replaced; None as value: taken out."""
    content = json.loads(text)
    node = content
    for key in where[:-1]:
        node = node[key]
    if value is None:
        del node[where[-1]]
    else:
        node[where[-1]] = value
    return content


@pytest.mark.parametrize(
    ("where", "value", "message"),
    [
        (("camera_type",), "fisheye", "'fisheye': only perspective"),
        (("camera_type",), "Equirectangular", "'Equirectangular': only perspective"),
        (("camera_type",), 7, "camera_type"),
        (("render_height",), 0, r"render_height \(0\)"),
        (("render_width",), 20000, "render_width"),
        (("render_width",), None, "render_width: Field required"),
        (("fps",), 0, "fps"),
        (("camera_path",), [], "camera_path"),
        (("camera_path", 1, "fov"), 180, r"camera_path.1.fov \(180\)"),
        (("camera_path", 1, "fov"), "wide", "camera_path.1.fov"),
        (("camera_path", 1, "camera_to_world"), [1, 0, 0], "camera_path.1.camera_to_world"),
        (("camera_path", 1, "camera_to_world", 3), math.nan, "camera_path.1.camera_to_world.3"),
        (("camera_path", 1, "camera_to_world", 3), 1e300, "camera_path.1.camera_to_world.3"),
        (("camera_path", 1, "camera_to_world", 0), 1.1, "camera_path.1: the matrix does not turn and move only"),
        (("camera_path", 1, "camera_to_world", 0), -1, "camera_path.1: .* determinant -1"),
        (("camera_path", 1, "camera_to_world", 12), 5, "camera_path.1: the last row .* row after row"),
        (("camera_path", 0, "appearance_weights"), [1], "camera_path.0: 1 appearance_weights for 2 appearances"),
        (("camera_path", 0, "appearance_weights"), [0, -1], "camera_path.0: no appearance weight is above 0"),
        (("appearances", 1), {}, "appearances.1.image"),
    ],
)
def test_nerfstudio_file_is_refused(file, where, value, message):
    with pytest.raises(CrossrayError, match=message) as error:
        read_camera_path(file(changed(NERFSTUDIO, where, value)), 2.0, TRAIN)
    assert "path.json" in str(error.value)


@pytest.mark.parametrize(
    ("where", "value", "message"),
    [
        (("format",), "nerfbaselines-v2", "'nerfbaselines-v2'"),
        (("camera_model",), "opencv_fisheye", "'opencv_fisheye': only pinhole"),
        (("image_size",), [200], "image_size"),
        (("frames", 2, "pose", 3), math.inf, "frames.2.pose.3"),
        (("frames", 2, "pose"), [0] * 12, "frames.2: the matrix does not"),
        (("frames", 2, "pose"), [0] * 13, "frames.2: a matrix of 13 numbers"),
        (("frames", 2, "intrinsics", 1), -5, "frames.2: focal lengths 50 and -5"),
        (("frames", 2, "appearance_weights"), [1, 0], "frames.2: 2 appearance_weights for 3"),
        (("appearances", 0), {"embedding": [0.5, 1.5]}, 'appearances.0: an embedding .* {"image": "photo 0.jpg"}'),
        (("appearances", 0), {}, "appearances.0: an embedding"),
        (("appearances", 0), {"embedding_train_index": 3}, "appearances.0: .* 3, and there are 3"),
        (("appearances", 0), {"embedding_train_index": -1}, "appearances.0: .* -1"),
    ],
)
def test_nerfbaselines_file_is_refused(file, where, value, message):
    with pytest.raises(CrossrayError, match=message) as error:
        read_trajectory(file(changed(TRAJECTORY, where, value)), 2.0, TRAIN)
    assert "path.json" in str(error.value)


def test_poses_with_three_digits_are_read_as_rotations(file):
    """As in nerfbaselines' own test."""
    pose = [0.568, -0.102, 0.816, -11.05, 0.178, 0.983, -0.001, 0.059, -0.802, 0.146, 0.577, -7.812]
    path = read_trajectory(file(changed(TRAJECTORY, ("frames", 0, "pose"), pose)), 1.0, TRAIN)
    assert_usable([path.frames[0].camera])
    np.testing.assert_allclose(path.frames[0].camera.pose.flatten(), pose, atol=2e-3)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "cannot be read"),
        (b"\xff\xfe\x00", "cannot be read"),
        (b"[1, 2]", "no JSON object"),
        (b"{}", "neither camera_path"),
        (b'{"camera_path": ' + b"[" * 100_000, "cannot be read"),
        (b'{"frames": []}', "neither camera_path"),
    ],
)
def test_what_is_no_path_is_refused(tmp_path, content, message):
    (tmp_path / "path.json").write_bytes(content)
    with pytest.raises(CrossrayError, match=message):
        read_path(tmp_path / "path.json", 1.0, TRAIN)


def test_a_missing_file_or_a_folder_is_refused(tmp_path):
    for path in (tmp_path / "none.json", tmp_path):
        with pytest.raises(CrossrayError, match="cannot be read as a camera path"):
            read_path(path, 1.0, TRAIN)


def test_a_huge_file_is_refused(tmp_path):
    with (tmp_path / "path.json").open("wb") as opened:
        opened.truncate(2**28 + 1)  # takes no room on the disk
    with pytest.raises(CrossrayError, match="larger than 256 MiB"):
        read_path(tmp_path / "path.json", 1.0, TRAIN)


def places(node, at=()):
    """The key paths of all values of JSON."""
    if at:
        yield at
    if isinstance(node, dict | list):
        for key, value in node.items() if isinstance(node, dict) else enumerate(node):
            yield from places(value, (*at, key))


STRANGE = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.just(10**400),
    st.floats(),
    st.text(max_size=5),
    st.lists(st.one_of(st.floats(), st.integers(), st.none(), st.text(max_size=3)), max_size=17),
    st.dictionaries(st.text(max_size=5), st.integers(), max_size=2),
)


@settings(few, max_examples=100)
@given(data=st.data())
@pytest.mark.parametrize("text", [NERFSTUDIO, TRAJECTORY], ids=["nerfstudio", "nerfbaselines"])
def test_a_damaged_file_gives_a_path_or_one_kind_of_error(text, data, tmp_path):
    content = json.loads(text)
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.sampled_from(list(places(content))))
        node = content
        for key in at[:-1]:
            node = node[key]
        if data.draw(st.booleans()):
            node[at[-1]] = data.draw(STRANGE)
        else:
            del node[at[-1]]
        if not list(places(content)):
            break
    (tmp_path / "path.json").write_text(json.dumps(content))
    with contextlib.suppress(CrossrayError):
        assert_usable([frame.camera for frame in read_path(tmp_path / "path.json", 2.0, TRAIN).frames])


@few
@given(content=st.binary(max_size=60))
def test_any_bytes_give_one_kind_of_error(content, tmp_path):
    (tmp_path / "path.json").write_bytes(content)
    with pytest.raises(CrossrayError, match=r"path\.json"):
        read_path(tmp_path / "path.json", 2.0, TRAIN)


# ------------------------------------------------------------------------------------------------------- --view

NAMES = ["a.jpg", "b c.jpg", "d..e.jpg", "t.jpg", "v.png"]
CAMERAS = dict(zip(NAMES, ring(range(0, 50, 10)), strict=True))
SPLIT = dict(zip(NAMES, ["train", "train", "train", "test", "val"], strict=True))


def view(text, **over):
    return views_of(text, CAMERAS, SPLIT, 2.0, **over)


def test_a_split_or_a_photo_are_stills():
    assert view("test") == Stills((("t.jpg", CAMERAS["t.jpg"]),))
    assert view("val") == Stills((("v.png", CAMERAS["v.png"]),))
    train = view("train")
    assert isinstance(train, Stills)
    assert [name for name, _ in train.views] == NAMES[:3]
    assert view("b c.jpg") == Stills((("b c.jpg", CAMERAS["b c.jpg"]),))


def test_an_orbit_goes_through_training_photos_only():
    film = view("orbit", frames=30, fps=12.0)
    assert isinstance(film, CameraPath)
    assert (len(film.frames), film.fps) == (30, 12)
    assert [f.camera for f in film.frames] == orbit([CAMERAS[n] for n in NAMES[:3]], 30)


def test_a_flight_between_photos_of_any_split():
    film = view("interpolate:b c.jpg..d..e.jpg..t.jpg", frames=7)
    assert isinstance(film, CameraPath)
    assert [f.camera for f in film.frames] == between([CAMERAS[n] for n in ("b c.jpg", "d..e.jpg", "t.jpg")], 7)


@pytest.mark.parametrize("text", [NERFSTUDIO, TRAJECTORY])
def test_a_file_of_either_format(file, text):
    film = view(str(file(changed(text, ("appearances", 0), {"image": "a.jpg"}))))
    assert isinstance(film, CameraPath)
    np.testing.assert_allclose(film.frames[0].camera.pose, AS_OPENCV, atol=1e-12)
    near = min(CAMERAS[n].near for n in NAMES[:3])
    assert film.frames[0].camera.near == near


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a.jgp", "did you mean 'a.jpg'"),
        ("tests", "did you mean 'test'"),
        ("xyz", "the first is 'a.jpg'"),
        ("", "the first is 'a.jpg'"),
        ("none.json", "none.json: cannot be read"),
        ("interpolate:a.jpg..t.jp", "'t.jp' is no photo of the scene; did you mean 't.jpg'"),
        ("interpolate:a.jpg", "needs two photos"),
        ("interpolate:", "'' is no photo"),
        ("interpolate:a.jpg..", "'' is no photo"),
        ("interpolate:..a.jpg", "'' is no photo"),
        ("interpolate:d..e.jpg..x", "'d' is no photo|'x' is no photo"),
    ],
)
def test_unknown_views_are_refused(text, message):
    with pytest.raises(CrossrayError, match=message):
        view(text)


def test_a_split_without_photos_is_refused():
    with pytest.raises(CrossrayError, match="no photo of the scene is of this split"):
        views_of("val", CAMERAS, dict.fromkeys(NAMES, "train"), 1.0)


def test_names_that_hold_dots_are_read_or_refused():
    known = dict.fromkeys(("a", "b", "a..b", "c.", ".d"), LENS)
    assert stops_of("a..b..a", {k: known[k] for k in ("a", "b")}) == ["a", "b", "a"]
    assert stops_of("c...a", known) == ["c.", "a"]
    assert stops_of("a...d", known) == ["a", ".d"]
    with pytest.raises(CrossrayError, match=r"'a' to 'b' and as 'a\.\.b'|'a\.\.b' and as 'a' to 'b'"):
        stops_of("a..b", known)


@few
@given(st.lists(st.sampled_from(["a", "b", "a..b", "a.", ".a", ".", ".."]), min_size=1, max_size=5))
def test_readings_are_those_of_a_slow_search(parts):
    names = ["a", "b", "a..b", "a.", ".a", ".", ".."]
    text = "..".join(parts)
    slow = [
        list(way)
        for count in range(1, len(text) + 1)
        if count <= 5
        for way in itertools.product(names, repeat=count)
        if "..".join(way) == text
    ]
    found = readings(text, names)
    assert len(found) == min(len(slow), 2) or len(slow) < 2 <= len(found)
    assert all("..".join(way) == text for way in found)


def test_readings_of_a_long_text_are_found_soon():
    assert len(readings("..".join(["a"] * 2000), ["a", "a..a"])) == 2
    assert readings("..".join(["a"] * 2000) + "x", ["a", "a..a"]) == []


# ----------------------------------------------------------------------------------------------------- real photos


@pytest.mark.real
@pytest.mark.slow
def test_orbit_of_the_reichstag(test_data):
    from pipeline.scene import read_scene

    scene = read_scene(Path(test_data) / "reichstag")
    cameras = [
        posed(Camera(p.width, p.height, *p.intrinsics, LENS.c2w, p.near, p.far), np.float64(p.c2w))
        for p in scene.photos
        if p.split == "train"
    ]
    frames = orbit(cameras, 240)
    p, c = poses_of(frames), poses_of(cameras)
    distance = np.linalg.norm(p[:, None, :, 3] - c[None, :, :, 3], axis=2)
    assert distance.min(1).max() < 0.25  # the photos span 0.7 across and 2.8 in depth
    nearest = distance.argsort(1)[:, :8]
    assert angle_between(p[:, None, :, 2], c[nearest][..., 2]).min(1).max() < 15
    moved, turned = jumps(frames)
    assert moved.max() < 3 * moved.mean()
    assert turned.max() < 1.5
