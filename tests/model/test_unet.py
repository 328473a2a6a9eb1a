"""The small segmenter: sizes, its start, and that its masks are as fine as its input."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn import functional as F

from model.transient.unet import INITIAL_LOGIT, UNet


def trained_looking(width: int = 8) -> UNet:
    torch.manual_seed(0)
    net = UNet(width)
    torch.nn.init.normal_(net.out.weight)
    return net


@settings(deadline=None, max_examples=15)
@given(h=st.integers(2, 20), w=st.integers(2, 20))
def test_logits_have_the_size_of_the_photo(h, w):
    with torch.no_grad():
        logits = UNet(4)(torch.rand(2, 3, 2 * h, 2 * w))
    assert logits.shape == (2, 1, 2 * h, 2 * w)
    assert logits.isfinite().all()


def test_nearly_nothing_is_transient_at_the_start():
    with torch.no_grad():
        logits = UNet()(torch.rand(1, 3, 16, 24))
    assert (logits == INITIAL_LOGIT).all()
    assert torch.sigmoid(logits).max() < 0.15


def test_training_and_evaluation_are_one_function_and_photos_do_not_mix():
    net, images = trained_looking(), torch.rand(3, 3, 16, 24)
    with torch.no_grad():
        together = net.train()(images)
        torch.testing.assert_close(net.eval()(images), together)
        for i in range(3):
            torch.testing.assert_close(net(images[i : i + 1])[0], together[i], atol=1e-5, rtol=1e-5)
    assert together.std() > 0.1


def test_gradients_reach_everything():
    net = trained_looking()
    net(torch.rand(1, 3, 16, 24)).square().sum().backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.abs().sum() > 0, name


@pytest.mark.slow
def test_it_learns_a_mask_of_single_pixels():
    """Pixels enter and leave in groups of four; a mask may still differ from pixel to pixel."""
    torch.manual_seed(0)
    net, image = UNet(8), torch.rand(1, 3, 8, 12)
    mask = (image[:, :1] > 0.5).float()
    optimiser = torch.optim.Adam(net.parameters(), lr=0.03)
    for _ in range(80):
        loss = F.binary_cross_entropy_with_logits(net(image), mask)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    with torch.no_grad():
        right = ((net(image) > 0) == (mask > 0.5)).float().mean()
    assert right > 0.95


@pytest.mark.parametrize("shape", [(1, 3, 15, 24), (1, 3, 16, 23), (3, 16, 24)])
def test_a_shape_that_does_not_fit_is_named(shape):
    sides = ", ".join(str(n) for n in shape)
    with pytest.raises(ValueError, match=sides):
        UNet(4)(torch.rand(shape))
