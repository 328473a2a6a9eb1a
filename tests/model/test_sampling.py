"""Samples along rays, against hand-computed values, a slow reference, and the reference implementation's."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from model.sampling import refine, sample_pdf, stratified


def test_without_jitter_samples_are_even_and_reach_both_ends():
    t = stratified(torch.tensor([0.0, 1.0]), torch.tensor([4.0, 2.0]), 5)
    assert t.tolist() == [[0.0, 1.0, 2.0, 3.0, 4.0], [1.0, 1.25, 1.5, 1.75, 2.0]]


def test_jitter_moves_within_the_bins_between_mid_points():
    near, far = torch.tensor([0.0]), torch.tensor([2.0])
    low = stratified(near, far, 3, torch.zeros(1, 3))
    middle = stratified(near, far, 3, torch.full((1, 3), 0.5))
    high = stratified(near, far, 3, torch.ones(1, 3))
    assert low.tolist() == [[0.0, 0.5, 1.5]]
    assert middle.tolist() == [[0.25, 1.0, 1.75]]
    assert high.tolist() == [[0.5, 1.5, 2.0]]


def test_quantiles_of_a_histogram_of_two_bins():
    bins = torch.tensor([[0.0, 1.0, 3.0]])
    samples = sample_pdf(bins, torch.tensor([[1.0, 3.0]]), 5)  # quantiles 0, 1/4, 1/2, 3/4, 1; 1/4 lies below 1
    torch.testing.assert_close(samples, torch.tensor([[0.0, 1.0, 5 / 3, 7 / 3, 3.0]]), atol=1e-4, rtol=0)


def test_given_quantiles_are_used():
    bins = torch.tensor([[0.0, 1.0, 3.0]]).expand(2, 3)
    u = torch.tensor([[0.5], [0.125]])
    samples = sample_pdf(bins, torch.tensor([[1.0, 3.0]]).expand(2, 2), 1, u)
    torch.testing.assert_close(samples, torch.tensor([[5 / 3], [0.5]]), atol=1e-4, rtol=0)


def slow_sample_pdf(bins: list[float], weights: list[float], u: float) -> float:
    """Walk along the bins until their mass exceeds u."""
    weights = [w + 1e-5 for w in weights]
    left = u * sum(weights)
    for i, weight in enumerate(weights):
        if left < weight or i == len(weights) - 1:
            return bins[i] + left / weight * (bins[i + 1] - bins[i])
        left -= weight
    raise AssertionError


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 2**31), st.integers(1, 12))
def test_samples_agree_with_a_walk_along_the_bins(seed, n_bins):
    generator = torch.Generator().manual_seed(seed)
    bins = torch.rand(1, n_bins + 1, generator=generator, dtype=torch.float64).cumsum(-1)
    weights = torch.rand(1, n_bins, generator=generator, dtype=torch.float64) + 0.01
    u = torch.rand(1, 9, generator=generator, dtype=torch.float64)
    samples = sample_pdf(bins, weights, 9, u)
    expected = [slow_sample_pdf(bins[0].tolist(), weights[0].tolist(), x) for x in u[0].tolist()]
    assert samples[0].tolist() == pytest.approx(expected, abs=1e-9)


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 2**31))
def test_samples_stay_within_the_bins_and_ascend_even_where_all_is_empty(seed):
    generator = torch.Generator().manual_seed(seed)
    bins = torch.rand(4, 9, generator=generator).cumsum(-1)
    weights = torch.rand(4, 8, generator=generator) * (torch.rand(4, 8, generator=generator) > 0.6)
    weights[0] = 0
    samples = sample_pdf(bins, weights, 20)
    assert (samples >= bins[:, :1] - 1e-5).all()
    assert (samples <= bins[:, -1:] + 1e-5).all()
    assert (samples.diff() >= -1e-6).all()


def test_samples_carry_no_gradient():
    weights = torch.ones(1, 2, requires_grad=True)
    assert not sample_pdf(torch.tensor([[0.0, 1.0, 3.0]]), weights, 3).requires_grad


def test_refined_samples_gather_where_the_weight_is():
    t = torch.linspace(0, 10, 11)[None]
    weights = torch.zeros(1, 11)
    weights[0, 4] = 1.0  # whose bin reaches from 3.5 to 4.5
    fine = refine(t, weights, 50)
    assert fine.shape == (1, 61)
    assert (fine.diff() >= 0).all()
    assert ((fine > 3.49) & (fine < 4.51)).sum() >= 49


@pytest.mark.real
def test_golden_stratified(golden):
    vectors = golden("volume_rendering")
    near, far = vectors["in/near"], vectors["in/far"]
    even = stratified(near, far, 33)
    jittered = stratified(near, far, 33, vectors["in/jitter"])
    torch.testing.assert_close(even, vectors["out/z_vals_uniform"], atol=5e-6, rtol=0)
    torch.testing.assert_close(jittered, vectors["out/z_vals_jittered"], atol=5e-6, rtol=0)


@pytest.mark.real
@pytest.mark.parametrize("case", ["a", "b", "b_given_u"])
def test_golden_sample_pdf(golden, case):
    vectors = golden("volume_rendering")
    u = vectors["in/pdf_u_b"] if case == "b_given_u" else None
    samples = sample_pdf(vectors["in/pdf_bins"], vectors[f"in/pdf_weights_{case[0]}"], 40, u)
    errors = (samples - vectors[f"out/pdf_samples_{case}"]).abs()
    # Elsewhere the result hangs on the last bit of the cdf, and may lie in another bin.
    well_conditioned = vectors[f"in/pdf_well_conditioned_{case}"].bool()
    assert errors[well_conditioned].max() < 1e-3
    assert errors.median() < 1e-6


@pytest.mark.real
def test_golden_refine(golden):
    vectors = golden("volume_rendering")
    fine = refine(vectors["in/z_vals"], vectors["out/weights"], 40)
    rays = vectors["in/pdf_well_conditioned_a"].bool().all(dim=-1)
    assert rays.sum() > 40
    torch.testing.assert_close(fine[rays], vectors["out/z_vals_fine_a"][rays], atol=1e-3, rtol=0)
