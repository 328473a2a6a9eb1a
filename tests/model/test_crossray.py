"""The cross-ray transform: one affine map of statistics that are values."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

import model.appearance.crossray as crossray
from model.appearance.crossray import (
    AffineDecoder,
    ContentStatistics,
    ReleasedTransform,
    StyleStatistics,
    outer_sum,
    recolour,
)
from model.released import DECODER, TRANSFORM, load_released, under


@pytest.fixture
def transform():
    torch.manual_seed(0)
    return ReleasedTransform(channels=6, compressed=4)


def data(patches: int = 2, rays: int = 50, channels: int = 6) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    features = torch.rand(patches, rays, channels, generator=generator)
    return features, torch.randn(patches, channels, 5, 3, generator=generator)


def test_the_modules_have_the_released_sizes():
    assert sum(p.numel() for p in ReleasedTransform().parameters()) == 2_140_704
    assert sum(p.numel() for p in AffineDecoder().parameters()) == 195


def test_outer_sum_by_hand():
    z = torch.tensor([[[1.0, 2.0], [3.0, -1.0]]])
    assert outer_sum(z).tolist() == [[[10.0, -1.0], [-1.0, 5.0]]]


def test_the_second_moment_is_a_mean_and_is_not_recentred():
    transform = ReleasedTransform(channels=2, compressed=2)
    transform.content.per_ray = nn.Identity()
    # Rays (0, 1), (2, 1), (4, 4): mean (2, 2); centred (-2, -1), (0, -1), (2, 2).
    features = torch.tensor([[[0.0, 1.0], [2.0, 1.0], [4.0, 4.0]]])
    statistics = transform.content_statistics(features)
    assert statistics.mean.tolist() == [[2.0, 2.0]]
    torch.testing.assert_close(statistics.gram, torch.tensor([[[8.0, 6.0], [6.0, 6.0]]]) / 3)

    transform.content.per_ray = nn.Linear(2, 2)
    nn.init.zeros_(transform.content.per_ray.weight)
    nn.init.constant_(transform.content.per_ray.bias, 3.0)
    # A constant has no covariance, but a second moment.
    torch.testing.assert_close(transform.content_statistics(features).gram, torch.full((1, 2, 2), 9.0))


def test_style_statistics_by_hand():
    transform = ReleasedTransform(channels=2, compressed=2)
    transform.style.per_ray = nn.Identity()
    reference = torch.tensor([[[[0.0, 2.0, 4.0]], [[1.0, 1.0, 4.0]]]])  # the rays of the test above, as cells
    mean, gram = transform.style_statistics(reference)
    assert mean.tolist() == [[2.0, 2.0]]
    torch.testing.assert_close(gram, torch.tensor([[[8.0, 6.0], [6.0, 6.0]]]) / 3)


def slow_transform(transform: ReleasedTransform, features: Tensor, reference: Tensor) -> Tensor:
    """T step by step, one patch at a time, as the paper's figure and the released code have it."""
    out = []
    for F, S in zip(features, reference.flatten(2).mT, strict=True):
        matrices = []
        for net, x in ((transform.style, S), (transform.content, F)):
            z = net.per_ray(x - x.mean(0))
            moment = sum(torch.outer(row, row) for row in z) / len(z)
            matrices.append(net.read_off(moment.flatten()).view_as(moment))
        compressed = transform.compress(F - F.mean(0))
        mixed = torch.stack([matrices[0] @ matrices[1] @ ray for ray in compressed])
        out.append(transform.expand(mixed) + S.mean(0))
    return torch.stack(out)


def test_one_affine_map_equals_the_steps(transform):
    features, reference = data()
    W, b = transform.affine(transform.content_statistics(features), transform.style_statistics(reference))
    assert (W.shape, b.shape) == ((2, 6, 6), (2, 6))
    expected = slow_transform(transform, features, reference)
    torch.testing.assert_close(features @ W.mT + b[:, None], expected, atol=1e-6, rtol=1e-5)


def test_transform_and_decoder_collapse_to_a_3_by_c_matrix(transform):
    features, reference = data()
    decoder = AffineDecoder(channels=6)
    W, b = transform.affine(transform.content_statistics(features), transform.style_statistics(reference))
    A, folded = decoder.fold(W, b)
    assert (A.shape, folded.shape) == ((2, 3, 6), (2, 3))
    expected = decoder(slow_transform(transform, features, reference))
    torch.testing.assert_close(recolour(features, A, folded), expected, atol=1e-6, rtol=1e-5)


