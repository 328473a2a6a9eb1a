"""Flicker: points are followed truly, and drifts are what they are said to be."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from model.methods import METHODS, HashSpec, ModelSpec
from model.scene_model import SceneModel
from pipeline.errors import CrossrayError
from pipeline.flicker import (
    colours_at,
    drift,
    flicker,
    in_scene_units,
    surface_points,
    true_drift,
    visible,
    walk,
)
from pipeline.landmark import Landmark
from pipeline.landmark.collection import draw_photo
from pipeline.landmark.photo import depth_map
from pipeline.landmark.tracer import Pinhole
from pipeline.render import colour_view, read_appearance, render_view, statistics_of

SCALE = 2.5
HASH = HashSpec(levels=3, log2_entries=8, max_resolution=32, width=16, proposal_samples=8, samples=6)
FLAT = Pinhole(8, 6, 10.0, 10.0, 4.0, 3.0, ((1, 0, 0), (0, 1, 0), (0, 0, 1)), (0.0, 0.0, 0.0))


@pytest.fixture(scope="module")
def path():
    return walk(9, 48)


@pytest.fixture(scope="module")
def landmark(tmp_path_factory):
    records = [draw_photo(0, i, "test", 24, 0.0) for i in range(2)]
    return Landmark(tmp_path_factory.mktemp("landmark"), records)


def photos_of(landmark: Landmark) -> SimpleNamespace:
    """What is asked of a scene's photos."""
    records = [SimpleNamespace(name=name, near=0.1, far=4.0) for name in landmark.names()]
    rng = np.random.default_rng(0)
    references = [rng.integers(0, 256, (20, 30, 3), np.uint8) for _ in records]
    return SimpleNamespace(
        records=records,
        reference=lambda i: references[i],
        indices=lambda split: tuple(range(len(records))),
        manifest=SimpleNamespace(scene=SimpleNamespace(scale=SCALE)),
    )


def small_model(row: str = "crossray") -> SceneModel:
    """With content in its pictures, and averages."""
    torch.manual_seed(0)
    axes = METHODS[row].axes() | {"field": "hash"}
    spec = ModelSpec(**axes, hash=HASH, channels=8, encoder="compact", segmenter="unet")
    model = SceneModel(spec, torch.tensor([[-1.0, -1, -1], [1, 1, 1]])).eval().requires_grad_(False)
    for name, parameter in model.named_parameters():
        if name.endswith("grid.table") or name.startswith("transform"):
            torch.nn.init.normal_(parameter, std=1.0 if name.endswith("table") else 0.3)
    if model.transform is not None:
        model.track(model.transform.content_statistics(torch.randn(1, 30, 8)))
    return model


# By hand


def test_drift_by_hand():
    """Three points in four frames: the first gets brighter by 3 in red a frame, the second stays, the third is seen in
    two frames alone."""
    colours = np.full((4, 3, 3), np.nan)
    for t in range(4):
        colours[t, 0] = [10 + 3 * t, 20, 30]
        colours[t, 1] = [50, 50, 50]
    colours[1, 2], colours[2, 2] = [0, 0, 0], [0, 12, 0]
    frame, point = drift(colours)
    # Mean changes: (1.5, 0, 0), then of three points (1, 4, 0), then (1.5, 0, 0).
    assert frame == pytest.approx((1.5 + np.sqrt(17) + 1.5) / 3)
    # Red of the first is 10, 13, 16, 19: variance 11.25, and a third of that over the channels.
    assert point == pytest.approx((np.sqrt(11.25 / 3) + 0) / 2)


def test_frames_without_a_common_point_are_refused():
    colours = np.full((4, 2, 3), np.nan)
    colours[:2, 0] = colours[2:, 1] = 1.0
    with pytest.raises(ValueError, match="share too few points"):
        drift(colours)


def test_colours_between_pixels():
    """On a picture that is linear in u and v, interpolation is exact."""
    v, u = np.mgrid[0:6, 0:8] + 0.5
    picture = np.stack([u, v, 2 * u - v], axis=-1)
    pixels = np.array([[0.5, 0.5], [3.25, 2.75], [7.4, 5.4], [1.0, 1.0]])
    seen = np.array([True, True, True, False])
    found = colours_at(picture, pixels, seen)
    np.testing.assert_allclose(found[:3], [[0.5, 0.5, 0.5], [3.25, 2.75, 3.75], [7.4, 5.4, 9.4]])
    assert np.isnan(found[3]).all()


