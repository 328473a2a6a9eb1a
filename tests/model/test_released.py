"""Reading released state dicts: whole, or refused with every reason."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from model.appearance.code import ReleasedCode
from model.appearance.crossray import AffineDecoder, ReleasedTransform
from model.appearance.encoder import ReleasedEncoder
from model.fields.mlp import RadianceMLP
from model.released import (
    CGNET,
    CODE_NETWORK,
    DECODER,
    ENCODER,
    NERF_MLP,
    TRANSFORM,
    TRANSIENT_HEAD,
    UV_MASK,
    load_released,
    under,
)
from model.transient.cgnet import CGNet
from model.transient.uncertainty import TransientHead
from model.transient.uvmask import UVMask


@pytest.mark.parametrize(
    ("module", "names"),
    [
        (RadianceMLP, NERF_MLP),
        (ReleasedEncoder, ENCODER),
        (ReleasedTransform, TRANSFORM),
        (AffineDecoder, DECODER),
        (CGNet, CGNET),
        (ReleasedCode, CODE_NETWORK),
        (lambda: UVMask(photos=3).layers, UV_MASK),
        (lambda: TransientHead(256, 3, bounded=True), TRANSIENT_HEAD),
    ],
)
def test_a_map_covers_its_module_and_loads(module, names):
    torch.manual_seed(0)
    source, target = module(), module()
    ours = source.state_dict()
    assert sorted(names.values()) == sorted(ours)
    load_released(target, {theirs: ours[name] for theirs, name in names.items()}, names)
    for name, value in target.state_dict().items():
        assert torch.equal(value, ours[name]), name


def decoder_state() -> dict[str, torch.Tensor]:
    return {
        "feat_2_rgb_list.0.weight": torch.arange(192.0).view(3, 64, 1, 1),
        "feat_2_rgb_list.0.bias": torch.ones(3),
        "rgb_upsample.1.f": torch.ones(3),
    }


def test_a_pointwise_kernel_fills_a_linear_layer_and_the_unused_blur_is_ignored():
    decoder = AffineDecoder()
    load_released(decoder, decoder_state(), DECODER)
    assert torch.equal(decoder.linear.weight, torch.arange(192.0).view(3, 64))


def test_every_problem_is_named_and_nothing_is_loaded():
    decoder = AffineDecoder()
    before = {name: value.clone() for name, value in decoder.state_dict().items()}
    state = decoder_state() | {
        "feat_2_rgb_list.0.weight": torch.zeros(3, 64, 3, 3),
        "extra.weight": torch.ones(1),
    }
    del state["feat_2_rgb_list.0.bias"]
    with pytest.raises(ValueError, match="AffineDecoder") as caught:
        load_released(decoder, state, DECODER)
    message = str(caught.value)
    assert "unknown: extra.weight" in message
    assert "missing: feat_2_rgb_list.0.bias" in message
    assert "feat_2_rgb_list.0.weight has shape (3, 64, 3, 3), linear.weight needs (3, 64)" in message
    for name, value in decoder.state_dict().items():
        assert torch.equal(value, before[name])


def test_a_map_that_leaves_a_parameter_unfilled_is_refused():
    state = {"w": torch.zeros(2, 2)}
    with pytest.raises(ValueError, match="left unfilled in our module: bias"):
        load_released(nn.Linear(2, 2), state, {"w": "weight"})


def test_a_map_of_another_module_is_refused():
    state = {"w": torch.zeros(2, 2), "b": torch.zeros(2)}
    with pytest.raises(ValueError, match="not in our module: offset"):
        load_released(nn.Linear(2, 2), state, {"w": "weight", "b": "offset"})


def test_under_strips_the_prefix():
    state = {"decoder.a": torch.ones(1), "other.a": torch.zeros(1)}
    assert list(under(state, "decoder.")) == ["a"]
