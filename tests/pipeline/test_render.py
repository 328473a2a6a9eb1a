"""Views: a ray a pixel, features once, colours for any appearance."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from model.bake import bake
from model.methods import CODE, METHODS, HashSpec, MLPSpec, ModelSpec
from model.scene_model import ColourMap, SceneModel
from pipeline import render as module
from pipeline.errors import CrossrayError
from pipeline.manifest import CameraRecord
from pipeline.metrics import to_8bit
from pipeline.render import (
    View,
    colour_view,
    grid_statistics,
    interpolated,
    read_appearance,
    recoloured,
    render_baked,
    render_picture,
    render_view,
    statistics_of,
    view_colours,
    view_rays,
)

CPU = torch.device("cpu")
MLP = MLPSpec(width=16, coarse_samples=6, fine_samples=6)
HASH = HashSpec(levels=3, log2_entries=8, max_resolution=32, width=16, proposal_samples=8, samples=6)

# 9 x 7 pixels from (0.5, 0, -3) along +z, turned a little about y, with its middle off the picture's.
TURN = 0.3
CAMERA = CameraRecord(
    key="view", name="view.jpg", image_id=1, split="test", width=9, height=7, fx=10.0, fy=11.0, cx=4.0, cy=3.75,
    c2w=((np.cos(TURN), 0, np.sin(TURN), 0.5), (0, 1, 0, 0), (-np.sin(TURN), 0, np.cos(TURN), -3)),
    near=1.0, far=6.0, source_sha256="0" * 64,
)  # fmt: skip


def small_model(row: str = "crnerf", **changes) -> SceneModel:
    torch.manual_seed(0)
    spec = ModelSpec(**(METHODS[row].axes() | {"mlp": MLP, "hash": HASH} | changes))
    model = SceneModel(spec, torch.tensor([[-1.0, -1, -1], [1, 1, 1]])).eval()
    for name, parameter in model.named_parameters():
        if name.endswith("grid.table"):
            torch.nn.init.normal_(parameter)
    return model


def photo(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (17, 22, 3), np.uint8)


@pytest.mark.parametrize("pixel_center", [0.0, 0.5])
@pytest.mark.parametrize("stride", [1, 2, 3])
def test_rays_by_hand(stride, pixel_center):
    rays = view_rays(CAMERA, pixel_center, CPU, stride)
    rows = {1: range(7), 2: (1, 3, 5), 3: (1, 4)}[stride]
    cols = {1: range(9), 2: (1, 3, 5, 7), 3: (1, 4, 7)}[stride]
    pixels = [(row, col) for row in rows for col in cols]
    assert len(rays.near) == len(pixels)
    c2w = np.array(CAMERA.c2w)
    for n, (row, col) in enumerate(pixels):
        direction = c2w[:, :3] @ [(col + pixel_center - 4.0) / 10, (row + pixel_center - 3.75) / 11, 1]
        np.testing.assert_allclose(rays.directions[n], direction / np.linalg.norm(direction), atol=1e-6)
        np.testing.assert_allclose(rays.origins[n], [0.5, 0, -3], atol=1e-6)
    assert rays.near.tolist() == [1.0] * len(pixels)
    assert rays.far.tolist() == [6.0] * len(pixels)


@pytest.mark.parametrize("row", METHODS)
def test_a_view_has_its_shapes_and_no_chunks(row):
    model = small_model(row)
    code = torch.zeros(1, CODE) if model.coded else None
    view = render_view(model, CAMERA, code)
    assert view.size == (7, 9)
    channels = (3 if model.spec.colour == "head" else 64) + (row == "crnerf-r")  # there, the sum of weights is another
    assert view.features.shape == (63, channels)
    assert view.depth.shape == view.accumulation.shape == (7, 9)
    assert view.accumulation.min() >= 0
    assert view.accumulation.max() <= 1 + 1e-5
    assert view.depth.max() <= 6 + 1e-4
    in_parts = render_view(model, CAMERA, code, chunk=10)
    for a, b in zip(in_parts[1:4], view[1:4], strict=True):
        torch.testing.assert_close(a, b, atol=1e-5, rtol=0)
    assert (view.points is not None) == (row == "crnerf-r")
    assert not view.features.requires_grad


@pytest.mark.parametrize("row", ["crnerf", "crossray"])
def test_a_strided_view_is_part_of_the_full_one(row):
    model = small_model(row)
    full, part = render_view(model, CAMERA), render_view(model, CAMERA, stride=2)
    assert part.size == (3, 4)
    expected = full.features.view(7, 9, -1)[1::2, 1::2].flatten(0, 1)
    torch.testing.assert_close(part.features, expected, atol=1e-5, rtol=0)
    torch.testing.assert_close(part.depth, full.depth[1::2, 1::2], atol=1e-5, rtol=0)


def test_the_method_s_pixel_centre_is_used():
    released, middle = (render_view(small_model(pixel_center=c), CAMERA) for c in (0.0, 0.5))
    shifted = CAMERA.model_copy(update={"cx": CAMERA.cx - 0.5, "cy": CAMERA.cy - 0.5})
    torch.testing.assert_close(
        render_view(small_model(pixel_center=0.0), shifted).features, middle.features, atol=1e-5, rtol=0
    )
    assert (released.features - middle.features).abs().max() > 1e-4


def test_sample_counts_are_passed_on():
    model = small_model()
    more = render_view(model, CAMERA, samples=(12, 12))
    assert (more.features - render_view(model, CAMERA).features).abs().max() > 1e-5
    same = render_view(model, CAMERA, samples=(6, 6))
    torch.testing.assert_close(same.features, render_view(model, CAMERA).features, atol=1e-6, rtol=0)


def test_an_appearance_is_the_encoder_s_view_of_the_photo():
    model = small_model()
    appearance = read_appearance(model, photo(0))
    assert not appearance.requires_grad
    as_input = torch.from_numpy(photo(0)).permute(2, 0, 1)[None] / 255
    with torch.no_grad():
        torch.testing.assert_close(appearance, model.encoder(as_input))
    assert read_appearance(small_model("nerf"), photo(0)) is None


@pytest.mark.parametrize("row", METHODS)
def test_pictures_are_colours(row):
    model = small_model(row)
    appearance = read_appearance(model, photo(0)) if model.embedding is None else model.embedding.weight[:1].detach()
    view, picture = render_picture(model, CAMERA, appearance)
    assert view.size == (7, 9)
    assert picture.shape == (7, 9, 3)
    assert picture.dtype == np.float32
    assert picture.min() >= 0
    assert picture.max() <= 1


def test_one_rendering_many_appearances():
    model = small_model()
    view = render_view(model, CAMERA)
    first, second = (read_appearance(model, photo(seed)) for seed in (0, 1))
    pictures = [colour_view(model, view, a) for a in (first, second)]
    assert np.abs(pictures[0] - pictures[1]).max() > 1e-6
    # Each as if it had been rendered and coloured on its own, in row order.
    with torch.no_grad():
        expected = model.colours(view.features[None], second)[0]
    np.testing.assert_allclose(pictures[1].reshape(-1, 3), expected, atol=1e-5)


def test_policies_differ_where_statistics_do():
    model = small_model()
    features = torch.rand(1, 50, 64, generator=torch.Generator().manual_seed(0))
    model.track(model.transform.content_statistics(features))
    view, appearance = render_view(model, CAMERA), read_appearance(model, photo(0))
    content = {
        policy: model.content_statistics(view.features, view.size, policy) for policy in ("view", "patch", "running")
    }
    for policy, statistics in content.items():
        with torch.no_grad():
            expected = model.colours(view.features[None], appearance, statistics)[0].view(7, 9, 3)
        np.testing.assert_allclose(colour_view(model, view, appearance, policy), expected, atol=1e-6)
    assert (content["view"].mean - content["running"].mean).abs().max() > 1e-3


def test_the_running_policy_does_not_look_at_the_view():
    """So that a film does not flicker: the colour of a ray does not depend on what else is in the picture."""
    model = small_model()
    features = torch.rand(1, 50, 64, generator=torch.Generator().manual_seed(0))
    model.track(model.transform.content_statistics(features))
    appearance = read_appearance(model, photo(0))
    full, part = render_view(model, CAMERA), render_view(model, CAMERA, stride=2)
    pictures = [colour_view(model, v, appearance, "running") for v in (full, part)]
    np.testing.assert_allclose(pictures[1], pictures[0][1::2, 1::2], atol=1e-5)


# Statistics by the model's own policy


@pytest.mark.parametrize("policy", ["view", "patch", "running"])
def test_the_spec_says_whose_statistics_are_used(policy):
    model = small_model(statistics=policy)
    model.track(model.transform.content_statistics(torch.rand(1, 50, 64, generator=seeded())))
    view, appearance = render_view(model, CAMERA), read_appearance(model, photo(0))
    asked = colour_view(model, view, appearance, policy)
    assert np.array_equal(colour_view(model, view, appearance), asked)
    assert np.array_equal(render_picture(model, CAMERA, appearance)[1], asked)
    content = statistics_of(model, view)
    torch.testing.assert_close(content, model.content_statistics(view.features, view.size, policy))


@pytest.mark.parametrize("row", ["crnerf", "crnerf-r", "crossray"])
@pytest.mark.parametrize("policy", ["view", "patch", "running"])
def test_no_chunk_changes_a_picture_whatever_the_policy(row, policy):
    model = small_model(row, statistics=policy)
    appearance = read_appearance(model, photo(0))
    model.track(model.transform.content_statistics(torch.rand(1, 50, 64, generator=seeded())))
    whole, parts = render_view(model, CAMERA), render_view(model, CAMERA, chunk=5)
    pictures = [colour_view(model, v, appearance) for v in (whole, parts)]
    np.testing.assert_allclose(pictures[0], pictures[1], atol=1e-5)


def test_averages_that_are_not_there_are_a_clear_error():
    model = small_model(statistics="running")
    view, appearance = render_view(model, CAMERA), read_appearance(model, photo(0))
    with pytest.raises(CrossrayError, match="statistics: running, but this checkpoint holds no averages"):
        colour_view(model, view, appearance)
    assert colour_view(model, view, appearance, "view").shape == (7, 9, 3)
    assert statistics_of(small_model("nerf"), None, "running") is None


@pytest.mark.parametrize("row", ["crnerf", "crnerf-r"])
def test_the_statistics_of_a_grid_are_those_of_its_rays_alone(row):
    """9 x 7 pixels, so that the grid of 32 x 32 repeats every pixel about 16 times."""
    model = small_model(row)
    view = render_view(model, CAMERA)
    expected = model.content_statistics(view.features, view.size, "patch", points=view.points)
    torch.testing.assert_close(grid_statistics(model, CAMERA), expected, atol=1e-5, rtol=1e-5)
    with pytest.raises(ValueError, match="no statistics"):
        grid_statistics(small_model("nerf"), CAMERA)


# One rendering, any number of appearances


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def random_view(height: int = 7, width: int = 9, channels: int = 64) -> View:
    features = torch.rand(height * width, channels, generator=seeded())
    flat = torch.zeros(height, width)
    return View((height, width), features, flat, flat)


def random_colours(count: int, channels: int = 64) -> ColourMap:
    """Colours from dark to bright, none of them at an end, where all levels are close to a border."""
    A = 0.2 * torch.randn(count, 3, channels, generator=seeded(1))
    return ColourMap(A, torch.randn(count, 3, generator=seeded(2)))


@pytest.mark.parametrize("rounding", ["round", "truncate"])
@pytest.mark.parametrize("appearances", [1, 5])
def test_recoloured_pixel_by_pixel(appearances, rounding):
    view, colours = random_view(), random_colours(appearances)
    pictures = recoloured(view, colours, rounding)
    assert len(pictures) == appearances
    for p, picture in enumerate(pictures):
        assert (picture.shape, picture.dtype) == ((7, 9, 3), np.uint8)
        slow = [255 / (1 + torch.exp(-(colours.A[p].double() @ f + colours.b[p]))) for f in view.features.double()]
        slow = torch.stack(slow).view(7, 9, 3).numpy()
        expected = np.rint(slow) if rounding == "round" else np.floor(slow)
        border = np.abs(slow - expected - (0.5 if rounding == "truncate" else 0)) > 0.499
        assert np.array_equal(picture[~border], expected[~border].astype(np.uint8))
        assert np.abs(picture - expected).max() <= 1
        assert border.mean() < 0.05
        assert picture.std() > 10


def test_levels_by_hand():
    """sigmoid(0) is 127.5 levels; far out it is 0 and 255."""
    view = View((1, 4), torch.tensor([[0.0], [1.0], [-1.0], [0.01]]), torch.zeros(1, 4), torch.zeros(1, 4))
    colours = ColourMap(torch.tensor([[[100.0], [0.0], [-100.0]]]), torch.zeros(1, 3))
    (cut,) = recoloured(view, colours, "truncate")
    assert cut.tolist() == [[[127, 127, 127], [255, 127, 0], [0, 127, 255], [186, 127, 68]]]
    (rounded,) = recoloured(view, colours)
    assert rounded.tolist()[0][1:] == [[255, 128, 0], [0, 128, 255], [186, 128, 69]]  # 186.42 and 68.58


def test_blocks_do_not_change_a_picture(monkeypatch):
    view, colours = random_view(), random_colours(5)
    whole = recoloured(view, colours)
    for values in (1, 100, 10**9):  # one pixel at once; 6 pixels; all
        monkeypatch.setattr(module, "RECOLOURED", {"cpu": values})
        for a, b in zip(recoloured(view, colours), whole, strict=True):
            assert np.abs(a.astype(int) - b).max() <= 1
            assert (a != b).mean() < 0.01


@pytest.mark.parametrize("row", ["crnerf", "crnerf-r", "crossray", "crnerf-b"])
def test_a_recoloured_view_is_the_coloured_one_in_8_bits(row):
    model = small_model(row)
    view = render_view(model, CAMERA)
    appearances = None if model.encoder is None else torch.cat([read_appearance(model, photo(s)) for s in range(3)])
    pictures = recoloured(view, view_colours(model, view, appearances))
    assert len(pictures) == (1 if appearances is None else 3)
    for p, picture in enumerate(pictures):
        one = None if appearances is None else appearances[p : p + 1]
        expected = to_8bit(colour_view(model, view, one), "round")
        assert np.abs(picture.astype(int) - expected).max() <= 1
        assert (picture != expected).mean() < 0.02


def test_what_does_not_fit_a_view_is_refused():
    with pytest.raises(ValueError, match=r"features \(63, 64\) and A \(1, 3, 8\) do not fit"):
        recoloured(random_view(), random_colours(1, channels=8))
    with pytest.raises(ValueError, match="NaN"):
        recoloured(random_view(), ColourMap(torch.full((1, 3, 64), torch.nan), torch.zeros(1, 3)))
    with pytest.raises(ValueError, match="head gives colours"):
        view_colours(small_model("nerf"), random_view(channels=3), None)


def test_interpolation_is_linear_in_the_appearance_and_exact_at_the_ends():
    model = small_model()
    a, b = (read_appearance(model, photo(seed)) for seed in (0, 1))
    assert torch.equal(interpolated(a, b, 0), a)
    assert torch.equal(interpolated(a, b, 1), b)
    torch.testing.assert_close(interpolated(a, b, 0.25), 0.75 * a + 0.25 * b)
    for share in (-0.1, 1.01, float("nan")):
        with pytest.raises(CrossrayError, match="within 0"):
            interpolated(a, b, share)


@pytest.mark.parametrize("stride", [1, 2])
def test_a_baked_view_is_the_coloured_one(stride):
    model = small_model("crossray", statistics="running", channels=64)
    model.track(model.transform.content_statistics(torch.rand(1, 50, 64, generator=seeded())))
    appearance = read_appearance(model, photo(0))
    view, picture = render_baked(bake(model, view_colours(model, None, appearance)), CAMERA, stride=stride)
    expected = render_view(model, CAMERA, stride=stride)
    assert view.size == expected.size
    np.testing.assert_allclose(picture, colour_view(model, expected, appearance), atol=1e-5)
    torch.testing.assert_close(view.depth, expected.depth, atol=1e-5, rtol=0)
