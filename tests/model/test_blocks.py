"""Blocks of rays, layers that read two things, references read once: the same numbers by a cheaper way."""

from __future__ import annotations

import pytest
import torch
from torch import nn
from torch.nn import functional as F

from model.appearance.compact import at_size
from model.fields import base
from model.fields.mlp import RadianceMLP, joined
from model.methods import ModelSpec
from model.scene_model import COMPACT_SIZE, as_read


@pytest.mark.parametrize("coded", [False, True])
def test_blocks_give_the_numbers_and_gradients_of_the_whole(monkeypatch, coded):
    torch.manual_seed(0)
    mlp = RadianceMLP(5, width=16, depth=3, skip=1, code_channels=4 if coded else 0).double()
    xyz = torch.randn(7, 6, 3, dtype=torch.float64, requires_grad=True)
    direction = F.normalize(torch.randn(7, 1, 3, dtype=torch.float64), dim=-1)
    code = torch.randn(7, 1, 4, dtype=torch.float64, requires_grad=True) if coded else None
    found = []
    for points in (10**6, 12):  # 12: two rays at a time, and one that is left
        monkeypatch.setattr(base, "BLOCK_POINTS", points)
        monkeypatch.setattr(torch, "get_num_threads", lambda: 1)
        calls = []
        network = lambda *x, calls=calls: calls.append(len(x[0])) or mlp(*x)  # noqa: E731
        density, features = base.in_blocks(network, xyz, direction, code)
        assert calls == ([7] if points > 12 else [2, 2, 2, 1])
        wanted = [xyz, *mlp.parameters(), *([code] if coded else [])]
        found.append([density, features, *torch.autograd.grad((density.sum() + features.square().sum()), wanted)])
    for whole, blocks in zip(*found, strict=True):
        torch.testing.assert_close(blocks, whole, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("swapped", [False, True])
def test_a_layer_of_two_parts_is_the_layer_of_both_beside_each_other(swapped):
    torch.manual_seed(0)
    layer = nn.Linear(7, 4).double()
    point, ray = torch.randn(5, 6, 4 if swapped else 3).double(), torch.randn(5, 1, 3 if swapped else 4).double()
    a, b = (ray, point) if swapped else (point, ray)
    both = torch.cat([x.expand(5, 6, -1) for x in (a, b)], dim=-1)
    torch.testing.assert_close(joined(layer, a, b), layer(both), rtol=1e-12, atol=1e-12)


def test_references_are_reduced_where_all_networks_read_one_size():
    photos = [torch.rand(3, 70, 101), torch.rand(3, *COMPACT_SIZE)]
    compact = ModelSpec(field="hash", encoder="compact", segmenter="unet")
    reduced = as_read(compact, photos)
    assert torch.equal(torch.stack(reduced), at_size(photos, COMPACT_SIZE))
    assert torch.equal(reduced[1], photos[1])
    assert as_read(ModelSpec(encoder="compact", segmenter="cgnet", transient="segmenter"), photos) is photos
    assert as_read(ModelSpec(encoder="released", segmenter="unet"), photos) is photos
    assert as_read(compact, []) == []
