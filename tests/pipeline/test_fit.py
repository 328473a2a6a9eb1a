"""Fitting a code: it finds the light of a picture in the part that it may see, and moves nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from model.methods import CODE, METHODS, TRANSIENT_CODE, HashSpec, MLPSpec, ModelSpec
from model.scene_model import SceneModel
from pipeline.fit import FitRecipe, fit_code, rays_through
from pipeline.manifest import CameraRecord
from pipeline.render import render_picture, view_rays

pytestmark = pytest.mark.slow  # half a minute together: not for every commit

CPU = torch.device("cpu")
WIDTH, LEFT = 24, 12
PHOTOS = 5
SPECS = {
    "nerfw": ModelSpec(**METHODS["nerfw"].axes(), mlp=MLPSpec(width=16, coarse_samples=6, fine_samples=6)),
    "nerfw-fast": ModelSpec(
        **METHODS["nerfw"].axes() | {"field": "hash"},
        pixel_center=0.5,
        hash=HashSpec(levels=3, log2_entries=8, max_resolution=32, width=16, proposal_samples=8, samples=6),
    ),
}
SPECS["embedding-alone"] = replace(SPECS["nerfw-fast"], transient="none")
SPECS["embedding-decoded"] = replace(SPECS["nerfw-fast"], colour="decoder", channels=8)
RECIPE = FitRecipe(steps=60, rays=64, learning_rate=0.1)

CAMERA = CameraRecord(
    key="view", name="view.jpg", image_id=1, split="test", width=WIDTH, height=16, fx=26.0, fy=27.0, cx=12.5, cy=7.75,
    c2w=((1, 0, 0, 0.2), (0, 1, 0, 0), (0, 0, 1, -3)), near=1.0, far=6.0, source_sha256="0" * 64,
)  # fmt: skip


def model_of(name: str) -> SceneModel:
    """As if trained on photos of different light: codes differ, and what differs is seen."""
    torch.manual_seed(0)
    model = SceneModel(SPECS[name], torch.tensor([[-1.0, -1, -1], [1, 1, 1]]), PHOTOS).eval()
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter_name, parameter in model.named_parameters():
            if parameter.ndim > 1 and not parameter_name.endswith("grid.table"):
                scale = 1.0 if parameter_name.endswith("embedding.weight") else (2 / parameter.shape[1]) ** 0.5
                parameter.copy_(scale * torch.randn(parameter.shape, generator=generator))
            elif parameter.ndim > 1:
                parameter.normal_(generator=generator)
        if name == "nerfw":
            model.field.transient.density.bias.sub_(4)  # some people, and not fog before everything
    return model


def codes_of_a_photo() -> tuple[Tensor, Tensor]:
    """An appearance and a transient code that are none of the training photos'."""
    generator = torch.Generator().manual_seed(2)
    return 2 * torch.randn(1, CODE, generator=generator), 2 * torch.randn(1, TRANSIENT_CODE, generator=generator)


def photo_of(model: SceneModel, appearance: Tensor | None = None, transient: Tensor | None = None) -> np.ndarray:
    """The view of CAMERA in a photo's codes, its transients included, uint8 (h, w, 3)."""
    if appearance is None:
        appearance, transient = codes_of_a_photo()
    with torch.no_grad():
        placed = model.field.place(view_rays(CAMERA, model.spec.pixel_center, CPU))
        rgb = model.picture(placed, appearance, transient if model.transient_embedding is not None else None)
    return (255 * rgb.clamp(0, 1).view(CAMERA.height, WIDTH, 3)).round().byte().numpy()


def clean(model: SceneModel, code: Tensor) -> np.ndarray:
    """The view in an appearance as it is rendered: nobody there."""
    return render_picture(model, CAMERA, code)[1]


def error(a: np.ndarray, b: np.ndarray, columns: slice) -> float:
    return float(np.square(a[:, columns] - b[:, columns]).mean())


@pytest.mark.parametrize("name", SPECS)
def test_the_light_of_the_left_half_is_found_and_holds_in_the_right_one(name):
    model = model_of(name)
    photo, mean = photo_of(model), model.embedding.weight.detach().mean(0, keepdim=True)
    found = fit_code(model, photo, CAMERA, LEFT, RECIPE)
    assert (found.shape, found.dtype, found.requires_grad) == ((1, CODE), torch.float32, False)
    truth = clean(model, codes_of_a_photo()[0])
    for columns in (slice(LEFT), slice(LEFT, None)):
        before, after = (error(clean(model, code), truth, columns) for code in (mean, found))
        assert before > 3e-3
        assert after < 0.1 * before, columns


