"""Patch grids and rays, against hand-computed values and the reference's."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from model.cameras import patch_grid, pixel_rays

IDENTITY = torch.eye(4)[:3]


def test_a_full_grid_of_the_photos_own_size_is_every_pixel():
    rows, cols, uv = patch_grid(4, 1.0, 0.0, 0.0, 4, 4)
    assert rows.tolist() == [0] * 4 + [1] * 4 + [2] * 4 + [3] * 4
    assert cols.tolist() == [0, 1, 2, 3] * 4
    assert uv[6].tolist() == [0.25, 0.5]  # (h, w): second row, third column
    assert (rows.dtype, cols.dtype, uv.dtype) == (torch.int64, torch.int64, torch.float32)


def test_a_patch_spans_the_same_share_of_both_axes():
    rows, cols, _ = patch_grid(2, 0.5, 0.25, 0.0, 8, 16)
    # linspace(0, 1 - 1/8, 2) / 2 + 1/4 = 0.25, 0.6875, times 8; linspace(0, 1 - 1/16, 2) / 2 = 0, 0.46875,
    # times 16
    assert rows.tolist() == [2, 2, 5, 5]
    assert cols.tolist() == [0, 7, 0, 7]


@settings(deadline=None, max_examples=50)
@given(
    k=st.integers(2, 12),
    scale=st.floats(0.1, 1.0),
    h=st.floats(0.0, 1.0),
    w=st.floats(0.0, 1.0),
    height=st.integers(1, 40),
    width=st.integers(1, 40),
)
def test_pixels_lie_in_the_photo_in_order(k, scale, h, w, height, width):
    offset_h, offset_w = (1 - scale) * (1 - 1 / height) * h, (1 - scale) * (1 - 1 / width) * w
    rows, cols, _ = patch_grid(k, scale, offset_h, offset_w, height, width)
    rows, cols = rows.view(k, k), cols.view(k, k)
    assert (rows == rows[:, :1]).all()
    assert (cols == cols[:1]).all()
    assert 0 <= rows.min() <= rows.max() < height
    assert 0 <= cols.min() <= cols.max() < width
    assert (rows.diff(dim=0) >= 0).all()
    assert (cols.diff(dim=1) >= 0).all()


def test_settings_beyond_the_photo_are_clamped_to_it():
    rows, cols, _ = patch_grid(2, 1.0, 0.5, -0.5, 4, 4)
    assert rows.tolist() == [2, 2, 3, 3]
    assert cols.tolist() == [0, 1, 0, 1]


def test_ray_of_a_known_pixel():
    origins, directions = pixel_rays(
        torch.tensor([[2]]), torch.tensor([[6]]), torch.tensor([[2.0, 2.0, 2.5, 2.5]]), IDENTITY[None]
    )
    assert origins.tolist() == [[[0.0, 0.0, 0.0]]]
    # The pixel's middle is (2.5, 6.5): straight ahead in x, 4 pixels below the axis at focal length 2.
    torch.testing.assert_close(directions[0, 0], torch.tensor([0.0, 2.0, 1.0]) / math.sqrt(5))


def test_pixel_center_moves_by_that_many_pixels():
    intrinsics = torch.tensor([3.0, 5.0, 1.0, 2.0])
    cols, rows = torch.tensor([1.0, 4.0]), torch.tensor([0.0, 7.0])
    _, centred = pixel_rays(cols, rows, intrinsics, IDENTITY)
    _, shifted = pixel_rays(cols + 0.5, rows + 0.5, intrinsics, IDENTITY, pixel_center=0.0)
    assert torch.equal(centred, shifted)


def test_rays_of_a_batch_are_those_of_its_cameras_and_project_back():
    generator = torch.Generator().manual_seed(0)
    rotation = torch.linalg.qr(torch.randn(5, 3, 3, generator=generator)).Q
    c2w = torch.cat([rotation, torch.randn(5, 3, 1, generator=generator)], dim=-1)
    intrinsics = torch.tensor([50.0, 60.0, 32.0, 24.0]) + torch.rand(5, 4, generator=generator)
    cols, rows = (torch.randint(0, 64, (5, 7), generator=generator) for _ in range(2))
    origins, directions = pixel_rays(cols, rows, intrinsics, c2w)
    torch.testing.assert_close(directions.norm(dim=-1), torch.ones(5, 7))
    for i in range(5):
        one = pixel_rays(cols[i], rows[i], intrinsics[i], c2w[i])
        torch.testing.assert_close(origins[i], one[0])
        torch.testing.assert_close(directions[i], one[1])

    in_camera = torch.einsum("bji,bnj->bni", rotation, directions)  # world to camera: the transposed rotation
    fx, fy, cx, cy = intrinsics[:, None].unbind(-1)
    torch.testing.assert_close(in_camera[..., 0] / in_camera[..., 2] * fx + cx, cols + 0.5, atol=1e-3, rtol=0)
    torch.testing.assert_close(in_camera[..., 1] / in_camera[..., 2] * fy + cy, rows + 0.5, atol=1e-3, rtol=0)


@pytest.mark.real
@pytest.mark.parametrize("k", [32, 24])
def test_golden_patch_grid(golden, k):
    vectors = golden("grid_sampling")
    for i, setting in enumerate(vectors["in/settings"].tolist()):
        scale, offset_h, offset_w, height, width = setting
        rows, cols, uv = patch_grid(k, scale, offset_h, offset_w, int(height), int(width))
        expected = f"out/setting_{i}/k{k}"
        assert torch.equal(rows, vectors[f"{expected}/row"].long())
        assert torch.equal(cols, vectors[f"{expected}/col"].long())
        assert torch.equal(uv, vectors[f"{expected}/uv"])


@pytest.mark.real
@pytest.mark.parametrize("downscale", [2, 4])
def test_golden_rays_of_the_reichstag(golden, downscale):
    vectors = golden("colmap_scene")
    K = vectors[f"out/ds{downscale}/K"]
    intrinsics = torch.stack([K[:, 0, 0], K[:, 1, 1], K[:, 0, 2], K[:, 1, 2]], dim=-1)
    c2w = vectors["out/c2w"] * torch.tensor([1.0, -1.0, -1.0, 1.0])  # right, up, back -> right, down, forward
    cols, rows = vectors[f"in/ds{downscale}/pixels_xy"].unbind(-1)
    origins, directions = pixel_rays(cols, rows, intrinsics, c2w, pixel_center=0.0)
    rays = vectors[f"out/ds{downscale}/rays"]
    torch.testing.assert_close(origins, rays[..., :3], atol=3e-6, rtol=0)
    torch.testing.assert_close(directions, rays[..., 3:6], atol=3e-6, rtol=0)