def test_each_patch_is_on_its_own(transform):
    features, reference = data()
    together = transform.affine(transform.content_statistics(features), transform.style_statistics(reference))
    for i in range(2):
        alone = transform.affine(
            transform.content_statistics(features[i : i + 1]),
            transform.style_statistics(reference[i : i + 1]),
        )
        torch.testing.assert_close(together[0][i], alone[0][0])
        torch.testing.assert_close(together[1][i], alone[1][0])


def test_the_order_of_rays_and_cells_does_not_matter(transform):
    features, reference = data()
    shuffled = features[:, torch.randperm(50, generator=torch.Generator().manual_seed(2))]
    turned = reference.flip(2).mT
    torch.testing.assert_close(transform.content_statistics(shuffled), transform.content_statistics(features))
    torch.testing.assert_close(transform.style_statistics(turned), transform.style_statistics(reference))


def test_blocks_bound_memory_and_change_nothing(transform, monkeypatch):
    features, _ = data()
    whole = transform.content_statistics(features)
    monkeypatch.setattr(crossray, "BLOCK", 7)
    longest = []
    transform.content.per_ray.register_forward_hook(lambda module, args, out: longest.append(out.shape[1]))
    with torch.no_grad():
        in_blocks = transform.content_statistics(features)
    assert longest == [7] * 7 + [1]
    torch.testing.assert_close(in_blocks, ContentStatistics(*(value.detach() for value in whole)))


def test_statistics_of_a_view_colour_any_part_of_it(transform):
    """Cutting a picture into chunks cannot change it, given the statistics."""
    features, reference = data()
    decoder = AffineDecoder(channels=6)
    with torch.no_grad():
        A, b = decoder.fold(
            *transform.affine(transform.content_statistics(features), transform.style_statistics(reference))
        )
        chunks = [recolour(chunk, A, b) for chunk in features.split(11, dim=1)]
        torch.testing.assert_close(torch.cat(chunks, dim=1), recolour(features, A, b), atol=1e-6, rtol=0)


def test_gradients_reach_everything(transform):
    features, reference = (value.requires_grad_() for value in data())
    W, b = transform.affine(transform.content_statistics(features), transform.style_statistics(reference))
    (features @ W.mT + b[:, None]).square().sum().backward()
    for name, value in [*transform.named_parameters(), ("features", features), ("reference", reference)]:
        assert value.grad is not None, name
        assert value.grad.abs().sum() > 0, name


def test_no_rays_are_refused(transform):
    with pytest.raises(ValueError, match=r"\(2, 0, 6\)"):
        transform.content_statistics(torch.zeros(2, 0, 6))


def squeezed(features: Tensor) -> Tensor:
    """Other features with the same mean and another covariance."""
    mean = features.mean(1, keepdim=True)
    mix = torch.randn(features.shape[-1], features.shape[-1], generator=torch.Generator().manual_seed(3))
    return mean + (features - mean) @ mix


def means_only() -> ReleasedTransform:
    torch.manual_seed(0)
    return ReleasedTransform(channels=6, compressed=4, content=False, style=False)


def test_without_covariance_only_compression_and_means_are_left():
    transform = means_only()
    features, reference = data()
    content, style = transform.content_statistics(features), transform.style_statistics(reference)
    assert content.gram.shape == style.gram.shape == (2, 0, 0)
    assert torch.equal(transform.matrix(content, style), torch.eye(4).expand(2, 4, 4))
    W, b = transform.affine(content, style)
    expected = [
        transform.expand(transform.compress(F - F.mean(0))) + S.mean(0)
        for F, S in zip(features, reference.flatten(2).mT, strict=True)
    ]
    torch.testing.assert_close(features @ W.mT + b[:, None], torch.stack(expected), atol=1e-6, rtol=1e-5)
    # Of the 2,140,704 parameters the two moment networks are all but 64 32 + 32 and 32 64 + 64.
    assert sum(p.numel() for p in ReleasedTransform(content=False, style=False).parameters()) == 4_192


