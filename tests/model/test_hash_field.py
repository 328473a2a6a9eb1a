"""The fast field: contraction, proposal resampling, its loss, and the background."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from small_models import BOX, HASH, small_rays
from torch import Tensor

from model.fields.base import Level, Rays
from model.fields.hash import HashField, interlevel_loss, uniform_edges

UNEVEN_BOX = torch.tensor([[-1.0, -2.0, 0.0], [3.0, 2.0, 8.0]])  # middle (1, 0, 4), half sides (2, 2, 4)


def make_field(box: Tensor = BOX, rgb: bool = False, **changes) -> HashField:
    torch.manual_seed(0)
    field = HashField(replace(HASH, **changes), channels=3 if rgb else 5, rgb=rgb, box=box)
    for grid in (field.grid, field.proposal_grid):
        torch.nn.init.normal_(grid.table)
    return field


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


# ------------------------------------------------------------------------------------------------- contraction


def test_contraction_by_hand():
    field = make_field(UNEVEN_BOX)
    points = torch.tensor([[1.0, 0.0, 4.0], [3.0, -2.0, 6.0], [5.0, 0.0, -12.0], [-7.0, 8.0, 4.0]])
    # In half sides from the middle: (0,0,0), (1,-1,0.5), (2,0,-4), (-4,4,0); outside |x| becomes 2 - 1/|x|.
    contracted = torch.tensor([[0, 0, 0], [1, -1, 0.5], [1.5, 0, -1.75], [-1.75, 1.75, 0]])
    torch.testing.assert_close(field.contract(points), contracted / 4 + 0.5)
    assert field.contract(points.view(2, 2, 3)).shape == (2, 2, 3)


def test_contraction_is_continuous_and_strictly_monotonic():
    field = make_field(UNEVEN_BOX)
    middle, half = UNEVEN_BOX.mean(0), 0.5 * (UNEVEN_BOX[1] - UNEVEN_BOX[0])
    s = torch.linspace(-6, 6, 2401)  # in half sides; the box's faces are at +-1
    out = field.contract(middle + s[:, None] * half)
    steps = out.diff(dim=0)
    assert (steps > 0).all()
    assert (steps < 0.25 * 0.005 + 1e-6).all()  # the slope is 1/4 inside and less outside: no jump at the faces


@settings(deadline=None, max_examples=25)
@given(s=st.tuples(*[st.floats(-50, 50, width=32)] * 3))
def test_contraction_stays_in_the_unit_cube_and_can_be_undone(s):
    field = make_field(UNEVEN_BOX)
    middle, half = UNEVEN_BOX.mean(0), 0.5 * (UNEVEN_BOX[1] - UNEVEN_BOX[0])
    s = torch.tensor(s)
    out = field.contract(middle + s * half)
    assert ((out > 0) & (out < 1)).all()
    c = 4 * (out - 0.5)
    undone = torch.where(c.abs() <= 1, c, c.sign() / (2 - c.abs()))
    torch.testing.assert_close(undone, s, atol=1e-5, rtol=1e-3)


def test_a_point_at_infinity_has_features():
    field = make_field()
    density, features = field.density_and_inner(torch.tensor([[1e9, -1e9, 0.0]]))
    assert density.isfinite().all()
    assert features.isfinite().all()


# -------------------------------------------------------------------------------------------------- resampling


def test_uniform_edges_by_hand():
    near, far = torch.tensor([1.0, 0.0]), torch.tensor([3.0, 8.0])
    assert uniform_edges(near, far, 4, None).tolist() == [[1, 1.5, 2, 2.5, 3], [0, 2, 4, 6, 8]]


def test_jittered_edges_stay_in_their_places():
    near, far = torch.ones(200), torch.full((200,), 5.0)
    even, moved = uniform_edges(near, far, 8, None), uniform_edges(near, far, 8, seeded())
    assert torch.equal(moved[:, [0, -1]], even[:, [0, -1]])
    assert ((moved - even).abs() <= 0.25 + 1e-6).all()  # half of an interval of 0.5
    assert (moved - even)[:, 1:-1].abs().max() > 0.2
    assert (moved.diff(dim=-1) > -1e-6).all()
    assert torch.equal(moved, uniform_edges(near, far, 8, seeded()))
    assert not torch.equal(moved, uniform_edges(near, far, 8, seeded(1)))


@pytest.mark.parametrize("generator", [None, 3])
def test_resampled_edges_are_ordered_and_between_near_and_far(generator):
    field = make_field()
    weights = torch.rand(50, 8, generator=seeded(1)) ** 8  # a few heavy intervals
    edges = uniform_edges(torch.full((50,), 2.0), torch.full((50,), 7.0), 8, seeded(2))
    found = field.resample(edges, weights, 20, None if generator is None else seeded(generator))
    assert found.shape == (50, 21)
    assert (found.diff(dim=-1) >= -1e-5).all()
    assert found.min() >= 2 - 1e-5
    assert found.max() <= 7 + 1e-5


def test_without_jitter_the_resampled_edges_reach_from_near_to_far():
    field = make_field()
    edges = uniform_edges(torch.tensor([2.0]), torch.tensor([7.0]), 8, None).expand(3, -1)
    weights = torch.tensor([[0.0] * 8, [1.0] + [0.0] * 7, [0.0] * 7 + [1.0]])
    found = field.resample(edges, weights, 5, None)
    torch.testing.assert_close(found[:, 0], torch.full((3,), 2.0), atol=1e-5, rtol=0)
    torch.testing.assert_close(found[:, -1], torch.full((3,), 7.0), atol=1e-5, rtol=0)


def test_resampling_by_hand():
    field = make_field()
    edges = torch.tensor([[0.0, 1.0, 2.0]])
    # Histogram 0.99 + 0.005 and 0 + 0.005 of a sum of 1: the quantile q lies at q / 0.995, the last at the far end.
    found = field.resample(edges, torch.tensor([[0.99, 0.0]]), 4, None)
    expected = torch.tensor([[0.0, 0.25 / 0.995, 0.5 / 0.995, 0.75 / 0.995, 2.0]])
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=0)


def test_samples_go_where_the_proposal_sees_matter():
    field = make_field(proposal_samples=16, samples=10)
    field.proposal_density = lambda x: 50.0 * ((x[..., 2] > 2) & (x[..., 2] < 3)).float()
    zeros = torch.zeros(4, 3)
    rays = Rays(zeros, zeros + torch.tensor([0.0, 0.0, 1.0]), torch.zeros(4), torch.full((4,), 8.0))
    t = field.march(rays).levels[0].t
    assert (((t > 2) & (t < 3)).sum(-1) >= 8).all()


# ---------------------------------------------------------------------------------------------- interlevel loss


def slow_interlevel(edges: Tensor, weights: Tensor, outer_edges: Tensor, outer_weights: Tensor) -> float:
    total = 0.0
    for e, w, oe, ow in zip(*(x.tolist() for x in (edges, weights, outer_edges, outer_weights)), strict=True):
        for a, b, weight in zip(e[:-1], e[1:], w, strict=True):
            overlapping = [
                m for c, d, m in zip(oe[:-1], oe[1:], ow, strict=True) if c < b and d > a
            ]  # more than a shared edge
            total += max(0.0, weight - sum(overlapping)) ** 2 / (weight + 1e-5)
    return total / len(edges)


def histogram(rays: int, count: int, seed: int, low: float = 0.0, high: float = 1.0) -> tuple[Tensor, Tensor]:
    inner = torch.rand(rays, count - 1, generator=seeded(seed)).sort(dim=-1).values
    edges = torch.cat([torch.zeros(rays, 1), inner, torch.ones(rays, 1)], dim=-1)
    weights = torch.rand(rays, count, generator=seeded(seed + 100))
    return low + (high - low) * edges, weights / weights.sum(-1, keepdim=True)


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (0.2, 0.8)])
def test_interlevel_loss_equals_the_slow_loop(low, high):
    fine, outer = histogram(6, 9, 0, low, high), histogram(6, 5, 1)
    loss = interlevel_loss(*fine, outer[0], 0.3 * outer[1])
    assert loss > 0.01
    assert loss.item() == pytest.approx(slow_interlevel(*fine, outer[0], 0.3 * outer[1]), rel=1e-4)


@pytest.mark.parametrize("outer_weights", [[0.5, 0.1], [0.1, 0.5]])
def test_a_proposal_interval_that_only_touches_does_not_count(outer_weights):
    edges = torch.tensor([[0.0, 1.0, 2.0]])
    loss = interlevel_loss(edges, torch.tensor([[0.5, 0.5]]), edges, torch.tensor([outer_weights]))
    assert loss.item() == pytest.approx(0.4**2 / 0.5, rel=1e-3)


def test_interlevel_loss_is_zero_where_the_proposal_dominates():
    edges, weights = histogram(6, 9, 0)
    torch.testing.assert_close(interlevel_loss(edges, weights, edges, weights), torch.tensor(0.0), atol=1e-9, rtol=0)
    outer_edges, _ = histogram(6, 5, 1)
    # What the field sees in each proposal interval, counted whole: an upper bound by construction.
    overlap = (edges[:, None, :-1] < outer_edges[:, 1:, None]) & (edges[:, None, 1:] > outer_edges[:, :-1, None])
    bound = (overlap * weights[:, None]).sum(-1)
    assert interlevel_loss(edges, weights, outer_edges, bound) < 1e-9


def test_interlevel_loss_only_raises_the_proposal():
    edges, weights = histogram(6, 9, 0)
    outer_edges, outer_weights = histogram(6, 5, 1)
    outer_weights = (0.3 * outer_weights).requires_grad_()
    interlevel_loss(edges, weights, outer_edges, outer_weights).backward()
    assert (outer_weights.grad <= 1e-9).all()
    assert (outer_weights.grad < -1e-3).any()


# -------------------------------------------------------------------------------------------------- background


def test_a_level_gives_the_background_what_is_left():
    level = Level(
        t=torch.tensor([[1.0, 2.0]]),
        weights=torch.tensor([[0.5, 0.25]]),
        features=torch.tensor([[[1.0, 0.0], [4.0, 8.0]]]),
        background=torch.tensor([[10.0, -4.0]]),
    )
    rendering = level.composite()
    assert rendering.features.tolist() == [[1.5 + 2.5, 2.0 - 1.0]]
    assert rendering.depth.tolist() == [1.0]
    assert rendering.accumulation.tolist() == [0.75]
    assert level._replace(background=None).composite().features.tolist() == [[1.5, 2.0]]


def test_empty_space_shows_the_background_and_matter_hides_it():
    rays = small_rays(10)
    empty = make_field(density_bias=-40.0).march(rays).levels[-1]
    rendering = empty.composite()
    torch.testing.assert_close(rendering.features, empty.background)
    assert rendering.accumulation.max() < 1e-6

    solid = make_field(density_bias=20.0).march(rays).levels[-1]
    torch.testing.assert_close(solid.composite().features, solid.features[:, 0], atol=1e-4, rtol=0)
    assert solid.composite().accumulation.min() > 0.999


def test_the_background_is_a_function_of_direction_alone():
    field, rays = make_field(), small_rays(6)
    elsewhere = rays._replace(origins=rays.origins + 5, near=rays.near + 1, far=rays.far + 2)
    torch.testing.assert_close(field.march(rays).levels[0].background, field.march(elsewhere).levels[0].background)


# ------------------------------------------------------------------------------------------------------- march


def test_shapes_and_sample_counts():
    field, rays = make_field(), small_rays(7)
    for samples, count in ((None, HASH.samples), ((12, 9), 9)):
        (level,) = field.march(rays, samples=samples).levels
        assert level.t.shape == level.weights.shape == (7, count)
        assert level.features.shape == (7, count, 5)
        assert level.background is not None
        assert level.background.shape == (7, 5)
        assert (level.t.diff(dim=-1) >= 0).all()
        assert (level.t >= rays.near[:, None]).all()
        assert (level.t <= rays.far[:, None]).all()
        assert (level.weights >= 0).all()
        assert (level.weights.sum(-1) <= 1 + 1e-6).all()


def test_the_first_count_is_the_proposal_s():
    field, seen = make_field(), []
    density = field.proposal_density
    field.proposal_density = lambda x: seen.append(x.shape) or density(x)
    field.march(small_rays(7), samples=(12, 9))
    field.march(small_rays(7))
    assert seen == [(7, 12, 3), (7, HASH.proposal_samples, 3)]


def test_only_a_generator_brings_jitter_and_a_loss():
    field, rays = make_field(), small_rays(20)
    plain, again = field.march(rays), field.march(rays)
    assert plain.losses == {}
    for a, b in zip(plain.levels[0], again.levels[0], strict=True):
        assert torch.equal(a, b)
    jittered = field.march(rays, seeded(4))
    assert list(jittered.losses) == ["interlevel"]
    assert not torch.equal(jittered.levels[0].t, plain.levels[0].t)
    for a, b in zip(jittered.levels[0], field.march(rays, seeded(4)).levels[0], strict=True):
        assert torch.equal(a, b)
    assert not torch.equal(jittered.levels[0].t, field.march(rays, seeded(5)).levels[0].t)


def test_proposal_and_field_learn_from_their_own_losses():
    field = make_field(density_bias=2.0)
    field.proposal[-1].bias.data.fill_(-6.0)  # a proposal that sees too little
    march = field.march(small_rays(40), seeded())
    (in_proposal, in_grid) = torch.autograd.grad(
        march.losses["interlevel"], [field.proposal_grid.table, field.grid.table], allow_unused=True, retain_graph=True
    )
    assert in_grid is None
    assert in_proposal.abs().sum() > 0
    features = march.levels[0].composite().features.sum()
    (in_proposal, in_grid) = torch.autograd.grad(
        features, [field.proposal_grid.table, field.grid.table], allow_unused=True
    )
    assert in_proposal is None
    assert in_grid.abs().sum() > 0


def test_density_is_exponential_and_bounded():
    field = make_field(density_bias=-1.5)
    raw = torch.tensor([0.0, 1.5, 1000.0])
    torch.testing.assert_close(field.density(raw), torch.exp(torch.tensor([-1.5, 0.0, 12.0])))


def test_colours_are_bounded_and_features_are_free():
    rays = small_rays(20)
    rgb = make_field(rgb=True)
    for parameter in rgb.trunk.parameters():
        parameter.data *= 3
    level = rgb.march(rays).levels[0]
    for colours in (level.features, level.background):
        assert colours.min() > 0
        assert colours.max() < 1
    free = make_field()
    for parameter in free.trunk.parameters():
        parameter.data *= 3
    features = free.march(rays).levels[0].features
    assert features.min() < -1
    assert features.max() > 1