@pytest.mark.parametrize("name", SPECS)
def test_columns_beyond_the_given_ones_are_not_looked_at(name):
    model = model_of(name)
    photo = photo_of(model)
    doctored = photo.copy()
    doctored[:, LEFT:] = 255 - doctored[:, LEFT:]
    recipe = FitRecipe(steps=8, rays=200)
    first, second = (fit_code(model, image, CAMERA, LEFT, recipe) for image in (photo, doctored))
    assert torch.equal(first, second)
    doctored[:, LEFT - 1] = 255 - doctored[:, LEFT - 1]  # the last column that counts
    assert not torch.equal(fit_code(model, doctored, CAMERA, LEFT, recipe), first)


def test_all_columns_may_be_given():
    model = model_of("embedding-alone")
    photo = photo_of(model)
    doctored = photo.copy()
    doctored[:, -1] = 255 - doctored[:, -1]
    recipe = FitRecipe(steps=8, rays=200)
    first, second = (fit_code(model, image, CAMERA, WIDTH, recipe) for image in (photo, doctored))
    assert not torch.equal(first, second)


@pytest.mark.parametrize("frozen", [True, False])
@pytest.mark.parametrize("name", ["nerfw", "nerfw-fast"])
def test_the_model_stays_as_it_is(name, frozen):
    model = model_of(name).requires_grad_(not frozen)
    before = {key: value.clone() for key, value in model.state_dict().items()}
    fit_code(model, photo_of(model), CAMERA, LEFT, FitRecipe(steps=5, rays=32))
    assert all(parameter.grad is None for parameter in model.parameters())
    assert all(parameter.requires_grad != frozen for parameter in model.parameters())
    assert all(torch.equal(value, before[key]) for key, value in model.state_dict().items())


def test_the_same_seed_gives_the_same_code_to_the_bit():
    model = model_of("nerfw-fast")
    photo, recipe = photo_of(model), FitRecipe(steps=5, rays=32)
    torch.manual_seed(1)
    first = fit_code(model, photo, CAMERA, LEFT, recipe, seed=4)
    torch.manual_seed(2)
    assert torch.equal(fit_code(model, photo, CAMERA, LEFT, recipe, seed=4), first)
    assert not torch.equal(fit_code(model, photo, CAMERA, LEFT, recipe, seed=5), first)


@pytest.fixture
def tried(monkeypatch):
    """The codes of every picture that a fit looks at: (appearance, transient or None)."""
    calls: list[tuple[Tensor, Tensor | None]] = []
    picture = SceneModel.picture

    def spy(self, placed, code, transient):
        calls.append((code.detach().clone(), None if transient is None else transient.detach().clone()))
        return picture(self, placed, code, transient)

    monkeypatch.setattr(SceneModel, "picture", spy)
    return calls


def test_both_codes_start_from_the_mean_photo_and_move_and_the_appearance_is_what_comes_back(tried):
    model = model_of("nerfw-fast")
    photo = photo_of(model)
    tried.clear()
    found = fit_code(model, photo, CAMERA, LEFT, FitRecipe(steps=4, rays=32))
    assert len(tried) == 4
    for part, embedding in enumerate((model.embedding, model.transient_embedding)):
        torch.testing.assert_close(tried[0][part], embedding.weight.detach().mean(0, keepdim=True))
        assert ((tried[3][part] - tried[0][part]).abs() > 0).all()
    assert found.shape == tried[3][0].shape
    moved = (found - tried[3][0]).abs()  # by one step more
    assert moved.max() > 0
    assert moved.max() < (found - tried[0][0]).abs().max()


def test_without_a_transient_field_one_code_is_fitted(tried):
    model = model_of("embedding-alone")
    fit_code(model, photo_of(model), CAMERA, LEFT, FitRecipe(steps=2, rays=32))
    assert all(transient is None for _, transient in tried)


def test_people_do_not_tint_what_is_found():
    """The photo shows what its transient code puts there. Without a transient field the appearance has to explain that,
    too, and is further from the light.
    """
    model = model_of("nerfw-fast")
    photo, truth = photo_of(model), clean(model, codes_of_a_photo()[0])
    alone = model_of("nerfw-fast")
    alone.transient_embedding = None
    with_field, without = (fit_code(m, photo, CAMERA, LEFT, RECIPE) for m in (model, alone))
    everywhere = slice(None)
    assert error(clean(model, with_field), truth, everywhere) < 0.5 * error(clean(model, without), truth, everywhere)