@pytest.mark.parametrize("covariance", [True, False])
def test_the_map_depends_on_covariances_exactly_where_it_should(covariance, transform):
    transform = transform if covariance else means_only()
    features, reference = data()
    before = transform.affine(transform.content_statistics(features), transform.style_statistics(reference))
    other = squeezed(reference.flatten(2).mT).mT.unflatten(2, (5, 3))
    changed = [
        transform.affine(transform.content_statistics(squeezed(features)), transform.style_statistics(reference)),
        transform.affine(transform.content_statistics(features), transform.style_statistics(other)),
    ]
    for W, b in changed:
        assert torch.allclose(W, before[0], atol=1e-6) != covariance
        assert torch.allclose(b, before[1], atol=1e-5) != covariance
    moved = transform.affine(transform.content_statistics(features + 1), transform.style_statistics(reference))
    torch.testing.assert_close(moved[0], before[0])
    assert not torch.allclose(moved[1], before[1], atol=1e-2)


def test_without_covariance_one_content_serves_many_appearances():
    transform = means_only()
    features, reference = data()
    content = transform.content_statistics(features[:1])
    W, b = transform.affine(content, transform.style_statistics(reference))
    assert (W.shape, b.shape) == ((2, 6, 6), (2, 6))
    torch.testing.assert_close(b[1], transform.affine(content, transform.style_statistics(reference[1:]))[1][0])


def test_the_moment_size_is_the_side_of_the_statistics(transform):
    features, reference = data()
    for module in (transform, means_only()):
        side = module.moment_size
        assert module.content_statistics(features).gram.shape == (2, side, side)
        assert module.style_statistics(reference).gram.shape == (2, side, side)


def released_pair(vectors: dict) -> tuple[ReleasedTransform, AffineDecoder]:
    transform, decoder = ReleasedTransform(), AffineDecoder()
    load_released(transform, under(vectors, "param/multi_net."), TRANSFORM)
    load_released(decoder, under(vectors, "param/decoder."), DECODER)
    return transform, decoder


def as_rays(features: Tensor) -> Tensor:
    return features.flatten(2).mT


@pytest.mark.real
def test_golden_transform(golden):
    vectors = golden("transform")
    transform, decoder = released_pair(vectors)
    features = as_rays(vectors["in/F_cr"])
    with torch.no_grad():
        content = transform.content_statistics(features)
        style = transform.style_statistics(vectors["in/F_a"])
        W, b = transform.affine(content, style)
        values = {
            "transmatrix": transform.matrix(content, style),
            "T_of_F": features @ W.mT + b[:, None],
            "rgb": recolour(features, *decoder.fold(W, b)),
            "rgb_no_transform": decoder(features),
        }
    for name, value in values.items():
        expected = vectors[f"out/{name}"]
        expected = expected if name == "transmatrix" else as_rays(expected)
        torch.testing.assert_close(value, expected, atol=1e-5, rtol=0, msg=lambda m, name=name: f"{name}: {m}")


@pytest.mark.real
def test_golden_transform_gradients(golden):
    vectors = golden("transform")
    transform, decoder = released_pair(vectors)
    F_cr, F_a = (vectors[f"in/{name}"].requires_grad_() for name in ("F_cr", "F_a"))
    features = as_rays(F_cr)
    content, style = transform.content_statistics(features), transform.style_statistics(F_a)
    rgb = recolour(features, *decoder.fold(*transform.affine(content, style)))
    (rgb * as_rays(vectors["in/rgb_weights"])).sum().backward()

    ours = {"F_cr": F_cr, "F_a": F_a}
    for module, names, prefix in (
        (transform, TRANSFORM, "param/multi_net."),
        (decoder, DECODER, "param/decoder."),
    ):
        parameters = dict(module.named_parameters())
        ours |= {prefix + theirs: parameters[name] for theirs, name in names.items()}
    checked = under(vectors, "grad/")
    assert len(checked) == 11
    for name, expected in checked.items():
        gradient = ours[name].grad
        assert gradient is not None, name
        torch.testing.assert_close(
            gradient,
            expected.reshape(gradient.shape),
            atol=1e-4,
            rtol=0,
            msg=lambda m, name=name: f"{name}: {m}",
        )


def test_statistics_are_plain_tuples_of_tensors(transform):
    """So that a caller may average, keep or send them."""
    features, reference = data()
    content, style = transform.content_statistics(features), transform.style_statistics(reference)
    half = ContentStatistics(*(0.5 * (a + b) for a, b in zip(content, content, strict=True)))
    torch.testing.assert_close(half, content)
    assert isinstance(style, StyleStatistics)
