"""The small appearance branch: its docstring's formula written out, and what it promises."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

import model.appearance.crossray as crossray
from model.appearance.compact import GRID, CompactEncoder, CompactTransform, at_size
from model.appearance.crossray import ContentStatistics

P, N, C, SMALL = 2, 40, 6, 4


@pytest.fixture
def transform():
    torch.manual_seed(0)
    return CompactTransform(C, compressed=SMALL)


def data(seed: int = 1) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    features = 1 + torch.randn(P, N, C, generator=generator)
    return features, torch.tanh(torch.randn(P, C, 5, 3, generator=generator))


def slow_transform(transform: CompactTransform, features: Tensor, embedding: Tensor) -> Tensor:
    """T(F) = F + U M_style M_content K (F - mu_cr) + v(mu_a), ray by ray."""
    out = []
    for F, S in zip(features, embedding.flatten(2).mT, strict=True):
        matrices = []
        for per_ray, read_off, x in (
            (transform.style, transform.style_matrix, S),
            (transform.content, transform.content_matrix, F),
        ):
            z = per_ray(x - x.mean(0))
            moment = sum(torch.outer(row, row) for row in z) / len(z)
            matrices.append(torch.eye(SMALL) + read_off(moment.flatten()).view(SMALL, SMALL))
        M_style, M_content = matrices
        U, K = transform.unzip.weight, transform.compress.weight
        rows = [f + U @ M_style @ M_content @ K @ (f - F.mean(0)) + transform.shift(S.mean(0)) for f in F]
        out.append(torch.stack(rows))
    return torch.stack(out)


def affine(transform: CompactTransform, features: Tensor, embedding: Tensor) -> tuple[Tensor, Tensor]:
    return transform.affine(transform.content_statistics(features), transform.style_statistics(embedding))


def test_one_affine_map_equals_the_formula(transform):
    for parameter in transform.parameters():  # away from the start, where every matrix is near I
        parameter.data += 0.3 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(3))
    features, embedding = data()
    W, b = affine(transform, features, embedding)
    assert (W.shape, b.shape) == ((P, C, C), (P, C))
    expected = slow_transform(transform, features, embedding)
    torch.testing.assert_close(features @ W.mT + b[:, None], expected, atol=1e-4, rtol=1e-4)


def test_the_order_of_rays_and_cells_does_not_matter(transform):
    features, embedding = data()
    shuffled = features[:, torch.randperm(N, generator=torch.Generator().manual_seed(2))]
    torch.testing.assert_close(transform.content_statistics(shuffled), transform.content_statistics(features))
    turned = embedding.flip(2).mT
    torch.testing.assert_close(transform.style_statistics(turned), transform.style_statistics(embedding))


def test_each_view_is_on_its_own(transform):
    features, embedding = data()
    together = affine(transform, features, embedding)
    for i in range(P):
        alone = affine(transform, features[i : i + 1], embedding[i : i + 1])
        torch.testing.assert_close(together[0][i], alone[0][0])
        torch.testing.assert_close(together[1][i], alone[1][0])


def test_one_content_serves_many_appearances(transform):
    """Running statistics have one row, whatever the number of appearances."""
    features, embedding = data()
    content = transform.content_statistics(features[:1])
    W, b = transform.affine(content, transform.style_statistics(embedding))
    assert (W.shape, b.shape) == ((P, C, C), (P, C))
    alone = transform.affine(content, transform.style_statistics(embedding[1:]))
    torch.testing.assert_close(W[1], alone[0][0])
    torch.testing.assert_close(b[1], alone[1][0])


def test_it_starts_near_the_identity():
    torch.manual_seed(0)
    transform = CompactTransform(32)
    generator = torch.Generator().manual_seed(1)
    features = torch.randn(1, 500, 32, generator=generator)
    embedding = torch.tanh(torch.randn(1, 32, GRID, GRID, generator=generator))
    with torch.no_grad():
        W, b = affine(transform, features, embedding)
        moved = features @ W.mT + b[:, None] - features
    assert moved.square().mean().sqrt() < 0.3 * features.square().mean().sqrt()
    assert torch.linalg.matrix_norm(W - torch.eye(32), ord=2) < 0.5


def test_a_view_s_own_mean_stays_in_the_picture(transform):
    """Adding a constant to all features adds it to all results: only deviations from the mean are corrected."""
    features, embedding = data()
    constant = torch.randn(C, generator=torch.Generator().manual_seed(4))
    results = []
    for x in (features, features + constant):
        W, b = affine(transform, x, embedding)
        results.append(x @ W.mT + b[:, None])
    torch.testing.assert_close(results[1], results[0] + constant, atol=1e-5, rtol=1e-5)


def test_gradients_reach_everything(transform):
    features, embedding = (value.requires_grad_() for value in data())
    W, b = affine(transform, features, embedding)
    (features @ W.mT + b[:, None]).square().sum().backward()
    for name, value in [*transform.named_parameters(), ("features", features), ("embedding", embedding)]:
        assert value.grad is not None, name
        assert value.grad.abs().sum() > 0, name


def test_embeddings_are_bounded():
    torch.manual_seed(0)
    encoder = CompactEncoder(5)
    for parameter in encoder.parameters():
        parameter.data *= 3
    embedding = encoder(torch.rand(2, 3, 33, 47))
    assert embedding.shape == (2, 5, GRID, GRID)
    assert embedding.abs().max() <= 1
    assert embedding.std() > 0.1


def test_colours_enter_centred():
    torch.manual_seed(0)
    encoder = CompactEncoder(5)
    for colour, value in ((0.5, 0.0), (1.0, 1.0), (0.0, -1.0)):
        expected = encoder.layers(torch.full((1, 3, 16, 16), value))
        torch.testing.assert_close(encoder(torch.full((1, 3, 16, 16), colour)), expected)


def test_the_encoder_takes_photos_of_any_size_each_alone():
    torch.manual_seed(0)
    encoder, images = CompactEncoder(5), torch.rand(3, 3, 64, 96)
    together = encoder(images)
    for i in range(3):
        torch.testing.assert_close(encoder(images[i : i + 1])[0], together[i], atol=1e-6, rtol=1e-5)
    assert encoder(torch.rand(1, 3, 9, 5)).shape == (1, 5, GRID, GRID)


def test_area_resize_by_hand():
    image = torch.arange(8.0).view(1, 2, 4).expand(3, 2, 4)  # rows 0 1 2 3 and 4 5 6 7
    same = torch.full((3, 7, 5), 0.25)
    out = at_size([image, same], (1, 2))
    assert out.shape == (2, 3, 1, 2)
    assert out[0, 0].tolist() == [[2.5, 4.5]]
    torch.testing.assert_close(out[1], torch.full((3, 1, 2), 0.25))


def means_only() -> CompactTransform:
    torch.manual_seed(0)
    transform = CompactTransform(C, compressed=SMALL, content=False, style=False)
    for parameter in transform.parameters():
        parameter.data += 0.3 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(3))
    return transform


def test_without_covariance_only_compression_and_means_are_left():
    transform = means_only()
    features, embedding = data()
    W, b = affine(transform, features, embedding)
    assert (W.shape, b.shape) == ((P, C, C), (P, C))
    UK = transform.unzip.weight @ transform.compress.weight
    expected = [
        torch.stack([f + UK @ (f - F.mean(0)) + transform.shift(S.mean(0)) for f in F])
        for F, S in zip(features, embedding.flatten(2).mT, strict=True)
    ]
    torch.testing.assert_close(features @ W.mT + b[:, None], torch.stack(expected), atol=1e-5, rtol=1e-5)
    assert {name.split(".")[0] for name, _ in transform.named_parameters()} == {"compress", "unzip", "shift"}


@pytest.mark.parametrize("covariance", [True, False])
def test_the_map_depends_on_covariances_exactly_where_it_should(covariance, transform):
    transform = transform if covariance else means_only()
    features, embedding = data()
    mean = features.mean(1, keepdim=True)
    changed, turned = mean + 3 * (features - mean), embedding.flip(1)
    turned = turned - turned.mean((2, 3), keepdim=True) + embedding.mean((2, 3), keepdim=True)
    W, b = affine(transform, features, embedding)
    for x, style in ((changed, embedding), (features, turned)):
        other = affine(transform, x, style)
        assert torch.allclose(W, other[0], atol=1e-6) != covariance
        assert torch.allclose(b, other[1], atol=1e-6) != covariance


def test_the_moment_size_is_the_side_of_the_statistics(transform):
    features, embedding = data()
    for module, side in ((transform, SMALL), (means_only(), 0)):
        assert module.moment_size == side
        assert module.content_statistics(features).gram.shape == (P, side, side)
        assert module.style_statistics(embedding).gram.shape == (P, side, side)


def test_blocks_bound_memory_and_change_nothing(transform, monkeypatch):
    features, _ = data()
    whole = transform.content_statistics(features)
    monkeypatch.setattr(crossray, "BLOCK", 7)
    sizes = []
    transform.content.register_forward_hook(lambda module, args, out: sizes.append(out.shape[1]))
    with torch.no_grad():
        torch.testing.assert_close(transform.content_statistics(features), ContentStatistics(*whole))
    assert sizes == [7] * 5 + [5]
