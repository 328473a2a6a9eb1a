"""The transient head, and NeRF-W as a whole against the numbers of nerf_pl."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from model.fields.base import Level, TransientSamples, transient_samples
from model.fields.mlp import RadianceMLP
from model.losses import LossWeights, log_uncertainty, photometric, uncertain_photometric
from model.methods import CODE, TRANSIENT_CODE
from model.released import NERF_MLP, TRANSIENT_HEAD, load_released, under
from model.transient.uncertainty import Transient, TransientHead
from model.volume import composite, intervals, render_weights


def inputs(channels: int = 6) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    return (
        torch.randn(4, 5, channels, generator=generator),
        torch.randn(4, 1, TRANSIENT_CODE, generator=generator),
    )


def head(rgb: bool = True, **sizes: float) -> TransientHead:
    torch.manual_seed(0)
    return TransientHead(6, 3, rgb, width=8, depth=2, **sizes)


def test_the_head_has_the_size_of_nerf_pl_s():
    # (256 + 16) 128 + 128, three times 128^2 + 128, and 1 + 3 + 1 outputs of 128 + 1 each
    assert sum(p.numel() for p in TransientHead(256, 3, bounded=True).parameters()) == 34_944 + 49_536 + 645


def test_one_unit_by_hand():
    small = TransientHead(1, 2, bounded=False, width=1, depth=1)
    for parameter in small.parameters():
        parameter.data.zero_()
    small.layers[0].weight.data[0, :3] = torch.tensor([2.0, 1.0, -1.0])  # the bottleneck, then the code
    small.density.weight.data[:] = 1.0
    small.beta.weight.data[:] = -1.0
    small.features.weight.data[:, 0] = torch.tensor([3.0, -3.0])
    code = torch.zeros(2, TRANSIENT_CODE)
    code[:, 1] = 0.5
    density, features, beta = small(torch.tensor([[1.0], [-1.0]]), code)  # h = relu(2 x - 0.5) = 1.5 and 0
    expected = [[math.log(1 + math.exp(sign * h)) for h in (1.5, 0.0)] for sign in (1, -1)]
    torch.testing.assert_close(density, torch.tensor(expected[0]))
    torch.testing.assert_close(beta, torch.tensor(expected[1]))
    assert features.tolist() == [[4.5, -4.5], [0.0, 0.0]]


def test_shapes_and_ranges():
    bottleneck, code = inputs()
    density, features, beta = head()(3 * bottleneck, code)
    assert (density.shape, features.shape, beta.shape) == ((4, 5), (4, 5, 3), (4, 5))
    assert (density > 0).all()
    assert (beta > 0).all()
    assert ((features > 0) & (features < 1)).all()


def test_only_colours_are_bounded():
    bottleneck, code = inputs()
    bounded, free = head(rgb=True)(bottleneck, code), head(rgb=False)(bottleneck, code)
    assert free.features.min() < 0
    torch.testing.assert_close(bounded.features, free.features.sigmoid())
    torch.testing.assert_close(bounded.density, free.density)


def test_one_code_serves_all_samples_of_its_ray():
    bottleneck, code = inputs()
    together = head()(bottleneck, code)
    torch.testing.assert_close(together, head()(bottleneck, code.expand(4, 5, -1)))
    assert not torch.allclose(together.density, head()(bottleneck, code + 1).density)


def test_the_bias_moves_the_density_before_its_softplus_and_nothing_else():
    bottleneck, code = inputs()
    plain, thin = head()(bottleneck, code), head(density_bias=-5.0)(bottleneck, code)
    raw = torch.log(torch.expm1(plain.density))
    torch.testing.assert_close(thin.density, torch.log1p(torch.exp(raw - 5)), atol=1e-6, rtol=1e-4)
    torch.testing.assert_close((thin.features, thin.beta), (plain.features, plain.beta))


def test_gradients_reach_everything():
    bottleneck, code = (value.requires_grad_() for value in inputs())
    module = head()
    sum(value.square().sum() for value in module(bottleneck, code)).backward()
    for name, value in [*module.named_parameters(), ("bottleneck", bottleneck), ("code", code)]:
        assert value.grad is not None, name
        assert value.grad.abs().sum() > 0, name


@pytest.mark.real
def test_golden_nerfw_heads(golden):
    vectors = golden("nerfw")
    weights = under(vectors, "param/")
    static = RadianceMLP(3, code_channels=CODE)
    transient = TransientHead(256, 3, bounded=True)
    for module, names in ((static, NERF_MLP), (transient, TRANSIENT_HEAD)):
        load_released(module, {name: value for name, value in weights.items() if name in names}, names)
    assert weights.keys() == NERF_MLP.keys() | TRANSIENT_HEAD.keys()
    with torch.no_grad():
        density, rgb = static(vectors["in/xyz"], vectors["in/dir"], vectors["in/appearance"])
        found = transient(static.bottleneck(static.trunk(vectors["in/xyz"])), vectors["in/transient"])
    values = {
        "static_sigma": density,
        "static_rgb": rgb,
        "transient_sigma": found.density,
        "transient_rgb": found.features,
        "transient_beta": found.beta,
    }
    for name, value in values.items():
        torch.testing.assert_close(value, vectors[f"out/{name}"], atol=2e-5, rtol=0, msg=name)


def both_fields(samples: dict) -> tuple[Level, TransientSamples]:
    """The fine level of nerf_pl's rendering, and the transient samples at its points."""
    t = samples["z_vals_fine"]
    static = Level(t, render_weights(samples["static_sigma"], intervals(t)), samples["static_rgb"])
    head = Transient(samples["transient_sigma"], samples["transient_rgb"], samples["transient_beta"])
    return static, transient_samples(head, samples["static_sigma"], intervals(t))


