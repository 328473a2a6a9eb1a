"""Proposition 1 in the place of the learned transform: what it must do to means and covariances."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

import model.appearance.crossray as crossray
from model.appearance.closed_form import RIDGE, ClosedFormTransform
from model.appearance.crossray import AffineDecoder, ContentStatistics, StyleStatistics, recolour

P, N, C = 2, 60, 4


def data(seed: int = 0, dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor]:
    """Features (P, N, C) and embeddings (P, C, 5, 3) with means and correlations of their own."""
    generator = torch.Generator().manual_seed(seed)

    def correlated(count: int) -> Tensor:
        mix = torch.randn(P, C, C, generator=generator, dtype=torch.float64)
        x = torch.randn(P, count, C, generator=generator, dtype=torch.float64) @ mix
        return x + torch.randn(P, 1, C, generator=generator, dtype=torch.float64)

    return correlated(N).to(dtype), correlated(15).mT.unflatten(2, (5, 3)).to(dtype)


def affine(features: Tensor, embedding: Tensor) -> tuple[Tensor, Tensor]:
    transform = ClosedFormTransform(features.shape[-1])
    return transform.affine(transform.content_statistics(features), transform.style_statistics(embedding))


def apply(features: Tensor, embedding: Tensor) -> Tensor:
    W, b = affine(features, embedding)
    return features @ W.mT + b[:, None]


def slow_covariance(x: Tensor) -> Tensor:
    """Of the rows of x (N, C), one after the other."""
    return torch.stack([torch.outer(row, row) for row in x - x.mean(0)]).sum(0) / len(x)


def root(S: Tensor) -> Tensor:
    values, vectors = torch.linalg.eigh(S)
    return vectors @ torch.diag(values.sqrt()) @ vectors.mT


def test_it_learns_nothing():
    transform = ClosedFormTransform(5)
    assert list(transform.parameters()) == []
    assert transform.state_dict() == {}
    assert transform.moment_size == 5


def test_statistics_by_hand():
    transform = ClosedFormTransform(2)
    # (0, 1), (2, 1), (4, 4): mean (2, 2); centred (-2, -1), (0, -1), (2, 2).
    features = torch.tensor([[[0.0, 1.0], [2.0, 1.0], [4.0, 4.0]]])
    content = transform.content_statistics(features)
    style = transform.style_statistics(features.mT[..., None])
    assert isinstance(content, ContentStatistics)
    assert isinstance(style, StyleStatistics)
    for mean, gram in (content, style):
        assert mean.tolist() == [[2.0, 2.0]]
        torch.testing.assert_close(gram, torch.tensor([[[8.0, 6.0], [6.0, 6.0]]]) / 3)


def test_one_channel_by_hand():
    features = torch.tensor([[[1.0], [3.0]]])  # mean 2, variance 1
    embedding = torch.tensor([[[[-3.0, 5.0]]]])  # mean 1, variance 16
    W, b = affine(features, embedding)
    T = ((16 + RIDGE) / (1 + RIDGE)) ** 0.5
    assert W.item() == pytest.approx(T, rel=1e-6)
    assert b.item() == pytest.approx(1 - 2 * T, rel=1e-5)


def test_it_is_the_formula_of_the_module():
    features, embedding = data(dtype=torch.float64)
    W, b = affine(features, embedding)
    assert (W.shape, b.shape) == ((P, C, C), (P, C))
    ridge = RIDGE * torch.eye(C, dtype=torch.float64)
    for p in range(P):
        cells = embedding[p].flatten(1).mT
        S_cr, S_a = slow_covariance(features[p]) + ridge, slow_covariance(cells) + ridge
        inverse = torch.linalg.inv(root(S_cr))
        T = inverse @ root(root(S_cr) @ S_a @ root(S_cr)) @ inverse
        torch.testing.assert_close(W[p], T)
        torch.testing.assert_close(
            features[p] @ W[p].mT + b[p],
            torch.stack([T @ (ray - features[p].mean(0)) + cells.mean(0) for ray in features[p]]),
        )


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 2**31), st.floats(-2, 1), st.floats(-2, 1))
def test_the_rays_get_the_mean_and_the_covariance_of_the_reference(seed, content_scale, style_scale):
    features, embedding = data(seed, torch.float64)
    features, embedding = 10**content_scale * features, 10**style_scale * embedding
    W, _ = affine(features, embedding)
    out = apply(features, embedding)
    cells = embedding.flatten(2).mT
    torch.testing.assert_close(out.mean(1), cells.mean(1))
    for p in range(P):
        # T (S_cr + r) T^T = S_a + r exactly, so the ridge is all that separates the two covariances.
        wanted = slow_covariance(cells[p]) + RIDGE * (torch.eye(C, dtype=torch.float64) - W[p] @ W[p].mT)
        torch.testing.assert_close(slow_covariance(out[p]), wanted, rtol=1e-7, atol=1e-9 * wanted.norm().item())


def test_well_above_the_ridge_the_covariance_is_that_of_the_reference():
    features, embedding = data()
    out = apply(30 * features, 30 * embedding)
    for p in range(P):
        wanted = slow_covariance(30 * embedding[p].flatten(1).mT)
        assert (slow_covariance(out[p]) - wanted).norm() < 1e-3 * wanted.norm()


def test_nothing_moves_where_the_reference_is_like_the_rays():
    features, _ = data()
    cells = features[:, torch.randperm(N, generator=torch.Generator().manual_seed(2))]
    torch.testing.assert_close(apply(features, cells.mT.unflatten(2, (6, 10))), features, atol=1e-4, rtol=1e-4)


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 2**31), st.floats(-4, 1), st.floats(-4, 1))
def test_it_is_symmetric_and_stretches_no_more_than_the_ridge_allows(seed, content_scale, style_scale):
    features, embedding = data(seed)
    features, embedding = 10**content_scale * features, 10**style_scale * embedding
    W, _ = affine(features, embedding)
    assert W.dtype == torch.float32
    torch.testing.assert_close(W, W.mT)
    assert (torch.linalg.eigvalsh(W.double()) > 0).all()
    largest = torch.linalg.eigvalsh(slow_covariance(embedding[0].flatten(1).mT).double())[-1]
    assert torch.linalg.matrix_norm(W[0].double(), 2) <= 1.001 * ((largest + RIDGE) / RIDGE) ** 0.5


def test_the_order_of_rays_and_cells_does_not_matter():
    features, embedding = data()
    shuffled = features[:, torch.randperm(N, generator=torch.Generator().manual_seed(2))]
    torch.testing.assert_close(affine(shuffled, embedding.flip(2).mT), affine(features, embedding))


def test_each_patch_is_on_its_own():
    features, embedding = data()
    together = affine(features, embedding)
    for p in range(P):
        alone = affine(features[p : p + 1], embedding[p : p + 1])
        torch.testing.assert_close((together[0][p], together[1][p]), (alone[0][0], alone[1][0]))


def test_one_content_serves_many_appearances():
    features, embedding = data()
    transform = ClosedFormTransform(C)
    content = transform.content_statistics(features[:1])
    W, b = transform.affine(content, transform.style_statistics(embedding))
    assert (W.shape, b.shape) == ((P, C, C), (P, C))
    alone = transform.affine(content, transform.style_statistics(embedding[1:]))
    torch.testing.assert_close((W[1], b[1]), (alone[0][0], alone[1][0]))


def test_it_folds_into_the_decoder_like_the_learned_one():
    features, embedding = data()
    decoder = AffineDecoder(C)
    rgb = recolour(features, *decoder.fold(*affine(features, embedding)))
    torch.testing.assert_close(rgb, decoder(apply(features, embedding)), atol=1e-5, rtol=1e-5)


def test_blocks_bound_memory_and_change_nothing(monkeypatch):
    features, embedding = data()
    features = features + 100  # far from zero: a covariance as mean of squares less square of means would show it
    whole = affine(features, embedding)
    sizes = []
    outer_sum = crossray.outer_sum
    monkeypatch.setattr(crossray, "BLOCK", 7)
    monkeypatch.setattr(crossray, "outer_sum", lambda z: [sizes.append(z.shape[1]), outer_sum(z)][1])
    with torch.no_grad():
        ClosedFormTransform(C).content_statistics(features)
        assert sizes == [7] * 8 + [4]
        torch.testing.assert_close(affine(features, embedding), whole, atol=1e-3, rtol=1e-4)


@pytest.mark.parametrize("flat", ["features", "embedding", "both"])
def test_constants_have_finite_maps_and_gradients(flat):
    features, embedding = data()
    if flat in ("features", "both"):
        features = torch.full_like(features, 0.25)
    if flat in ("embedding", "both"):
        embedding = torch.full_like(embedding, 0.5)
    features.requires_grad_()
    embedding.requires_grad_()
    W, b = affine(features, embedding)
    if flat == "both":
        torch.testing.assert_close(W, torch.eye(C).expand(P, C, C))
        torch.testing.assert_close(b, torch.full((P, C), 0.25))
    (features @ W.mT + b[:, None]).square().sum().backward()
    for value in (W, b, features.grad, embedding.grad):
        assert value.isfinite().all()
    assert embedding.grad.abs().sum() > 0


def test_noise_is_not_blown_up():
    """As at the start of training: nearly constant features, a reference with contrast."""
    generator = torch.Generator().manual_seed(0)
    features = 0.5 + 1e-4 * torch.randn(P, N, C, generator=generator)
    _, embedding = data()
    deviation = (apply(features, embedding) - embedding.flatten(2).mT.mean(1)[:, None]).abs().max()
    assert deviation < 0.1 * embedding.std()


def test_fewer_rays_than_channels_are_finite():
    generator = torch.Generator().manual_seed(0)
    features = torch.rand(1, 5, 32, generator=generator, requires_grad=True)
    W, b = affine(features, torch.randn(1, 32, 4, 4, generator=generator))
    (W.square().sum() + b.square().sum()).backward()
    assert W.isfinite().all()
    assert features.grad.isfinite().all()


def test_gradients_against_differences():
    features, embedding = (value.requires_grad_() for value in data(3, torch.float64))
    torch.autograd.gradcheck(affine, (features[:1, :9], embedding[:1]))


def test_no_rays_are_refused():
    with pytest.raises(ValueError, match=r"\(2, 0, 4\)"):
        ClosedFormTransform(C).content_statistics(torch.zeros(P, 0, C))
