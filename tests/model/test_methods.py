"""Every row of the table can be built and trained, and what does not fit together is refused."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
from typing import get_args, get_type_hints

import pytest
import torch
from small_models import BOX, HASH, MLP, PHOTOS, ROWS, TRANSFORMS, small_batch, small_model, small_rays, small_spec

from model.losses import LossWeights
from model.methods import AXES, CODE, FUSED_AT, METHODS, ModelSpec, check_spec
from model.scene_model import SceneModel


def seeded() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def test_the_table_is_that_of_the_paper():
    choices = {name: tuple(method.axes().values()) for name, method in METHODS.items()}
    assert choices == {
        "nerf": ("mlp", "head", "none", "none", "none"),
        "nerfw": ("mlp", "head", "embedding", "point", "uncertainty"),
        "hanerf": ("mlp", "head", "code", "point", "uvmask"),
        "crnerf-b": ("mlp", "decoder", "none", "none", "none"),
        "crnerf-a": ("mlp", "decoder", "crossray", "ray", "none"),
        "crnerf-t": ("mlp", "decoder", "none", "none", "segmenter"),
        "crnerf-u": ("mlp", "decoder", "crossray", "ray", "uncertainty"),
        "crnerf-a-masks": ("mlp", "decoder", "crossray", "ray", "fixed"),
        "crnerf-r": ("mlp", "decoder", "crossray", "point", "segmenter"),
        "crnerf": ("mlp", "decoder", "crossray", "ray", "segmenter"),
        "crossray": ("hash", "decoder", "crossray", "ray", "segmenter"),
    }
    names = {field.name for field in dataclasses.fields(ModelSpec)}
    for method in METHODS.values():
        assert method.axes().keys() <= names
        check_spec(ModelSpec(**method.axes()))


@pytest.mark.parametrize("row", [*ROWS, *TRANSFORMS])
def test_each_row_trains(row):
    """One step: the terms that the row has, finite, and a gradient for every parameter."""
    model = small_model(row)
    if model.spec.field == "hash":
        model.field.proposal[-1].bias.data.fill_(-4.0)  # sees too little, so that its loss is not zero
    terms, watched = model(small_batch(), 0, seeded(), LossWeights())
    assert watched.keys() == {"mse"} | (set() if model.spec.transient == "none" else {"mask"})
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


@pytest.mark.parametrize("row", [*ROWS, *TRANSFORMS])
def test_a_small_step_down_the_gradient_lowers_the_loss(row):
    """Without the two terms whose target is detached: those follow no gradient of their value."""
    model, batch = small_model(row), small_batch()
    weights = LossWeights(appearance=0.0, mode_seeking=0.0)

    def total() -> torch.Tensor:
        return torch.stack(list(model(batch, 0, seeded(), weights)[0].values())).sum()

    before = total()
    before.backward()
    gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in model.parameters()]
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


@pytest.mark.parametrize(
    ("choices", "message"),
    [
        ({"appearance": "none", "fused": "ray"}, r"model\.fused: ray, but with model\.appearance: none"),
        ({"appearance": "code", "fused": "none"}, r"model\.appearance: code has to be fused somewhere; point fits"),
        ({"appearance": "embedding", "fused": "ray"}, r"model\.fused: ray needs model\.appearance: crossray"),
        ({"appearance": "code", "fused": "point", "transform": "closed_form"}, r"model\.transform: closed_form needs"),
    ],
)
def test_choices_that_make_no_sense_are_refused_with_the_reason(choices, message):
    with pytest.raises(ValueError, match=message):
        check_spec(ModelSpec(**choices))


def every_choice() -> list[ModelSpec]:
    """All points of the design space that check_spec accepts, small."""
    axes = {axis: get_args(get_type_hints(ModelSpec)[axis]) for axis in (*AXES, "transform")}
    found = []
    for values in itertools.product(*axes.values()):
        spec = ModelSpec(
            **dict(zip(axes, values, strict=True)), encoder="compact", channels=8, segmenter="unet", mlp=MLP, hash=HASH
        )
        with contextlib.suppress(ValueError):
            check_spec(spec)
            found.append(spec)
    return found


@pytest.mark.parametrize("row", METHODS)
def test_only_a_transform_takes_statistics(row):
    spec = dataclasses.replace(small_spec(row), statistics="running")
    if spec.appearance == "crossray":
        check_spec(spec)
        return
    with pytest.raises(ValueError, match=r"model.statistics: running needs model.appearance: crossray"):
        check_spec(spec)
    check_spec(dataclasses.replace(spec, statistics="view"))


@pytest.mark.slow
def test_every_accepted_choice_takes_a_step_and_renders():
    """No part may assume a neighbour: all combinations, not only the rows."""
    specs = every_choice()
    codes, rays = 2 * 3, 2 * 4  # colours x appearances that are no crossray; places of fusion x transforms
    assert len(specs) == 2 * 5 * (codes + rays)  # fields x transients
    batch = small_batch(k=4)
    for spec in specs:
        model = SceneModel(spec, BOX, PHOTOS)
        terms, _ = model(batch, 0, seeded(), LossWeights())
        torch.stack(list(terms.values())).sum().backward()
        for name, parameter in model.named_parameters():
            assert parameter.grad is not None, (spec, name)
        code = torch.zeros(1, CODE) if model.coded else None
        assert model.render(small_rays(3), code=code).features.isfinite().all(), spec


def test_the_released_encoder_has_64_channels():
    spec = ModelSpec(channels=32)
    with pytest.raises(ValueError, match=r"64 channels, not 32"):
        check_spec(spec)
    check_spec(ModelSpec(channels=32, encoder="compact"))
    check_spec(ModelSpec(channels=32, appearance="none", fused="none"))


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
@pytest.mark.parametrize("appearance", ["none", "crossray", "code"])
def test_accepted_choices_read_photos_of_any_size(encoder, segmenter, appearance):
    """A photo's sides are odd as often as even."""
    fused = FUSED_AT[appearance]
    spec = dataclasses.replace(
        small_spec("crnerf"), encoder=encoder, segmenter=segmenter, appearance=appearance, fused=fused
    )
    try:
        check_spec(spec)
    except ValueError:
        return
    batch = small_batch()._replace(references=ODD, others=ODD[::-1])
    terms, _ = SceneModel(spec, BOX)(batch, 0, seeded(), LossWeights())
    assert all(value.isfinite() for value in terms.values())
