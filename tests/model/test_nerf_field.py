"""The faithful field: a coarse and a fine level, and what may change between two calls."""

from __future__ import annotations

from dataclasses import replace

import torch
from small_models import MLP, small_rays

from model.fields.base import Rays
from model.fields.nerf import NeRFField
from model.volume import intervals, render_weights


def make_field(**changes) -> NeRFField:
    torch.manual_seed(0)
    return NeRFField(replace(MLP, **changes), channels=4)


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_two_levels_in_sorted_order():
    field, rays = make_field(coarse_samples=6, fine_samples=5), small_rays(9)
    for generator in (None, seeded()):
        march = field.march(rays, generator)
        assert march.losses == {}
        coarse, fine = march.levels
        for level, count in ((coarse, 6), (fine, 11)):
            assert level.t.shape == level.weights.shape == (9, count)
            assert level.features.shape == (9, count, 4)
            assert level.background is None
            assert (level.t.diff(dim=-1) >= 0).all()
            assert (level.t >= rays.near[:, None] - 1e-5).all()
            assert (level.t <= rays.far[:, None] + 1e-5).all()
        # The fine level sees the coarse samples too.
        assert (coarse.t[:, :, None] == fine.t[:, None, :]).any(-1).all()


def test_sample_counts_can_be_overridden():
    coarse, fine = make_field().march(small_rays(3), samples=(10, 7)).levels
    assert coarse.t.shape == (3, 10)
    assert fine.t.shape == (3, 17)


def test_without_a_generator_nothing_is_random():
    field, rays = make_field(density_noise=5.0), small_rays(9)
    first, second = field.march(rays), field.march(rays)
    for a, b in zip(first.levels, second.levels, strict=True):
        for x, y in zip(a[:3], b[:3], strict=True):
            assert torch.equal(x, y)
    # Even samples, both ends included.
    t = first.levels[0].t
    torch.testing.assert_close(t[:, 0], rays.near)
    torch.testing.assert_close(t[:, -1], rays.far)
    torch.testing.assert_close(t.diff(dim=-1), ((rays.far - rays.near) / 5)[:, None].expand(-1, 5))


def test_the_same_seed_gives_the_same_march():
    field, rays = make_field(), small_rays(9)
    first, same, other = (field.march(rays, seeded(s)) for s in (3, 3, 4))
    for a, b, c in zip(first.levels, same.levels, other.levels, strict=True):
        for x, y in zip(a[:3], b[:3], strict=True):
            assert torch.equal(x, y)
        assert not torch.equal(a.t, c.t)


def test_density_noise_only_with_a_generator():
    rays = small_rays(9)
    quiet, noisy = make_field(density_noise=0.0), make_field(density_noise=5.0)
    for a, b in zip(quiet.march(rays).levels, noisy.march(rays).levels, strict=True):
        assert torch.equal(a.weights, b.weights)
    a, b = quiet.march(rays, seeded()).levels[0], noisy.march(rays, seeded()).levels[0]
    assert torch.equal(a.t, b.t)
    assert torch.equal(a.features, b.features)
    assert not torch.equal(a.weights, b.weights)


def test_weights_are_those_of_the_mlps():
    field, rays = make_field(), small_rays(4)
    for mlp, level in zip((field.coarse, field.fine), field.march(rays).levels, strict=True):
        points = rays.origins[:, None] + level.t[..., None] * rays.directions[:, None]
        density, features = mlp(points, rays.directions[:, None])
        torch.testing.assert_close(level.features, features)
        torch.testing.assert_close(level.weights, render_weights(density, intervals(level.t)))


def test_fine_samples_go_where_the_coarse_level_sees_matter():
    field = make_field(coarse_samples=33, fine_samples=20)

    class Wall(torch.nn.Module):
        def forward(self, points, directions):
            return 80.0 * ((points[..., 2] > 2) & (points[..., 2] < 3)).float(), torch.zeros(*points.shape[:2], 4)

    field.coarse = Wall()
    zeros = torch.zeros(4, 3)
    rays = Rays(zeros, zeros + torch.tensor([0.0, 0.0, 1.0]), torch.zeros(4), torch.full((4,), 8.0))
    coarse, fine = field.march(rays).levels
    # The coarse samples are 0.25 apart, and the first one inside the wall, at 2.25, takes all the weight. Its bin
    # reaches half way to its neighbours.
    in_bin = [((t > 2.12) & (t < 2.38)).sum(-1) for t in (coarse.t, fine.t)]
    assert (in_bin[0] == 1).all()
    assert (in_bin[1] - in_bin[0] >= 18).all()


def test_the_fine_level_does_not_teach_the_coarse_one():
    field = make_field()
    fine = field.march(small_rays(9), seeded()).levels[1].composite().features.sum()
    gradients = torch.autograd.grad(fine, list(field.coarse.parameters()), allow_unused=True)
    assert all(g is None for g in gradients)
