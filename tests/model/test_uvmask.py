"""Ha-NeRF's mask: who and where, number by number, and against the released numbers."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from model.methods import VIEW_CODE
from model.released import UV_MASK, load_released, under
from model.transient.uvmask import UVMask


@pytest.fixture
def mask():
    torch.manual_seed(0)
    return UVMask(photos=4)


def some_pixels(patches: int = 2, count: int = 7) -> Tensor:
    return torch.rand(patches, count, 2, generator=torch.Generator().manual_seed(1))


def test_the_network_has_the_released_size():
    assert sum(p.numel() for p in UVMask(7).parameters()) == 241_409 + 7 * VIEW_CODE


def test_it_reads_the_photo_s_embedding_then_the_encoded_place(mask):
    """Pixel by pixel, with the input written out."""
    photo, uv = torch.tensor([2, 0]), some_pixels()
    expected = torch.empty(2, 7)
    with torch.no_grad():
        for p in range(2):
            for n in range(7):
                row, column = uv[p, n].tolist()
                inputs = [*mask.embedding.weight[photo[p]].tolist(), row, column]
                for k in range(10):
                    inputs += [f(2**k * x) for f in (math.sin, math.cos) for x in (row, column)]
                assert len(inputs) == 128 + 42
                h = torch.tensor(inputs)
                for i in (0, 2, 4, 6):
                    h = (mask.layers[i].weight @ h + mask.layers[i].bias).clamp(min=0)
                logit = (mask.layers[8].weight @ h + mask.layers[8].bias).item()
                expected[p, n] = 1 / (1 + math.exp(-logit))
        out = mask(photo, uv)
    assert out.shape == (2, 7)
    torch.testing.assert_close(out, expected, atol=1e-5, rtol=0)


def test_masks_are_probabilities_of_one_photo_each(mask):
    mask.layers[-1].weight.data *= 100
    uv = some_pixels(1).expand(2, 7, 2)
    out = mask(torch.tensor([1, 3]), uv)
    assert ((out > 0) & (out < 1)).all()
    assert not torch.allclose(out[0], out[1])
    torch.testing.assert_close(mask(torch.tensor([3]), uv[1:])[0], out[1])


def test_the_order_of_pixels_does_not_matter(mask):
    photo, uv = torch.tensor([1, 1]), some_pixels()
    order = torch.randperm(7, generator=torch.Generator().manual_seed(2))
    torch.testing.assert_close(mask(photo, uv[:, order]), mask(photo, uv)[:, order])


def test_a_photo_s_errors_teach_its_own_embedding_and_what_all_share(mask):
    mask(torch.tensor([2]), some_pixels(1)).sum().backward()
    rows = mask.embedding.weight.grad.abs().sum(-1)
    assert (rows > 0).tolist() == [False, False, True, False]
    assert all(p.grad.abs().sum() > 0 for p in mask.layers.parameters())


@pytest.mark.real
def test_golden_hanerf_mask(golden):
    vectors = golden("hanerf")
    embeddings, uv = vectors["in/view_embedding"], vectors["in/uv"]
    mask = UVMask(photos=len(embeddings))
    load_released(mask.layers, under(vectors, "param/implicit_mask."), UV_MASK)
    mask.embedding.weight.data.copy_(embeddings)  # one for each pixel here
    with torch.no_grad():
        out = mask(torch.arange(len(uv)), uv[:, None])
    torch.testing.assert_close(out, vectors["out/mask"], atol=2e-5, rtol=0)