@pytest.mark.parametrize("name", SPECS)
def test_each_ray_is_compared_with_its_own_pixel(name, monkeypatch):
    """Of a photo in the codes that the fit starts from, nothing is left to explain but the rounding to 8 bits (and
    what is brighter than white: static and transient matter in one place add up)."""
    model = model_of(name)
    both = (model.embedding, model.transient_embedding)
    photo = photo_of(model, *(None if e is None else e.weight.detach().mean(0, keepdim=True) for e in both))
    losses, grad = [], torch.autograd.grad
    monkeypatch.setattr(torch.autograd, "grad", lambda loss, codes: losses.append(loss.item()) or grad(loss, codes))
    fit_code(model, photo, CAMERA, LEFT, FitRecipe(steps=1, rays=500))
    assert losses[0] < 0.01 * (photo / 255).std(axis=(0, 1)).mean() ** 2


def test_the_first_step_is_adam_s_down_the_slope():
    """Adam's first step moves every number by the learning rate, against its gradient."""
    model = model_of("embedding-alone")
    photo = photo_of(model)
    start = model.embedding.weight.detach().mean(0, keepdim=True)
    found = fit_code(model, photo, CAMERA, WIDTH, FitRecipe(steps=1, rays=20_000, learning_rate=0.01))
    code = start.clone().requires_grad_()
    placed = model.field.place(view_rays(CAMERA, 0.5, CPU))
    loss = (model.picture(placed, code, None) - torch.from_numpy(photo).view(-1, 3) / 255).square().mean()
    (gradient,) = torch.autograd.grad(loss, code)
    clear = gradient.abs() > 0.05 * gradient.abs().max()  # pixels are drawn, so a slight slope may turn
    assert clear.float().mean() > 0.5
    torch.testing.assert_close((found - start)[clear], -0.01 * gradient.sign()[clear], atol=1e-5, rtol=0)


def test_the_learning_rate_falls_to_a_tenth_twice(monkeypatch):
    rates = []

    class Watched(torch.optim.Adam):
        def step(self, closure=None):
            rates.append(self.param_groups[0]["lr"])
            return super().step(closure)

    monkeypatch.setattr(torch.optim, "Adam", Watched)
    model = model_of("embedding-alone")
    fit_code(model, photo_of(model), CAMERA, LEFT, FitRecipe(steps=9, rays=8, learning_rate=0.5))
    assert rates == pytest.approx([0.5] * 3 + [0.05] * 3 + [0.005] * 3)


def test_samples_are_placed_once_for_a_pool_of_pixels(monkeypatch):
    """More pixels than the pool holds: some are left out, the light is found nevertheless."""
    model = model_of("embedding-alone")
    photo = photo_of(model)
    place, placed = model.field.place, []
    with monkeypatch.context() as patch:
        patch.setattr(model.field, "place", lambda rays: placed.append(len(rays.near)) or place(rays))
        found = fit_code(model, photo, CAMERA, LEFT, RECIPE.model_copy(update={"pool": 50}))
    assert placed == [50]
    truth, mean = clean(model, codes_of_a_photo()[0]), model.embedding.weight.detach().mean(0, keepdim=True)
    left_out = slice(LEFT, None)
    assert error(clean(model, found), truth, left_out) < 0.2 * error(clean(model, mean), truth, left_out)


@pytest.mark.parametrize("pixel_center", [0.0, 0.5])
def test_rays_through_pixels_are_those_of_the_view(pixel_center):
    rows, cols = (g.flatten() for g in torch.meshgrid(torch.arange(16), torch.arange(WIDTH), indexing="ij"))
    order = torch.randperm(len(rows), generator=torch.Generator().manual_seed(0))
    found = rays_through(CAMERA, rows[order], cols[order], pixel_center)
    for ours, theirs in zip(found, view_rays(CAMERA, pixel_center, CPU), strict=True):
        torch.testing.assert_close(ours, theirs[order])


@pytest.mark.parametrize("method", [m for m, axes in METHODS.items() if axes.appearance != "embedding"])
def test_a_model_without_learned_codes_has_none_to_fit(method):
    appearance = METHODS[method].appearance
    model = SceneModel(ModelSpec(**METHODS[method].axes(), mlp=SPECS["nerfw"].mlp), torch.zeros(2, 3))
    lacking = "no learned codes to start" if appearance == "code" else "no code to fit"
    with pytest.raises(ValueError, match=rf"model\.appearance: {appearance} has {lacking}"):
        fit_code(model, np.zeros((16, WIDTH, 3), np.uint8), CAMERA, LEFT, FitRecipe(steps=1))
