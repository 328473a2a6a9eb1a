"""Codes read off a photo: what the networks promise, and Ha-NeRF as a whole against its released numbers."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from model.appearance.code import LEAST, CompactCode, ReleasedCode
from model.appearance.compact import CompactEncoder
from model.fields.mlp import RadianceMLP
from model.losses import (
    LossWeights,
    appearance_consistency,
    embedding_size,
    mask_size,
    mode_seeking,
    photometric,
)
from model.methods import CODE
from model.released import CODE_NETWORK, NERF_MLP, load_released, under
from model.volume import composite, intervals, render_weights


@pytest.fixture(params=[ReleasedCode, CompactCode])
def network(request):
    torch.manual_seed(0)
    return request.param()


def photos(count: int = 2, size: tuple[int, int] = (18, 21)) -> Tensor:
    return torch.rand(count, 3, *size, generator=torch.Generator().manual_seed(1))


def test_the_network_has_the_released_size():
    assert sum(p.numel() for p in ReleasedCode().parameters()) == 2_775_216


def test_a_code_for_each_photo_and_each_photo_alone(network):
    images = photos()
    with torch.no_grad():
        codes = network(images)
        assert codes.shape == (2, CODE)
        torch.testing.assert_close(network(images[1:])[0], codes[1], atol=1e-6, rtol=1e-5)
    assert not torch.allclose(codes[0], codes[1], atol=1e-4)


def test_photos_of_any_size_down_to_the_smallest(network):
    with torch.no_grad():
        for size in ((LEAST, LEAST), (LEAST, 37), (33, 24)):
            assert network(photos(1, size)).shape == (1, CODE)


def test_colours_enter_centred(network):
    with torch.no_grad():
        inside = network.layers(torch.full((1, 3, 20, 20), -0.5)).mean(dim=(2, 3))
        torch.testing.assert_close(network(torch.full((1, 3, 20, 20), 0.25)), network.head(inside))


def test_a_plain_colour_has_one_code_at_every_size():
    """Reflected borders see the same colour; zeros around the photo would not."""
    torch.manual_seed(0)
    network, colour = ReleasedCode(), torch.tensor([0.2, 0.9, 0.4]).view(1, 3, 1, 1)
    with torch.no_grad():
        small, large = (network(colour.expand(1, 3, *size)) for size in ((16, 16), (40, 23)))
    torch.testing.assert_close(small, large, atol=1e-6, rtol=1e-5)


def test_the_mean_is_over_all_cells():
    """Where in the photo a colour is does not matter to the layers behind the mean."""
    torch.manual_seed(0)
    network = ReleasedCode()
    network.layers = torch.nn.Identity()
    network.head = torch.nn.Identity()
    images = photos()
    torch.testing.assert_close(network(images), 2 * images.flatten(2).mean(-1) - 1)


@pytest.mark.parametrize("shape", [(1, 3, 15, 40), (1, 3, 40, 15), (1, 4, 20, 20), (3, 20, 20)])
def test_what_is_no_photo_is_refused(shape):
    with pytest.raises(ValueError, match=r"h, w >= 16, not \(" + ", ".join(map(str, shape))):
        ReleasedCode()(torch.zeros(shape))


def test_gradients_reach_everything(network):
    images = photos().requires_grad_()
    network(images).square().sum().backward()
    for name, value in [*network.named_parameters(), ("images", images)]:
        assert value.grad is not None, name
        assert value.grad.abs().sum() > 0, name


def test_compact_codes_are_bounded_and_share_the_encoder_s_convolutions():
    torch.manual_seed(0)
    network, encoder = CompactCode(), CompactEncoder(5)
    ours, theirs = network.layers.state_dict(), encoder.layers.state_dict()
    assert len(ours) == 6
    assert all(theirs[name].shape == value.shape for name, value in ours.items())
    for parameter in network.parameters():
        parameter.data *= 3
    codes = network(photos())
    assert codes.abs().max() <= 1
    assert codes.std() > 0.1


def released_network(vectors: dict) -> ReleasedCode:
    network = ReleasedCode()
    load_released(network, under(vectors, "param/enc_a."), CODE_NETWORK)
    return network


@pytest.mark.real
def test_golden_hanerf_codes(golden):
    vectors = golden("hanerf")
    network = released_network(vectors)
    for name in ("a", "b"):
        with torch.no_grad():
            code = network((vectors[f"in/image_{name}"] + 1) / 2)
        torch.testing.assert_close(code, vectors[f"out/code_{name}"], atol=2e-5, rtol=0)


@pytest.mark.real
def test_golden_hanerf_fine_network(golden):
    vectors = golden("hanerf")
    field = RadianceMLP(3, code_channels=CODE)
    load_released(field, under(vectors, "param/nerf_fine."), NERF_MLP)
    for code, rgb in (("code_a", "rgb"), ("code_b", "rgb_random")):
        with torch.no_grad():
            density, colours = field(vectors["in/xyz"], vectors["in/dir"], vectors[f"out/{code}"])
        torch.testing.assert_close(density, vectors["out/sigma"], atol=2e-5, rtol=0)
        torch.testing.assert_close(colours, vectors[f"out/{rgb}"], atol=2e-5, rtol=0)


@pytest.mark.real
def test_golden_hanerf_rendering(golden):
    vectors = golden("hanerf")
    samples, t = vectors["in/render/fine_samples"], vectors["in/render/z_vals_fine"]
    weights = render_weights(samples[..., 3], intervals(t))
    rendered = {
        "weights_fine": weights,
        "opacity_fine": weights.sum(-1),
        "rgb_fine": composite(weights, samples[..., :3]),
        "depth_fine": (weights * t).sum(-1),
        "rgb_fine_random": composite(weights, samples[..., 4:]),
    }
    for name, value in rendered.items():
        torch.testing.assert_close(value, vectors[f"out/render/{name}"], atol=2e-5, rtol=0, msg=name)


@pytest.mark.real
def test_golden_hanerf_losses(golden):
    vectors = golden("hanerf")
    inputs, expected = under(vectors, "in/loss/"), under(vectors, "out/loss/step_1000/")
    weights, mask = LossWeights(), inputs["out_mask"].squeeze(-1)
    code, other = inputs["a_embedded"], inputs["a_embedded_random"]
    terms = {
        "c_l": weights.photometric * photometric(inputs["rgb_coarse"], inputs["targets"], mask),
        "f_l": weights.photometric * photometric(inputs["rgb_fine"], inputs["targets"], mask),
        "r_ms": weights.mask_weight(1000) * mask_size(mask),
        "kl_a": weights.embedding * embedding_size(code),
        "rec_a_random": weights.appearance
        * appearance_consistency(other, inputs["a_embedded_random_rec"], weights.appearance_target),
        "mode_seeking": weights.mode_seeking * mode_seeking(inputs["rgb_fine"], inputs["rgb_fine_random"], code, other),
    }
    for name, value in terms.items():
        assert abs(value.item() - expected[name].item()) < 1e-8, name
    assert expected["r_md"] == 0
    assert abs(sum(terms.values()).item() - expected["total"].item()) < 3e-8
