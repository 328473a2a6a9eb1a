"""Every row of the table can be built and trained, and what does not fit together is refused."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from small_models import BOX, HASH, MLP, ROWS, small_batch, small_model, small_spec

from model.losses import LossWeights
from model.methods import METHODS, ModelSpec, check_spec
from model.scene_model import SceneModel

APPEARANCE = {"embedding", "appearance", "content"}
TERMS = {
    "nerf": {"fine", "coarse"},
    "crnerf-b": {"fine", "coarse"},
    "crnerf-a": {"fine", "coarse"} | APPEARANCE,
    "crnerf-t": {"fine", "coarse", "mask"},
    "crnerf": {"fine", "coarse", "mask"} | APPEARANCE,
    "crossray": {"fine", "interlevel", "mask"} | APPEARANCE,
    "crossray-compact": {"fine", "interlevel", "mask"} | APPEARANCE,
}


def seeded() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def test_the_table_is_that_of_the_paper():
    choices = {name: tuple(method.axes().values()) for name, method in METHODS.items()}
    assert choices == {
        "nerf": ("mlp", "head", "none", "none"),
        "crnerf-b": ("mlp", "decoder", "none", "none"),
        "crnerf-a": ("mlp", "decoder", "crossray", "none"),
        "crnerf-t": ("mlp", "decoder", "none", "segmenter"),
        "crnerf": ("mlp", "decoder", "crossray", "segmenter"),
        "crossray": ("hash", "decoder", "crossray", "segmenter"),
    }
    names = {field.name for field in dataclasses.fields(ModelSpec)}
    for method in METHODS.values():
        assert method.axes().keys() <= names
        check_spec(ModelSpec(**method.axes()))


@pytest.mark.parametrize("row", ROWS)
def test_each_row_trains(row):
    """One step: the terms that the row has, finite, and a gradient for every parameter."""
    model = small_model(row)
    if row.startswith("crossray"):
        model.field.proposal[-1].bias.data.fill_(-4.0)  # sees too little, so that its loss is not zero
    terms, watched = model(small_batch(), 0, seeded(), LossWeights())
    assert terms.keys() == TERMS[row]
    assert watched.keys() == {"mse"} | ({"mask"} if "mask" in terms else set())
    for name, value in (terms | watched).items():
        assert value.ndim == 0, name
        assert value.isfinite(), name
    assert all(value.requires_grad for value in terms.values())
    assert not any(value.requires_grad for value in watched.values())
    torch.stack(list(terms.values())).sum().backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.abs().sum() > 0, name


@pytest.mark.parametrize("row", ROWS)
def test_a_small_step_down_the_gradient_lowers_the_loss(row):
    model, batch = small_model(row), small_batch()

    def total() -> torch.Tensor:
        return torch.stack(list(model(batch, 0, seeded(), LossWeights())[0].values())).sum()

    before = total()
    before.backward()
    gradients = [p.grad for p in model.parameters()]
    length = torch.stack([g.square().sum() for g in gradients]).sum().sqrt()
    with torch.no_grad():
        for parameter, gradient in zip(model.parameters(), gradients, strict=True):
            parameter -= 0.01 * gradient / length
        after = total()
    assert length > 1e-3
    assert after < before


def test_an_appearance_needs_a_decoder():
    spec = ModelSpec(colour="head", appearance="crossray", mlp=MLP)
    with pytest.raises(ValueError, match=r"model\.colour: decoder"):
        check_spec(spec)
    with pytest.raises(ValueError, match=r"model\.colour: decoder"):
        SceneModel(spec, BOX)


def test_the_released_encoder_has_64_channels():
    spec = ModelSpec(channels=32)
    with pytest.raises(ValueError, match=r"64 channels, not 32"):
        check_spec(spec)
    check_spec(ModelSpec(channels=32, encoder="compact"))
    check_spec(ModelSpec(channels=32, appearance="none"))


@pytest.mark.parametrize(
    "sizes",
    [
        {"mlp": dataclasses.replace(MLP, coarse_samples=1)},
        {"field": "hash", "hash": dataclasses.replace(HASH, levels=0)},
        {"field": "hash", "hash": dataclasses.replace(HASH, samples=0)},
        {"field": "hash", "hash": dataclasses.replace(HASH, min_resolution=64, max_resolution=8)},
        {"channels": 0, "encoder": "compact"},
    ],
    ids=["one-coarse-sample", "no-levels", "no-samples", "shrinking-grids", "no-channels"],
)
def test_sizes_that_cannot_work_are_refused(sizes):
    """check_spec's docstring promises it; otherwise the first step fails inside torch and names no key."""
    with pytest.raises(ValueError, match=r"model\."):
        check_spec(ModelSpec(**sizes))


ODD = [torch.rand(3, 17, 23), torch.rand(3, 21, 19)]


@pytest.mark.parametrize("encoder", ["released", "compact"])
@pytest.mark.parametrize("segmenter", ["cgnet", "unet"])
@pytest.mark.parametrize("appearance", ["none", "crossray"])
def test_accepted_choices_read_photos_of_any_size(encoder, segmenter, appearance):
    """A photo's sides are odd as often as even."""
    spec = dataclasses.replace(small_spec("crnerf"), encoder=encoder, segmenter=segmenter, appearance=appearance)
    try:
        check_spec(spec)
    except ValueError:
        return
    batch = small_batch()._replace(references=ODD, others=ODD[::-1])
    terms, _ = SceneModel(spec, BOX)(batch, 0, seeded(), LossWeights())
    assert all(value.isfinite() for value in terms.values())
