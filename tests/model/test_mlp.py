"""Positional encoding and the MLP field."""

from __future__ import annotations

import math

import pytest
import torch

from model.encoding import positional_encoding
from model.fields.mlp import RadianceMLP
from model.released import NERF_MLP, load_released, under


def test_encoding_of_known_angles_in_the_references_order():
    v = torch.tensor([[math.pi / 2, math.pi]])
    expected = [math.pi / 2, math.pi, 1, 0, 0, -1, 0, 0, -1, 1]  # v, sin v, cos v, sin 2v, cos 2v
    torch.testing.assert_close(positional_encoding(v, 2), torch.tensor([expected]), atol=1e-6, rtol=0)


def test_encoding_keeps_leading_dimensions_and_works_without_frequencies():
    v = torch.rand(4, 5, 3)
    assert positional_encoding(v, 15).shape == (4, 5, 93)
    assert torch.equal(positional_encoding(v, 0), v)


def test_the_field_has_the_released_size():
    assert sum(p.numel() for p in RadianceMLP().parameters()) == 619_073


def test_shapes_and_ranges():
    torch.manual_seed(0)
    field = RadianceMLP(out_channels=5, width=16)
    density, features = field(torch.randn(3, 7, 3), torch.randn(3, 7, 3))
    assert density.shape == (3, 7)
    assert features.shape == (3, 7, 5)
    assert (density > 0).all()
    assert ((features > 0) & (features < 1)).all()


def test_one_direction_serves_all_samples_of_its_ray():
    torch.manual_seed(0)
    field = RadianceMLP(out_channels=5, width=16)
    xyz, direction = torch.randn(3, 7, 3), torch.randn(3, 1, 3)
    density, features = field(xyz, direction)
    density_each, features_each = field(xyz, direction.expand(3, 7, 3))
    torch.testing.assert_close(density, density_each)
    torch.testing.assert_close(features, features_each)


def test_density_is_the_same_from_every_direction_and_features_are_not():
    torch.manual_seed(0)
    field = RadianceMLP(width=16)
    xyz = torch.randn(4, 3)
    density, features = field(xyz, torch.tensor([0.0, 0.0, 1.0]))
    density_other, features_other = field(xyz, torch.tensor([1.0, 0.0, 0.0]))
    assert torch.equal(density, density_other)
    assert not torch.allclose(features, features_other)


def test_the_skip_layer_sees_the_encoding_in_front():
    field = RadianceMLP(width=4, depth=3, skip=2, xyz_frequencies=0)
    assert [tuple(layer.weight.shape) for layer in field.layers] == [(4, 3), (4, 4), (4, 7)]
    with torch.no_grad():
        for parameter in field.parameters():
            parameter.zero_()
        field.layers[2].weight[0, 1] = 1.0
    assert field.trunk(torch.tensor([[5.0, 6.0, 7.0]])).tolist() == [[6.0, 0.0, 0.0, 0.0]]


@pytest.mark.real
def test_golden_posenc(golden):
    vectors = golden("posenc")
    for name, frequencies in (("xyz", 15), ("dir", 4), ("uv", 10)):
        encoded = positional_encoding(vectors[f"in/{name}"], frequencies)
        torch.testing.assert_close(encoded, vectors[f"out/{name}_embedded"], atol=2e-6, rtol=0)


@pytest.mark.real
def test_golden_nerf_mlp(golden):
    vectors = golden("nerf_mlp")
    field = RadianceMLP()
    load_released(field, under(vectors, "param/"), NERF_MLP)
    with torch.no_grad():
        density, features = field(vectors["in/xyz"], vectors["in/dir"])
    torch.testing.assert_close(density, vectors["out/sigma"], atol=2e-5, rtol=0)
    torch.testing.assert_close(features, vectors["out/feature"], atol=2e-5, rtol=0)
