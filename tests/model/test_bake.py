"""Baked appearances: three channels through the field give the picture that C channels and a colour map give."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from small_models import BOX, HASH, MLP, PHOTOS, small_rays, small_spec
from torch import Tensor

from model.bake import bake, blank, check_bakeable
from model.fields.base import Rendering
from model.methods import METHODS, ModelSpec
from model.scene_model import ColourMap, SceneModel

TRANSFORMS = ("learned", "style_only", "mean_only", "closed_form")
CROSS_RAY = [name for name, method in METHODS.items() if method.appearance == "crossray"]
PLAIN = ["crnerf-b", "crnerf-t"]  # a decoder without an appearance
SIZE = (6, 8)


def spec_of(row: str, transform: str = "learned") -> ModelSpec:
    """A row with small parts; the fast one with the parts that its recipe picks."""
    return replace(small_spec(f"{row}-fast" if METHODS[row].field == "hash" else row), transform=transform)


def vivid(spec: ModelSpec) -> SceneModel:
    """A model with random weights, none of them near zero, and averages of statistics as after some training."""
    model = SceneModel(spec, BOX, PHOTOS).eval().requires_grad_(False)
    generator = torch.Generator().manual_seed(0)
    for name, parameter in model.named_parameters():
        noise = torch.randn(parameter.shape, generator=generator)
        table = name.endswith("grid.table")
        scale = 1.0 if table else math.sqrt(2 / parameter[0].numel()) if parameter.ndim > 1 else 0.1
        parameter.copy_(scale * noise)
        if name.endswith("density.bias"):  # the last sample of the paper's field shall not swallow all light
            parameter.sub_(5.0 if spec.field == "mlp" else -3.0)
    if model.transform is not None:
        for seed in range(3):
            rays = small_rays(40, seed)
            seen = model.point_features(rays) if model.fuses_points else model.render(rays).features
            model.track(model.transform.content_statistics(seen[None]))
    return model


def appearances_of(model: SceneModel, count: int = 1) -> Tensor | None:
    """F^a of a few random photos."""
    images = [torch.rand(3, 18, 26, generator=torch.Generator().manual_seed(i)) for i in range(count)]
    return None if model.encoder is None else model.encode(images)


def unbaked(model: SceneModel, colours: ColourMap) -> tuple[Rendering, Tensor]:
    """A view with all its channels, and its colours (N, 3) in one appearance."""
    view = model.render(small_rays(SIZE[0] * SIZE[1]))
    return view, torch.sigmoid(view.features @ colours.A[0].T + colours.b[0])


def assert_baked(model: SceneModel, colours: ColourMap) -> None:
    """Equal pictures to 1e-5 and to one 8-bit level, of colours that vary and do not drown in the sigmoid."""
    baked, rays = bake(model, colours), small_rays(SIZE[0] * SIZE[1])
    view, expected = unbaked(model, colours)
    found = baked.render(rays)
    assert found.features.shape == (len(rays.near), 3)
    assert expected.std(dim=0).min() > 1e-3
    assert ((expected > 0.02) & (expected < 0.98)).float().mean() > 0.3
    torch.testing.assert_close(found.features, expected, atol=1e-5, rtol=0)
    levels = [(255 * picture).round().int() for picture in (found.features, expected)]
    assert (levels[0] - levels[1]).abs().max() <= 1
    torch.testing.assert_close(found.depth, view.depth, atol=1e-5, rtol=0)
    torch.testing.assert_close(found.accumulation, view.accumulation, atol=1e-5, rtol=0)


@pytest.mark.parametrize("transform", TRANSFORMS)
@pytest.mark.parametrize("row", CROSS_RAY)
def test_a_baked_appearance_is_the_unbaked_picture(row, transform):
    model = vivid(spec_of(row, transform))
    content = model.content_statistics(model.running_mean, (1, 1), "running")
    colours = model.colour_map(content, appearances_of(model))
    rays = small_rays(SIZE[0] * SIZE[1])
    torch.testing.assert_close(  # the reference of this test is what the model itself renders
        unbaked(model, colours)[1],
        model.colours(model.render(rays).features[None], appearances_of(model), content)[0],
        atol=1e-6,
        rtol=0,
    )
    assert_baked(model, colours)


@pytest.mark.parametrize("row", ["crnerf-u", "crnerf-r", "crnerf"])
def test_the_fast_field_with_every_kind_of_transient_and_fusion(row):
    """With a transient head features come from a network of their own; fused at points, from points and background."""
    model = vivid(small_spec(f"{row}-fast"))
    content = model.content_statistics(model.running_mean, (1, 1), "running")
    colours = model.colour_map(content, appearances_of(model))
    assert_baked(model, colours)
    if model.fuses_points:
        assert colours.A[0, :, -1].abs().max() > 1e-3


@pytest.mark.parametrize("row", PLAIN)
def test_a_decoder_without_an_appearance_is_baked_by_itself(row):
    for spec in (spec_of(row), small_spec(f"{row}-fast")):
        model = vivid(spec)
        colours = model.colour_map(None, None)
        assert torch.equal(colours.A[0], model.decoder.linear.weight)
        assert_baked(model, colours)


@pytest.mark.parametrize("row", ["crossray", "crnerf"])
def test_an_appearance_between_two(row):
    """F^a is what is interpolated, not A and b: these depend on second moments of F^a."""
    model = vivid(spec_of(row))
    content = model.content_statistics(model.running_mean, (1, 1), "running")
    first, second = appearances_of(model, 2).split(1)
    between = model.colour_map(content, torch.lerp(first, second, 0.3))
    assert_baked(model, between)
    ends = [model.colour_map(content, F) for F in (first, second)]
    assert (between.A - torch.lerp(ends[0].A, ends[1].A, 0.3)).abs().max() > 1e-4


def test_by_hand():
    """A f + c at each point, composited, and b: written out for the paper's field."""
    model = vivid(spec_of("crnerf-r"))
    content = model.content_statistics(model.running_mean, (1, 1), "running")
    colours = model.colour_map(content, appearances_of(model))
    A, b, rays = colours.A[0], colours.b[0], small_rays(5)
    level = model.field.march(rays).levels[-1]
    expected = []
    for weights, features in zip(level.weights, level.features, strict=True):
        total = sum(w * (A[:, :64] @ f + A[:, 64]) for w, f in zip(weights, features, strict=True))
        expected.append(torch.sigmoid(total + b))
    torch.testing.assert_close(bake(model, colours).render(rays).features, torch.stack(expected), atol=1e-5, rtol=0)


