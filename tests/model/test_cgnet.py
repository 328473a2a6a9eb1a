"""The transient segmenter."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from model.released import CGNET, load_released, under
from model.transient.cgnet import CGNet, Gate, transient_probability


def test_the_segmenter_has_the_released_size():
    assert sum(p.numel() for p in CGNet().parameters()) == 257_714


@pytest.mark.parametrize(("size", "logit"), [((96, 136), (12, 17)), ((46, 62), (6, 8)), ((85, 128), (11, 16))])
def test_the_logit_is_an_eighth_rounded_up(size, logit):
    assert CGNet()(torch.rand(2, 3, *size)).shape == (2, 1, *logit)


def test_a_wrong_shape_is_named():
    with pytest.raises(ValueError, match=r"\(1, 1, 32, 32\)"):
        CGNet()(torch.rand(1, 1, 32, 32))


def test_more_blocks_can_be_asked_for():
    net = CGNet(blocks2=3, blocks3=21)
    assert (len(net.stage2), len(net.stage3)) == (2, 20)
    assert net(torch.rand(1, 3, 40, 40)).shape == (1, 1, 5, 5)


def test_probability_has_the_asked_size_and_follows_the_logit():
    logit = torch.tensor([[[[-20.0, 20.0], [-20.0, 20.0]]]])
    probability = transient_probability(logit, (30, 40))
    assert probability.shape == (1, 1, 30, 40)
    assert probability.min() >= 0
    assert probability.max() <= 1
    assert probability[..., 0].max() < 1e-3
    assert probability[..., -1].min() > 0.999
    even = transient_probability(torch.zeros(1, 1, 3, 5), (7, 9))
    torch.testing.assert_close(even, torch.full((1, 1, 7, 9), 0.5))


def test_the_sigmoid_comes_before_the_resize():
    """As released: the mean of sigmoids. The sigmoid of the mean would be 0.003 larger here."""
    logit = torch.tensor([[[[-10.0, 20.0]]]])
    enlarged = nn.functional.interpolate(logit, scale_factor=8, mode="bilinear", align_corners=False).sigmoid()
    # One output pixel samples the middle of the enlarged row: between its 8th and 9th value, and rows are
    # equal.
    expected = 0.5 * (enlarged[0, 0, 0, 7] + enlarged[0, 0, 0, 8])
    torch.testing.assert_close(transient_probability(logit, (1, 1))[0, 0, 0, 0], expected)


def test_the_logit_is_enlarged_to_the_size_that_was_seen():
    logit = torch.randn(1, 1, 6, 8, generator=torch.Generator().manual_seed(0))
    expected = nn.functional.interpolate(logit, size=(46, 62), mode="bilinear", align_corners=False).sigmoid()
    torch.testing.assert_close(transient_probability(logit, (46, 62), seen=(46, 62)), expected)
    assert torch.equal(transient_probability(logit, (9, 9)), transient_probability(logit, (9, 9), seen=(48, 64)))


def test_the_gate_by_hand():
    gate = Gate(2)
    with torch.no_grad():
        for parameter in gate.parameters():
            parameter.zero_()
        gate.squeeze.weight[0] = torch.tensor([1.0, 1.0])
        gate.excite.weight[1, 0] = 1.0
    x = torch.tensor([[[[1.0, 3.0]], [[-4.0, 4.0]]]])  # means 2 and 0, so the hidden unit is 2
    out = gate(x)
    torch.testing.assert_close(out[0, 0], x[0, 0] * 0.5)
    torch.testing.assert_close(out[0, 1], x[0, 1] * torch.sigmoid(torch.tensor(2.0)))


def test_gradients_reach_everything():
    torch.manual_seed(0)
    net = CGNet()
    transient_probability(net(torch.rand(1, 3, 64, 64)), (64, 64)).mean().backward()
    assert [name for name, p in net.named_parameters() if p.grad is None] == []


@pytest.mark.real
@pytest.mark.parametrize("mode", ["eval", "train"])
def test_golden_segmenter(golden, mode):
    vectors = golden("segmenter")
    net = CGNet()
    load_released(net, under(vectors, "param/"), CGNET)
    net.train(mode == "train")
    stages: dict[str, torch.Tensor] = {}
    for name, module, channels in (
        ("stage1", net.stage1, slice(None, None, 16)),
        ("stage2", net.join2, slice(None, None, 4)),
        ("stage3", net.join3, slice(None, None, 4)),
    ):
        module.register_forward_hook(
            lambda _, __, out, name=name, channels=channels: stages.update({name: out[:, channels]})
        )
    with torch.no_grad():
        logit = net(vectors["in/image"])
    values = stages | {
        "logit_eighth": logit,
        "probability": transient_probability(logit, (96, 136)),
        "probability_resized": transient_probability(logit, (192, 272)),
    }
    for name, value in values.items():
        expected = vectors[f"out/{mode}/{name}"]
        torch.testing.assert_close(value, expected, atol=3e-5, rtol=0, msg=lambda m, name=name: f"{name}: {m}")

    buffers = dict(net.named_buffers())
    before = under(vectors, "param/")
    after = before | under(vectors, "out/train/buffer/") if mode == "train" else before
    for theirs, ours in CGNET.items():
        if ours in buffers:
            expected = after[theirs].to(buffers[ours].dtype)
            torch.testing.assert_close(buffers[ours], expected, atol=1e-5, rtol=0)