@pytest.mark.real
def test_golden_nerfw_compositing(golden):
    vectors = golden("nerfw")
    samples = under(vectors, "in/render/")
    static, both = both_fields(samples)
    weights = render_weights(samples["static_sigma"] + samples["transient_sigma"], intervals(static.t))
    rendered = {
        "weights_fine": weights,
        "opacity_fine": weights.sum(-1),
        "depth_fine": (weights * static.t).sum(-1),
        "joint_rgb_fine_static": composite(both.static_weights, static.features),
        "joint_rgb_fine_transient": composite(both.weights, both.features),
        "rgb_fine": both.composite(static),
        "beta": both.uncertainty() + LossWeights().beta_min,
    }
    assert samples["beta_min"].item() == pytest.approx(LossWeights().beta_min)
    for name, value in rendered.items():
        torch.testing.assert_close(value, vectors[f"out/render/{name}"], atol=2e-5, rtol=0, msg=name)


@pytest.mark.real
def test_golden_nerfw_coarse_level(golden):
    vectors = golden("nerfw")
    t, samples = vectors["in/render/z_vals_coarse"], vectors["in/render/coarse_samples"]
    weights = render_weights(samples[..., 3], intervals(t))
    rendered = Level(t, weights, samples[..., :3]).composite()
    values = (weights, rendered.accumulation, rendered.features, rendered.depth)
    for name, value in zip(("weights", "opacity", "rgb", "depth"), values, strict=True):
        torch.testing.assert_close(value, vectors[f"out/render/{name}_coarse"], atol=2e-5, rtol=0, msg=name)


@pytest.mark.real
def test_golden_nerfw_at_test_time_each_field_is_alone(golden):
    vectors = golden("nerfw")
    samples = under(vectors, "in/render/")
    t = samples["z_vals_fine"]
    for kind in ("static", "transient"):
        weights = render_weights(samples[f"{kind}_sigma"], intervals(t))
        rendered = Level(t, weights, samples[f"{kind}_rgb"]).composite()
        for name, value in (("rgb", rendered.features), ("depth", rendered.depth)):
            expected = vectors[f"out/render_test/{name}_fine_{kind}"]
            torch.testing.assert_close(value, expected, atol=2e-5, rtol=0, msg=f"{name} {kind}")


@pytest.mark.real
def test_golden_nerfw_loss_and_gradients(golden):
    vectors = golden("nerfw")
    samples = under(vectors, "in/render/")
    names = ("static_rgb", "static_sigma", "transient_rgb", "transient_sigma", "transient_beta")
    for name in names:
        if name.endswith("sigma"):  # our densities pass a ReLU, without gradient at exactly 0, which no softplus gives
            samples[name] = samples[name].clamp(min=1e-12)
        samples[name].requires_grad_()
    static, both = both_fields(samples)
    target, weights = vectors["in/loss/targets"], LossWeights()
    beta = both.uncertainty() + weights.beta_min
    terms = {
        "c_l": weights.photometric * photometric(vectors["out/render/rgb_coarse"], target, None),
        "f_l": weights.photometric * uncertain_photometric(both.composite(static), target, beta),
        "b_l": log_uncertainty(beta),
        "s_l": weights.transient_density * both.density.mean(),
    }
    for name, value in terms.items():
        torch.testing.assert_close(value, vectors[f"out/loss/{name}"], atol=2e-5, rtol=2e-5, msg=name)
    total = sum(terms.values())
    torch.testing.assert_close(total, vectors["out/loss/total"], atol=2e-5, rtol=2e-5)

    total.backward()
    parts = [samples[name].grad for name in names]
    ours = torch.cat([part if part.ndim == 3 else part[..., None] for part in parts], dim=-1)
    expected = vectors["grad/render/fine_samples"]
    for channel in range(9):
        error = (ours - expected)[..., channel].abs().max() / expected[..., channel].abs().max()
        assert error < 1e-4, channel
