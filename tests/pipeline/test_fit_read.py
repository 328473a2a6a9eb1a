"""`+fit`: what was read from a photo is fitted further, for cross-ray methods on features that are rendered once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from model.methods import CODE, METHODS, HashSpec, ModelSpec
from model.scene_model import SceneModel
from pipeline.fit import FitRecipe, fit_code, fit_map
from pipeline.manifest import CameraRecord
from pipeline.patches import step_generator
from pipeline.render import View, colour_view, render_picture, render_view

WIDTH, HEIGHT, LEFT = 24, 16, 12
CELLS = 4
HASH = HashSpec(levels=3, log2_entries=8, max_resolution=32, width=16, proposal_samples=8, samples=6)
RAY = ModelSpec(**METHODS["crossray"].axes(), channels=8, encoder="compact", segmenter="unet", hash=HASH)
SPECS = {
    "ray": RAY,
    "point": replace(RAY, fused="point"),
    "closed-form": replace(RAY, transform="closed_form"),
    "released": replace(RAY, channels=64, encoder="released"),
    "uncertainty": replace(RAY, transient="uncertainty"),
    "patch": replace(RAY, statistics="patch"),
    "running": replace(RAY, statistics="running"),
}
RECIPE = FitRecipe(steps=60, rays=64, learning_rate=0.05, stages=1)

CAMERA = CameraRecord(
    key="view", name="view.jpg", image_id=1, split="test", width=WIDTH, height=HEIGHT, fx=26.0, fy=27.0, cx=12.5,
    cy=7.75, c2w=((1, 0, 0, 0.2), (0, 1, 0, 0), (0, 0, 1, -3)), near=1.0, far=6.0, source_sha256="0" * 64,
)  # fmt: skip


def model_of(spec: ModelSpec) -> SceneModel:
    """As if trained: places differ, and appearance is seen."""
    torch.manual_seed(0)
    model = SceneModel(spec, torch.tensor([[-1.0, -1, -1], [1, 1, 1]])).eval().requires_grad_(False)
    generator = torch.Generator().manual_seed(1)
    for name, parameter in model.named_parameters():
        if name.endswith("grid.table"):
            parameter.normal_(generator=generator)
        elif parameter.ndim == 2:
            parameter.copy_(torch.randn(parameter.shape, generator=generator) / parameter.shape[1] ** 0.5)
    if spec.appearance == "crossray":
        model.running_count += 1
        model.running_gram += torch.eye(model.running_gram.shape[-1])
    return model


def map_of(model: SceneModel, seed: int) -> Tensor:
    """An F^a, as an encoder could give it."""
    shape = (1, model.spec.channels, CELLS, CELLS)
    return torch.tanh(torch.randn(shape, generator=torch.Generator().manual_seed(seed)) + 0.5 * seed)


def photo_of(model: SceneModel, view: View, appearance: Tensor) -> np.ndarray:
    return np.rint(255 * colour_view(model, view, appearance)).astype(np.uint8)


def error(a: np.ndarray, b: np.ndarray, columns: slice) -> float:
    return float(np.square(a[:, columns] / 255 - b[:, columns]).mean())


@pytest.mark.parametrize("name", SPECS)
def test_the_light_of_the_left_half_is_found_and_holds_in_the_right_one(name):
    model = model_of(SPECS[name])
    view, start = render_view(model, CAMERA), map_of(model, 0)
    photo = photo_of(model, view, map_of(model, 1))
    found = fit_map(model, view, photo, LEFT, RECIPE, start)
    assert (found.shape, found.dtype, found.requires_grad) == (start.shape, torch.float32, False)
    for columns in (slice(LEFT), slice(LEFT, None)):
        before, after = (error(photo, colour_view(model, view, a), columns) for a in (start, found))
        assert before > 3e-4  # of 8-bit rounding there is 1e-6
        assert after < 0.3 * before, columns


@pytest.mark.parametrize("name", SPECS)
def test_each_pixel_is_compared_with_its_own_colour(name, monkeypatch):
    """In the photo's own F^a nothing is left but the rounding to 8 bits: the colours are those of `colour_view`, with
    the statistics that the model renders with."""
    model = model_of(SPECS[name])
    view, own = render_view(model, CAMERA), map_of(model, 1)
    losses, grad = [], torch.autograd.grad
    monkeypatch.setattr(torch.autograd, "grad", lambda loss, moved: losses.append(loss.item()) or grad(loss, moved))
    fit_map(model, view, photo_of(model, view, own), LEFT, FitRecipe(steps=1, rays=500), own)
    assert losses[0] < 1.01 * (0.5 / 255) ** 2


def slow_fit(model: SceneModel, view: View, photo: np.ndarray, recipe: FitRecipe, start: Tensor, seed: int) -> Tensor:
    """The whole picture in every step, and Adam as it is printed (Kingma and Ba 2015)."""
    generator = step_generator(seed, 0, 0, "cpu")
    pool = torch.randperm(HEIGHT * LEFT, generator=generator)[: recipe.pool]
    found, mean, square = start.clone(), torch.zeros_like(start), torch.zeros_like(start)
    for step in range(1, recipe.steps + 1):
        drawn = pool[torch.randint(len(pool), (recipe.rays,), generator=generator)]
        moved = found.clone().requires_grad_()
        content = model.content_statistics(view.features, view.size, "view")
        picture = model.colours(view.features[None], moved, content)[0].view(HEIGHT, WIDTH, 3)
        truth = torch.from_numpy(photo / 255).float()
        loss = sum(
            (picture[i // LEFT, i % LEFT] - truth[i // LEFT, i % LEFT]).square().mean() for i in drawn.tolist()
        ) / len(drawn)
        (slope,) = torch.autograd.grad(loss, moved)
        mean, square = 0.9 * mean + 0.1 * slope, 0.999 * square + 0.001 * slope**2
        rate = recipe.learning_rate * 0.1 ** ((step - 1) // (recipe.steps // recipe.stages))
        found = found - rate * (mean / (1 - 0.9**step)) / ((square / (1 - 0.999**step)).sqrt() + 1e-8)
    return found


@pytest.mark.parametrize("pool", [100, 4096])
def test_it_is_adam_on_the_mean_squared_error_of_drawn_pixels(pool):
    model = model_of(RAY)
    view, start = render_view(model, CAMERA), map_of(model, 0)
    photo = photo_of(model, view, map_of(model, 1))
    recipe = FitRecipe(steps=6, rays=40, learning_rate=0.02, stages=2, pool=pool)
    found, slow = (
        fit_map(model, view, photo, LEFT, recipe, start, seed=3),
        slow_fit(model, view, photo, recipe, start, 3),
    )
    torch.testing.assert_close(found, slow, atol=2e-4, rtol=0)
    assert (found - start).abs().max() > 0.04


@pytest.mark.parametrize("name", ["ray", "point"])
def test_columns_beyond_the_given_ones_are_not_looked_at(name):
    model = model_of(SPECS[name])
    view, start = render_view(model, CAMERA), map_of(model, 0)
    photo = photo_of(model, view, map_of(model, 1))
    doctored = photo.copy()
    doctored[:, LEFT:] = 255 - doctored[:, LEFT:]
    recipe = FitRecipe(steps=5, rays=500)
    first = fit_map(model, view, photo, LEFT, recipe, start)
    assert torch.equal(fit_map(model, view, doctored, LEFT, recipe, start), first)
    doctored[:, LEFT - 1] = 255 - doctored[:, LEFT - 1]  # the last column that counts
    assert not torch.equal(fit_map(model, view, doctored, LEFT, recipe, start), first)


@pytest.mark.parametrize("frozen", [True, False])
@pytest.mark.parametrize("name", ["ray", "point", "released"])
def test_the_model_and_the_start_stay_as_they_are(name, frozen):
    model = model_of(SPECS[name]).requires_grad_(not frozen)
    view, start = render_view(model, CAMERA), map_of(model, 0)
    before = {key: value.clone() for key, value in model.state_dict().items()}
    kept = start.clone()
    fit_map(model, view, photo_of(model, view, map_of(model, 1)), LEFT, FitRecipe(steps=3, rays=32), start)
    assert torch.equal(start, kept)
    assert all(parameter.grad is None for parameter in model.parameters())
    assert all(torch.equal(value, before[key]) for key, value in model.state_dict().items())


def test_the_same_seed_gives_the_same_map_to_the_bit():
    model = model_of(RAY)
    view, start = render_view(model, CAMERA), map_of(model, 0)
    photo, recipe = photo_of(model, view, map_of(model, 1)), FitRecipe(steps=5, rays=32)
    first = fit_map(model, view, photo, LEFT, recipe, start, seed=4)
    torch.manual_seed(2)
    assert torch.equal(fit_map(model, view, photo, LEFT, recipe, start, seed=4), first)
    assert not torch.equal(fit_map(model, view, photo, LEFT, recipe, start, seed=5), first)


def test_one_pixel_is_enough():
    model = model_of(RAY)
    one = CAMERA.model_copy(update={"width": 1, "height": 1, "cx": 0.5, "cy": 0.5})
    view, start = render_view(model, one), map_of(model, 0)
    found = fit_map(model, view, np.full((1, 1, 3), 200, np.uint8), 1, FitRecipe(steps=3, rays=8), start)
    assert found.isfinite().all()
    assert not torch.equal(found, start)


def test_a_model_without_a_transform_has_no_map():
    model = model_of(ModelSpec(**METHODS["crnerf-b"].axes() | {"field": "hash"}, channels=8, hash=HASH))
    view = render_view(model, CAMERA)
    with pytest.raises(ValueError, match=r"model\.appearance: none has no F\^a to fit"):
        fit_map(model, view, np.zeros((HEIGHT, WIDTH, 3), np.uint8), LEFT, RECIPE, torch.zeros(1, 8, 4, 4))


# Codes that are read from a photo


def coded() -> SceneModel:
    return model_of(
        ModelSpec(**METHODS["hanerf"].axes() | {"field": "hash", "transient": "none"}, encoder="compact", hash=HASH)
    )


def code_of(seed: int) -> Tensor:
    return 2 * torch.randn(1, CODE, generator=torch.Generator().manual_seed(seed))


def test_a_code_that_was_read_is_where_the_fit_starts():
    model, start = coded(), code_of(0)
    photo = np.rint(255 * render_picture(model, CAMERA, code_of(1))[1]).astype(np.uint8)
    recipe = FitRecipe(steps=40, rays=64, learning_rate=0.1, stages=1)
    near = fit_code(model, photo, CAMERA, LEFT, FitRecipe(steps=1, rays=8, learning_rate=0.01), start=start)
    assert (near - start).abs().max() == pytest.approx(0.01, rel=0.01)
    found = fit_code(model, photo, CAMERA, LEFT, recipe, start=start)
    for columns in (slice(LEFT), slice(LEFT, None)):
        before, after = (error(photo, render_picture(model, CAMERA, c)[1], columns) for c in (start, found))
        assert after < 0.3 * before, columns


def test_a_model_without_learned_codes_needs_a_start():
    with pytest.raises(ValueError, match="no learned codes to start a fit from"):
        fit_code(coded(), np.zeros((HEIGHT, WIDTH, 3), np.uint8), CAMERA, LEFT, RECIPE)
