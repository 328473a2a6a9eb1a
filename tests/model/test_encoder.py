"""The released encoder of appearance and content."""

from __future__ import annotations

import pytest
import torch

from model.appearance.encoder import ReleasedEncoder
from model.released import ENCODER, load_released, under


def test_the_encoder_has_the_released_size():
    assert sum(p.numel() for p in ReleasedEncoder().parameters()) == 416_012


@pytest.mark.parametrize("size", [(8, 8), (9, 31), (40, 33)])
def test_any_size_gives_32_by_32(size):
    assert ReleasedEncoder()(torch.rand(2, 3, *size)).shape == (2, 64, 32, 32)


def test_a_patch_of_32_is_64_cells_replicated():
    torch.manual_seed(0)
    embedding = ReleasedEncoder()(torch.rand(1, 3, 32, 32))
    cells = embedding[:, :, ::4, ::4].repeat_interleave(4, dim=2).repeat_interleave(4, dim=3)
    assert torch.equal(embedding, cells)
    assert embedding.flatten(2).unique(dim=2).shape[2] == 64


def test_borders_are_reflected_so_an_even_image_stays_even():
    torch.manual_seed(0)
    embedding = ReleasedEncoder()(torch.full((1, 3, 40, 40), 0.7))
    torch.testing.assert_close(embedding, embedding[..., 16:17, 16:17].expand_as(embedding))


@pytest.mark.parametrize("shape", [(1, 3, 7, 20), (1, 4, 20, 20), (3, 20, 20)])
def test_a_wrong_shape_is_named(shape):
    with pytest.raises(ValueError, match=r"not \(" + ", ".join(map(str, shape))):
        ReleasedEncoder()(torch.rand(shape))


@pytest.mark.real
def test_golden_appearance_encoder(golden):
    vectors = golden("appearance_encoder")
    encoder = ReleasedEncoder()
    load_released(encoder, under(vectors, "param/"), ENCODER)
    with torch.no_grad():
        for image in ("a", "b"):
            embedding = encoder(vectors[f"in/image_{image}"])
            torch.testing.assert_close(embedding, vectors[f"out/embedding_{image}"], atol=2e-5, rtol=0)