@pytest.mark.parametrize("row", ["crossray", "crnerf"])
def test_it_carries_three_channels_and_little_else(row):
    model = vivid(spec_of(row))
    baked = bake(model, model.colour_map(model.content_statistics(model.running_mean, (1, 1), "running"),
                                         appearances_of(model)))  # fmt: skip
    rays = small_rays(5)
    level = baked.field.march(rays).levels[-1]
    assert level.features.shape[-1] == 3
    if level.background is not None:
        assert level.background.shape == (5, 3)
    names = {name.split(".")[0] for name in baked.state_dict()}
    assert names == {"field", "b"}
    if model.spec.field == "hash":
        sizes = [sum(p.numel() for p in m.field.parameters()) for m in (model, baked)]
        assert sizes[1] < sizes[0]
    mine = {p.data_ptr() for p in model.parameters()}
    assert all(p.data_ptr() not in mine and not p.requires_grad for p in baked.parameters())


@pytest.mark.parametrize("row", ["crossray", "crnerf", "crnerf-r"])
def test_chunks_and_samples(row):
    model = vivid(spec_of(row))
    baked = bake(model, model.colour_map(model.content_statistics(model.running_mean, (1, 1), "running"),
                                         appearances_of(model)))  # fmt: skip
    rays = small_rays(30)
    for a, b in zip(baked.render(rays, chunk=7), baked.render(rays), strict=True):
        torch.testing.assert_close(a, b, atol=1e-5, rtol=0)
    more = baked.render(rays, samples=(12, 9))
    torch.testing.assert_close(more.depth, model.render(rays, samples=(12, 9)).depth, atol=1e-5, rtol=0)
    assert (more.features - baked.render(rays).features).abs().max() > 1e-5


@pytest.mark.parametrize("row", ["crossray", "crnerf-u", "crnerf-r", "crnerf-t"])
def test_a_blank_one_is_filled_from_its_state(row):
    model = vivid(spec_of(row))
    content = None if model.transform is None else model.content_statistics(model.running_mean, (1, 1), "running")
    baked = bake(model, model.colour_map(content, appearances_of(model)))
    again = blank(model.spec)
    again.load_state_dict(baked.state_dict())
    rays = small_rays(7)
    assert torch.equal(again.render(rays).features, baked.render(rays).features)


@pytest.mark.parametrize(
    ("row", "reason"), [("nerf", "colour: head"), ("nerfw", "input of the network"), ("hanerf", "input of the network")]
)
def test_what_cannot_be_baked_is_refused_with_the_reason(row, reason):
    spec = small_spec(row)
    with pytest.raises(ValueError, match=reason):
        check_bakeable(spec)
    with pytest.raises(ValueError, match=reason):
        blank(spec)
    with pytest.raises(ValueError, match=reason):
        bake(SceneModel(spec, BOX, PHOTOS), ColourMap(torch.zeros(1, 3, 3), torch.zeros(1, 3)))


def test_a_code_with_a_decoder_is_refused_too():
    spec = ModelSpec(field="hash", colour="decoder", appearance="code", fused="point", transient="none",
                     encoder="compact", channels=8, mlp=MLP, hash=HASH)  # fmt: skip
    with pytest.raises(ValueError, match="code cannot be baked"):
        check_bakeable(spec)


def test_the_map_of_several_appearances_is_refused():
    model = vivid(spec_of("crossray"))
    content = model.content_statistics(model.running_mean, (1, 1), "running")
    with pytest.raises(ValueError, match=r"one appearance of this model is A \(1, 3, 8\)"):
        bake(model, model.colour_map(content, appearances_of(model, 2)))