def test_what_is_visible():
    """A wall at depth 2, with a nearer pixel at row 3, column 4."""
    depth = np.full((6, 8), 2.0)
    depth[3, 4] = 1.0

    def at(u: float, v: float, z: float) -> list[float]:
        return [(u - 4) / 10 * z, (v - 3) / 10 * z, z]

    cases = {  # u, v, z -> seen
        (2.0, 2.0, 2.0): True,
        (2.0, 2.0, 2.03): True,  # within two per cent
        (2.0, 2.0, 2.05): False,  # behind the wall
        (2.0, 2.0, 1.9): False,
        (4.2, 3.2, 2.0): False,  # an edge close by
        (5.6, 3.2, 2.0): True,
        (0.4, 2.0, 2.0): False,  # half a pixel from the border no four pixels are around
        (7.6, 2.0, 2.0): False,
        (2.0, 2.0, -2.0): False,  # behind the camera
    }
    pixels, seen = visible(FLAT, depth, np.array([at(*case) for case in cases]))
    assert seen.tolist() == list(cases.values())
    np.testing.assert_allclose(pixels[:-1], [case[:2] for case in list(cases)[:-1]])


# The path


def test_a_surface_point_is_behind_its_own_pixel(path):
    camera = path.cameras[2]
    depth = depth_map(camera)
    points = surface_points(camera, depth)
    u, v, z = camera.project(points)
    np.testing.assert_allclose(u % 1, 0.5, atol=1e-3)
    np.testing.assert_allclose(z, depth[v.astype(int), u.astype(int)], rtol=1e-5)
    assert np.isfinite(points).all()
    sky = np.isinf(depth[2::4, 2::4]).sum()
    assert len(points) == 144 - sky < 144


def test_the_path_shares_points_and_stands_free(path):
    shared = path.seen[:-1] & path.seen[1:]
    assert shared.sum(axis=1).min() >= 3
    assert path.nearest > 0.5
    assert path.nearest == pytest.approx(min(depth_map(c).min() for c in path.cameras))


def test_a_camera_of_the_path_is_that_of_a_photo_in_scene_units(landmark):
    camera = landmark.camera(landmark.names()[0])
    record = in_scene_units(camera, photos_of(landmark), nearest=2.0)
    c2w = np.array(record.c2w)
    point = np.array([0.3, -0.2, 0.9])  # world units
    u, v, z = camera.project(point[None])
    seen = c2w[:, :3].T @ (point / SCALE - c2w[:, 3])
    np.testing.assert_allclose(
        [record.fx * seen[0] / seen[2] + record.cx, record.fy * seen[1] / seen[2] + record.cy, SCALE * seen[2]],
        [u[0], v[0], z[0]],
        rtol=1e-6,
    )
    assert (record.near, record.far) == pytest.approx((0.9 * 2.0 / SCALE, 4.0))


# Whole


def test_a_model_s_drift_is_that_of_its_pictures(path, landmark):
    model, photos, names = small_model(), photos_of(landmark), landmark.names()
    found = flicker(model, photos, path, names)
    assert set(found) == {"view", "patch", "running"}
    views = [render_view(model, in_scene_units(c, photos, path.nearest)) for c in path.cameras]
    for policy, measured in found.items():
        slow = []
        for index in range(2):
            F = read_appearance(model, photos.reference(index))
            pictures = [255 * colour_view(model, view, F, policy) for view in views]
            colours = np.stack([colours_at(*x) for x in zip(pictures, path.pixels, path.seen, strict=True)])
            alone = []
            for t, view in enumerate(views[:-1]):
                content = statistics_of(model, views[t + 1], policy)
                moved = 255 * model.colours(view.features[None], F, content)[0].view(48, 48, 3).numpy()
                change = colours_at(moved, path.pixels[t], path.seen[t]) - colours[t]
                alone.append(np.linalg.norm(np.nanmean(change, axis=0)))
            slow.append((*drift(colours), np.mean(alone)))
        np.testing.assert_allclose(measured, np.mean(slow, axis=0), rtol=1e-3, atol=1e-3)
    assert found["view"].statistics > 0.1
    assert found["running"].statistics < 1e-3
    assert found["running"].frame > 0


def test_the_truth_drifts_little_and_flat_pictures_not_at_all(path, landmark):
    true = true_drift(landmark, path, landmark.names())
    assert 0 < true.point < 40
    assert true.statistics == 0
    assert drift(np.where(path.seen[..., None], 100.0, np.nan).repeat(3, axis=-1)) == (0, 0)


def test_a_method_without_statistics_is_refused(path, landmark):
    with pytest.raises(CrossrayError, match="takes no statistics"):
        flicker(small_model("crnerf-b"), photos_of(landmark), path, landmark.names())
