"""Volume rendering, against hand-computed values, the product form, and the reference implementation's."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from model.volume import composite, intervals, joint_weights, render_weights


def test_intervals_end_with_a_long_one():
    deltas = intervals(torch.tensor([[1.0, 1.5, 3.0]]))
    assert deltas.tolist() == [[0.5, 1.5, 100.0]]
    assert intervals(torch.tensor([[1.0, 1.5]]), last=2.0).tolist() == [[0.5, 2.0]]


def test_weights_of_half_opaque_samples():
    density = torch.full((1, 3), math.log(2.0))
    weights = render_weights(density, torch.ones(1, 3))
    torch.testing.assert_close(weights, torch.tensor([[0.5, 0.25, 0.125]]))


def test_nothing_and_less_than_nothing_weigh_nothing():
    assert render_weights(torch.tensor([[0.0, 0.0], [-1.0, -5.0]]), torch.ones(2, 2)).eq(0).all()


def test_an_opaque_sample_hides_the_rest():
    weights = render_weights(torch.tensor([[1e4, 3.0, 1e4]]), torch.tensor([[1.0, 1.0, 100.0]]))
    assert weights.tolist() == [[1.0, 0.0, 0.0]]


def test_thin_matter_is_not_rounded_away():
    weights = render_weights(torch.tensor([[1e-9, 2e-9]]), torch.ones(1, 2))
    torch.testing.assert_close(weights, torch.tensor([[1e-9, 2e-9]]), atol=0, rtol=1e-6)


def test_gradient_survives_an_opaque_sample():
    # The product form divides by (1 - alpha) = 0 here.
    density = torch.tensor([[0.3, 1e5, 1e5]], requires_grad=True)
    render_weights(density, torch.ones(1, 3))[0, 1].backward()
    assert density.grad is not None
    # w_1 = exp(-sigma_0): its derivative is -w_1
    torch.testing.assert_close(density.grad, torch.tensor([[-math.exp(-0.3), 0.0, 0.0]]))


def slow_weights(density: torch.Tensor, deltas: torch.Tensor) -> torch.Tensor:
    """The product form, sample by sample."""
    weights = []
    transmittance = torch.ones_like(density[:, 0])
    for i in range(density.shape[1]):
        alpha = 1 - torch.exp(-deltas[:, i] * density[:, i].clamp(min=0))
        weights.append(alpha * transmittance)
        transmittance = transmittance * (1 - alpha)
    return torch.stack(weights, dim=1)


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 2**31), st.integers(1, 20))
def test_weights_and_gradients_agree_with_the_product_form(seed, samples):
    generator = torch.Generator().manual_seed(seed)
    density = torch.randn(3, samples, generator=generator, dtype=torch.float64) * 3
    deltas = torch.rand(3, samples, generator=generator, dtype=torch.float64)
    cotangent = torch.randn(3, samples, generator=generator, dtype=torch.float64)
    ours, slow = density.clone().requires_grad_(), density.clone().requires_grad_()
    weights, expected = render_weights(ours, deltas), slow_weights(slow, deltas)
    torch.testing.assert_close(weights, expected)
    assert (weights.sum(-1) <= 1 + 1e-12).all()
    (weights * cotangent).sum().backward()
    (expected * cotangent).sum().backward()
    torch.testing.assert_close(ours.grad, slow.grad)


def test_composite_is_a_weighted_sum():
    weights = torch.tensor([[0.5, 0.25]])
    values = torch.tensor([[[1.0, 0.0, 2.0], [4.0, 8.0, 0.0]]])
    assert composite(weights, values).tolist() == [[1.5, 2.0, 1.0]]


@pytest.mark.real
def test_golden_volume_rendering(golden):
    vectors = golden("volume_rendering")
    t = vectors["in/z_vals"]
    features = vectors["in/features"].requires_grad_()
    density = vectors["in/sigmas"].requires_grad_()
    weights = render_weights(density, intervals(t))
    feature_map = composite(weights, features)
    depth = composite(weights, t[..., None]).squeeze(-1)
    for name, value in (("weights", weights), ("feature_map", feature_map), ("depth", depth)):
        torch.testing.assert_close(value, vectors[f"out/{name}"], atol=5e-6, rtol=0, msg=name)

    objective = (
        (feature_map * vectors["in/cotangent_feature"]).sum()
        + (depth * vectors["in/cotangent_depth"]).sum()
        + (weights * vectors["in/cotangent_weights"]).sum()
    )
    objective.backward()
    for name, value in (("features", features.grad), ("sigmas", density.grad)):
        expected = vectors[f"grad/{name}"]
        error = (value - expected).abs().max() / expected.abs().max()
        assert error < 5e-5, name
    assert density.grad[density <= 0].eq(0).all()


def test_joint_weights_by_hand():
    # Halves and quarters: sample 0 holds static matter of alpha 1/2, sample 1 both, sample 2 transient of alpha 3/4.
    two = math.log(2.0)
    static = torch.tensor([[two, two, 0.0]])
    transient = torch.tensor([[0.0, two, 2 * two]])
    w_static, w_transient = joint_weights(static, transient, torch.ones(1, 3))
    # Light before each: 1, 1/2, 1/8.
    torch.testing.assert_close(w_static, torch.tensor([[1 / 2, 1 / 4, 0.0]]))
    torch.testing.assert_close(w_transient, torch.tensor([[0.0, 1 / 4, 3 / 32]]))


def test_two_opaque_fields_in_one_sample_count_twice():
    w_static, w_transient = joint_weights(*torch.full((2, 1, 2), 1e4), torch.ones(1, 2))
    assert w_static.tolist() == w_transient.tolist() == [[1.0, 0.0]]


def test_negative_densities_do_not_let_the_other_field_shine():
    static, transient, deltas = torch.tensor([[-3.0, 1.0]]), torch.tensor([[0.5, -2.0]]), torch.ones(1, 2)
    expected = joint_weights(static.clamp(min=0), transient.clamp(min=0), deltas)
    torch.testing.assert_close(joint_weights(static, transient, deltas), expected)


def slow_joint_weights(
    static: torch.Tensor, transient: torch.Tensor, deltas: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Sample by sample, as products."""
    weights = []
    light = torch.ones_like(static[:, 0])
    for i in range(static.shape[1]):
        alphas = [1 - torch.exp(-deltas[:, i] * density[:, i].clamp(min=0)) for density in (static, transient)]
        weights.append(torch.stack([alpha * light for alpha in alphas]))
        light = light * (1 - alphas[0]) * (1 - alphas[1])
    w_static, w_transient = torch.stack(weights, dim=-1)
    return w_static, w_transient


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 2**31), st.integers(1, 12))
def test_joint_weights_and_gradients_agree_with_the_product_form(seed, samples):
    generator = torch.Generator().manual_seed(seed)
    densities = torch.randn(2, 3, samples, generator=generator, dtype=torch.float64) * 3
    deltas = torch.rand(3, samples, generator=generator, dtype=torch.float64)
    cotangent = torch.randn(2, 3, samples, generator=generator, dtype=torch.float64)
    ours, slow = densities.clone().requires_grad_(), densities.clone().requires_grad_()
    weights, expected = torch.stack(joint_weights(*ours, deltas)), torch.stack(slow_joint_weights(*slow, deltas))
    torch.testing.assert_close(weights, expected)
    (weights * cotangent).sum().backward()
    (expected * cotangent).sum().backward()
    torch.testing.assert_close(ours.grad, slow.grad)

    # Neither field is special, and without the other each is alone.
    turned = joint_weights(densities[1], densities[0], deltas)
    torch.testing.assert_close(torch.stack(turned[::-1]), expected.detach())
    alone, nothing = joint_weights(densities[0], torch.zeros_like(densities[0]), deltas)
    torch.testing.assert_close(alone, render_weights(densities[0], deltas))
    assert nothing.eq(0).all()
    # Together they weigh at least as much as one field of their summed density, and at most twice that.
    summed = render_weights(densities[0].relu() + densities[1].relu(), deltas)
    total = expected.detach().sum(0)
    assert (total >= summed - 1e-12).all()
    assert (total <= 2 * summed + 1e-12).all()


def test_joint_gradient_survives_an_opaque_sample():
    densities = torch.tensor([[[0.3, 1e5, 1e5]], [[0.2, 1e5, 1e5]]], requires_grad=True)
    sum(weights.sum() for weights in joint_weights(*densities, torch.ones(1, 3))).backward()
    assert densities.grad.isfinite().all()
