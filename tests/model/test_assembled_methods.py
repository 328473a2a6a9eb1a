"""What each choice adds to a step and to a picture, against slow restatements: patch by patch, ray by ray, point by
point.

Everything is float64, so that a wrong factor cannot hide behind rounding; nothing is jittered, so that a patch alone
gives what it gives among others; and weights are drawn anew, so that nothing is nearly constant.
"""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from small_models import BOX, PHOTOS, ROWS, TRANSFORMS, small_batch, small_rays, small_spec
from torch import Tensor

from model import scene_model as module
from model.appearance.compact import at_size
from model.fields import nerf as nerf_module
from model.fields.base import Codes, Level, March, Rays
from model.losses import LossWeights
from model.methods import CODE, TRANSIENT_CODE, ModelSpec
from model.scene_model import COMPACT_SIZE, Batch, SceneModel, as_images
from model.transient.uncertainty import Transient

K = 8  # a side of a patch; the released code network reads no smaller patch than 16
CODED = [row for row in ROWS if small_spec(row).appearance in ("embedding", "code")]
CROSS_RAY = [*(row for row in ROWS if small_spec(row).appearance == "crossray"), *TRANSFORMS]
EXACT = {"atol": 1e-9, "rtol": 1e-9}


@pytest.fixture(autouse=True)
def _float64():
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def vivid(spec: ModelSpec, seed: int = 0) -> SceneModel:
    """A model of which every part matters, in evaluation mode."""
    model = SceneModel(spec, BOX, PHOTOS).eval()
    generator = seeded(seed)
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            noise = torch.randn(parameter.shape, generator=generator)
            if name.endswith("embedding.weight"):
                parameter.copy_(noise)
            elif parameter.ndim > 1:
                parameter.copy_(math.sqrt(2 / parameter[0].numel()) * noise)
            else:
                parameter.add_(0.1 * noise)
            if name.endswith("density.bias"):
                # The last sample of the paper's field, 100 units deep, shall not swallow all light; the fast field's
                # transients start almost empty.
                parameter.add_(-5.0 if spec.field == "mlp" else 3.0)
    return model


def vivid_row(row: str) -> SceneModel:
    return vivid(small_spec(row))


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def step(model: SceneModel, batch: Batch, weights: LossWeights | None = None) -> dict[str, Tensor]:
    """The terms of a step without jitter or density noise."""
    return model(batch, 0, None, weights or LossWeights())[0]


def rays_of(batch: Batch, p: int) -> Rays:
    """The rays of one patch."""
    n = batch.colours.shape[1]
    return Rays(*(r[p * n : (p + 1) * n] for r in batch.rays))


def appearance_of(model: SceneModel, batch: Batch, p: int) -> Tensor | None:
    """One patch's own appearance: of its photo, or of its reference."""
    if model.embedding is not None:
        return model.embedding.weight[batch.photos[p]][None]
    return None if model.encoder is None else model.encode([batch.references[p]])


def march_of(model: SceneModel, batch: Batch, p: int) -> March:
    """The static field along one patch alone, in its own photo's code where there are codes."""
    if not model.coded:
        return model.field.march(rays_of(batch, p))
    own = torch.cat([appearance_of(model, batch, p)] * batch.colours.shape[1])
    return model.field.march(rays_of(batch, p), codes=Codes(own))


def placed_of(model: SceneModel, rays: Rays, transient: Tensor) -> tuple[Transient, Tensor, Tensor]:
    """At the samples of rays: what one photo has in front of the scene, the static density, the samples' lengths."""
    placed = model.field.place(rays)
    return model.field.transient(placed.inner, transient), placed.density, placed.deltas


@pytest.fixture
def compared(monkeypatch):
    """What a step holds against its photos, in the order coarse, fine: (picture, photo, mask or beta)."""
    calls: list[tuple[Tensor, ...]] = []
    for name in ("photometric", "uncertain_photometric"):

        def spy(*args, original=getattr(module, name)):
            calls.append(args)
            return original(*args)

        monkeypatch.setattr(module, name, spy)
    return calls


def assert_terms(found: dict[str, Tensor], expected: dict[str, Tensor]) -> None:
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        torch.testing.assert_close(found[name], value, **EXACT, msg=lambda m, name=name: f"{name}: {m}")


def as_read(model: SceneModel, rgb: Tensor) -> Tensor:
    """A picture (N, 3) of a patch as an encoder of this model reads it: (1, 3, h, w)."""
    (image,) = as_images(rgb[None])
    return at_size([image], COMPACT_SIZE) if model.spec.encoder == "compact" else image[None]


# ------------------------------------------------------------------------------------------ cross-ray, at the points

POINT = ["crnerf-r", "crnerf-r-fast"]


def slow_point_picture(model: SceneModel, level: Level, appearance: Tensor, background_counts: bool = True) -> Tensor:
    """rgb (N, 3) of one patch: T at each of its points, then the rays' sums, then D.

    T's statistics are those of all points of all rays, each counting as much as any other.
    """
    cloud = torch.stack([point for ray in level.features for point in ray])
    W, b = model.transform.affine(
        model.transform.content_statistics(cloud[None]), model.transform.style_statistics(appearance)
    )
    colours = []
    for n, (weights, features) in enumerate(zip(level.weights, level.features, strict=True)):
        fused = sum(w * (W[0] @ f + b[0]) for w, f in zip(weights, features, strict=True))
        if level.background is not None and background_counts:
            fused = fused + (1 - sum(weights)) * (W[0] @ level.background[n] + b[0])
        colours.append(torch.sigmoid(model.decoder.linear.weight @ fused + model.decoder.linear.bias))
    return torch.stack(colours)


@pytest.mark.parametrize("row", POINT)
def test_fused_at_points_a_step_is_the_slow_one(row):
    """Every term: pictures of both levels, the appearance put in and read again, and the plain picture without T."""
    weights = LossWeights(appearance=0.5, content=0.3, embedding=0.2)
    model, batch = vivid_row(row), small_batch(k=K)
    masks = model.masks(batch)
    parts: dict[str, list[Tensor]] = {}

    def add(name: str, value: Tensor) -> None:
        parts.setdefault(name, []).append(value)

    for p in range(2):
        own, lent = (model.encode([images[p]]) for images in (batch.references, batch.others))
        levels = march_of(model, batch, p).levels
        M, C = masks[p], batch.colours[p]
        for name, level in zip(("coarse", "fine")[-len(levels) :], levels, strict=True):
            picture = slow_point_picture(model, level, own)
            add(name, 0.5 * ((1 - M)[:, None] * (picture - C) ** 2).mean())
        in_lent = slow_point_picture(model, levels[-1], lent.detach())
        add("appearance", 0.5 * (lent.detach() - model.encoder(as_read(model, in_lent))).abs().mean())
        plain = model.decoder(levels[-1].composite().features)  # the picture is still the fine one
        without_T, with_T = (model.content_encoder(as_read(model, rgb)) for rgb in (plain, picture))
        add("content", 0.3 * (without_T - with_T).square().mean())
        add("embedding", 0.2 * (own**2).mean())
        add("mask", weights.mask_weight(0) * (M**2).mean())
    assert_terms(step(model, batch, weights), {name: torch.stack(values).mean() for name, values in parts.items()})


@pytest.mark.parametrize("row", POINT)
def test_fused_at_points_the_running_statistics_are_those_of_the_fine_points(row):
    model, batch = vivid_row(row), small_batch(k=K)
    step(model, batch)
    clouds = [march_of(model, batch, p).levels[-1].features.flatten(0, 1) for p in range(2)]
    torch.testing.assert_close(model.running_mean[0], torch.stack([c.mean(0) for c in clouds]).mean(0), **EXACT)
    grams = [model.transform.content_statistics(c[None]).gram[0] for c in clouds]
    torch.testing.assert_close(model.running_gram[0], torch.stack(grams).mean(0), **EXACT)


@pytest.mark.parametrize("row", POINT)
def test_fused_at_points_a_rendered_view_is_the_slow_one(row):
    model, rays = vivid_row(row), small_rays(30)
    with torch.no_grad():
        appearance = model.encode(small_batch(k=K).references[:1])
        view = model.render(rays, chunk=7)
        content = model.content_statistics(view.features, (5, 6), "view", points=model.point_features(rays))
        picture = model.colours(view.features[None], appearance, content)[0]
        level = model.field.march(rays).levels[-1]
        expected = slow_point_picture(model, level, appearance)
    assert view.features.shape == (30, model.spec.channels + 1)
    torch.testing.assert_close(picture, expected, **EXACT)
    if level.background is not None:
        without = slow_point_picture(model, level, appearance, background_counts=False)
        assert (picture - without).abs().max() > 1e-3  # the background is a sample like any other


@pytest.mark.parametrize("row", POINT)
def test_with_the_same_statistics_point_and_ray_differ_by_the_lost_light_alone(row):
    """T is affine and compositing is linear: what remains is b times the light that no sample gives."""
    model, rays = vivid_row(row), small_rays(40)
    at_rays = SceneModel(replace(model.spec, fused="ray"), BOX, PHOTOS).eval()
    at_rays.load_state_dict(model.state_dict())
    with torch.no_grad():
        appearance = model.encode(small_batch(k=K).references[:1])
        content = model.transform.content_statistics(model.point_features(rays)[None])
        at_point, at_ray = (m.render(rays) for m in (model, at_rays))
        by_point = model.colours(at_point.features[None], appearance, content)[0]
        by_ray = at_rays.colours(at_ray.features[None], appearance, content)[0]
        _, b = model.transform.affine(content, model.transform.style_statistics(appearance))
        shift = model.decoder.linear.weight @ b[0]
    if model.spec.field == "hash":  # weights and background sum to 1: no light is lost
        torch.testing.assert_close(by_point, by_ray, **EXACT)
        torch.testing.assert_close(at_point.features[:, -1], torch.ones(40), **EXACT)
        return
    lost = 1 - at_ray.accumulation
    assert lost.max() > 0.01
    torch.testing.assert_close(at_point.features[:, -1], at_ray.accumulation, **EXACT)
    torch.testing.assert_close(by_ray.logit() - by_point.logit(), lost[:, None] * shift, atol=1e-8, rtol=1e-6)


def test_statistics_of_points_need_points():
    model = vivid_row("crnerf-r-fast")
    with pytest.raises(ValueError, match="points"):
        model.content_statistics(torch.rand(12, 9), (3, 4), "view")


# ------------------------------------------------------------------------------------- the identity of section 1


@pytest.mark.parametrize("row", CROSS_RAY)
def test_a_view_in_one_appearance_is_a_sigmoid_of_one_affine_map(row):
    """rgb = sigmoid(A F + b) for every ray, A (3, C), or (3, C + 1) where the last channel is the sum of weights."""
    model, rays = vivid_row(row), small_rays(24)
    with torch.no_grad():
        appearance = model.encode(small_batch(k=K).references[:1])
        features = model.render(rays).features
        points = model.point_features(rays) if model.spec.fused == "point" else None
        content = model.content_statistics(features, (4, 6), "view", points=points)
        A, b = model.colour_map(content, appearance)
        picture = model.colours(features[None], appearance, content)[0]
        # As soon as the map is known, a ray needs no other ray.
        one_by_one = torch.stack([torch.sigmoid(A[0] @ f + b[0]) for f in features])
    assert A.shape == (1, 3, model.spec.channels + (model.spec.fused == "point"))
    assert picture.std() > 1e-3
    torch.testing.assert_close(picture, one_by_one, **EXACT)


# ------------------------------------------------------------------------------------------- static and transient


def uncertain_spec(name: str) -> ModelSpec:
    """A row with a transient field, `crnerf-u` also with its appearance fused at points; densities without noise."""
    spec = small_spec(name.removesuffix("-point"))
    return replace(spec, fused="point") if name.endswith("-point") else spec


UNCERTAIN = ["nerfw", "nerfw-fast", "crnerf-u", "crnerf-u-fast", "crnerf-u-point", "crnerf-u-fast-point"]
LIKELIHOOD = LossWeights(photometric=0.7, transient_density=0.3, beta_min=0.07, appearance=0, content=0, embedding=0)


def slow_joint(static: Tensor, transient: Tensor, deltas: Tensor) -> tuple[list[Tensor], list[Tensor], Tensor]:
    """Along one ray: weights of both kinds of matter, and the light that passes all, factor by factor."""
    of_static, of_transient, light = [], [], torch.tensor(1.0)
    for s, t, delta in zip(static, transient, deltas, strict=True):
        through_static, through_transient = torch.exp(-delta * s), torch.exp(-delta * t)
        of_static.append(light * (1 - through_static))
        of_transient.append(light * (1 - through_transient))
        light = light * through_static * through_transient
    return of_static, of_transient, light


def slow_pictures(
    model: SceneModel, level: Level, head: tuple[Transient, Tensor, Tensor], appearance: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Of one patch: rgb (N, 3) of both fields together, and the sum of w beta (N,)."""
    transient, static_density, deltas = head

    def identity(features: Tensor) -> Tensor:
        return features

    at_point = at_ray = identity
    if model.transform is not None:
        # From the static field alone: at test there is nothing else.
        cloud = level.features.flatten(0, 1) if model.spec.fused == "point" else level.composite().features
        W, b = model.transform.affine(
            model.transform.content_statistics(cloud[None]), model.transform.style_statistics(appearance)
        )

        def mapped(features: Tensor) -> Tensor:
            return W[0] @ features + b[0]

        at_point, at_ray = (mapped, identity) if model.spec.fused == "point" else (identity, mapped)
    colours, betas = [], []
    for n in range(len(deltas)):
        of_static, of_transient, light = slow_joint(static_density[n], transient.density[n], deltas[n])
        seen = sum(w * at_point(f) for w, f in zip(of_static, level.features[n], strict=True))
        seen = seen + sum(w * at_point(f) for w, f in zip(of_transient, transient.features[n], strict=True))
        if level.background is not None:
            seen = seen + light * at_point(level.background[n])
        seen = at_ray(seen)
        if model.decoder is not None:
            seen = torch.sigmoid(model.decoder.linear.weight @ seen + model.decoder.linear.bias)
        colours.append(seen)
        betas.append(sum(w * beta for w, beta in zip(of_transient, transient.beta[n], strict=True)))
    return torch.stack(colours), torch.stack(betas)


@pytest.mark.parametrize("name", UNCERTAIN)
def test_a_step_with_a_transient_field_is_the_slow_one(name, compared):
    model, batch = vivid(uncertain_spec(name)), small_batch(k=K)
    terms, watched = model(batch, 0, None, LIKELIHOOD)
    seen_coarse = [call for call in compared if call[2] is None]
    pictures, betas, densities, coarse, squares, opacities = [], [], [], [], [], []
    for p in range(2):
        march, appearance = march_of(model, batch, p), appearance_of(model, batch, p)
        head = placed_of(model, rays_of(batch, p), model.transient_embedding.weight[batch.photos[p]])
        picture, beta = slow_pictures(model, march.levels[-1], head, appearance)
        pictures.append(picture)
        betas.append(beta + 0.07)  # the floor is added after compositing
        densities.append(head[0].density)
        joint = [slow_joint(*ray)[1] for ray in zip(head[1], head[0].density, head[2], strict=True)]
        opacities += [sum(weights) for weights in joint]
        for part, level in zip(([coarse] if len(march.levels) > 1 else []) + [squares], march.levels, strict=True):
            part.append((static_picture(model, level, appearance) - batch.colours[p]) ** 2)
    picture, beta = torch.stack(pictures), torch.stack(betas)
    expected = {
        "fine": 0.7 * ((picture - batch.colours) ** 2 / beta[..., None] ** 2).mean(),
        "uncertainty": 0.7 * 2 * (3 + torch.log(beta).mean()),
        "transient_density": 0.3 * torch.stack(densities).mean(),
    }
    if coarse:  # a plain mean square: no mask, no deviation
        expected["coarse"] = 0.7 * torch.stack(coarse).mean()
        assert len(seen_coarse) == 1
    assert_terms(terms, expected)
    torch.testing.assert_close(watched["mse"], torch.stack(squares).mean(), **EXACT)  # of what will be rendered
    torch.testing.assert_close(watched["mask"], torch.stack(opacities).mean(), **EXACT)
    assert torch.stack(opacities).std() > 1e-3


def static_picture(model: SceneModel, level: Level, appearance: Tensor | None) -> Tensor:
    """rgb (N, 3) of one patch's level, the transient field left out."""
    if model.spec.fused == "point" and model.transform is not None:
        return slow_point_picture(model, level, appearance)
    features = level.composite().features[None]
    return model.colours(features, appearance)[0]


def test_twice_the_photometric_weight_doubles_the_likelihood_and_nothing_else():
    for row in ("nerfw", "crnerf-u-fast"):
        model, batch = vivid_row(row), small_batch(k=K)
        once, twice = (step(model, batch, replace(LossWeights(), photometric=w)) for w in (0.25, 0.5))
        scaled = {"fine", "coarse", "uncertainty"} & once.keys()
        assert {"fine", "uncertainty"} <= scaled
        for name, value in once.items():
            torch.testing.assert_close(twice[name], (2 if name in scaled else 1) * value, **EXACT, msg=name)


def test_nerf_w_s_loss_as_its_code_writes_it(compared):
    """0.5 of the coarse error, error / (2 beta^2), 3 + mean log beta, 0.01 mean sigma: with our default weights."""
    model, batch = vivid_row("nerfw"), small_batch(k=K)
    terms = step(model, batch)
    (coarse, photo, mask), (fine, _, beta) = compared
    assert mask is None
    assert beta.min() >= 0.03
    torch.testing.assert_close(terms["coarse"], 0.5 * ((coarse - photo) ** 2).mean(), **EXACT)
    torch.testing.assert_close(terms["fine"], ((fine - photo) ** 2 / (2 * beta[..., None] ** 2)).mean(), **EXACT)
    torch.testing.assert_close(terms["uncertainty"], 3 + beta.log().mean(), **EXACT)


@pytest.mark.parametrize("name", UNCERTAIN)
def test_rendering_sees_the_static_field_alone(name, compared):
    """Another transient code, another transient head: another step, the same rendering."""
    model, batch = vivid(uncertain_spec(name)), small_batch(k=K)
    code = model.embedding.weight[1:2].detach() if model.coded else None
    rays = small_rays(20)
    before, trained_on = model.render(rays, code=code), step(model, batch, LIKELIHOOD)
    static = model.field.march(rays, codes=Codes(None if code is None else code.expand(20, -1))).levels[-1]
    if model.spec.fused == "point" and model.transform is not None:
        static = static.with_constant()
    for found, expected in zip(before, static.composite(), strict=True):
        torch.testing.assert_close(found, expected, **EXACT)
    with torch.no_grad():
        model.transient_embedding.weight.normal_(generator=seeded(7))
    changed = step(model, batch, LIKELIHOOD)
    assert (changed["fine"] - trained_on["fine"]).abs() > 1e-6
    with torch.no_grad():
        for parameter in model.field.transient.parameters():
            parameter.normal_(generator=seeded(8))
    for found, expected in zip(model.render(rays, code=code), before, strict=True):
        assert torch.equal(found, expected)


@pytest.mark.parametrize("row", ["crnerf-u", "crnerf-u-fast"])
def test_statistics_never_see_what_is_transient(row):
    """At test only the static field is there; the statistics that T learned from must be of the same kind."""
    model, batch = vivid_row(row), small_batch(k=K)
    step(model, batch)
    features = [march_of(model, batch, p).levels[-1].composite().features for p in range(2)]
    expected = model.transform.content_statistics(torch.stack(features))
    torch.testing.assert_close(model.running_mean[0], expected.mean.mean(0), **EXACT)
    torch.testing.assert_close(model.running_gram[0], expected.gram.mean(0), **EXACT)


@pytest.mark.parametrize("row", ["nerfw", "nerfw-fast", "crnerf-u", "crnerf-u-fast"])
def test_the_light_that_the_transient_field_of_a_photo_gives(row):
    model, rays = vivid_row(row), small_rays(20)
    found = model.transient_opacity(rays, photo=2)
    head = placed_of(model, rays, model.transient_embedding.weight[2])
    weights = [slow_joint(*ray)[1] for ray in zip(head[1], head[0].density, head[2], strict=True)]
    torch.testing.assert_close(found, torch.stack([sum(w) for w in weights]), **EXACT)
    assert (found - model.transient_opacity(rays, photo=0)).abs().max() > 1e-3


@pytest.mark.parametrize("field", ["mlp", "hash"])
def test_the_transient_field_beside_a_code_that_is_read_from_photos_has_an_opacity_too(field):
    """Its density depends on no appearance, and training shows it as the photo's mask."""
    spec = replace(small_spec("hanerf"), field=field, transient="uncertainty")
    assert vivid(spec).transient_opacity(small_rays(5), photo=1).shape == (5,)


# ------------------------------------------------------------------------------------ codes: one for each photo


@pytest.mark.parametrize("row", CODED)
def test_each_patch_is_seen_in_its_own_photo_s_code(row, compared):
    model, batch = vivid_row(row), small_batch(k=16)._replace(photos=torch.tensor([3, 1]))
    step(model, batch)
    picture = compared[-1][0]
    for p in range(2):
        level = march_of(model, batch, p).levels[-1]
        alone = level.composite().features
        if model.transient_embedding is not None:
            transient = model.transient_embedding.weight[batch.photos[p]]
            alone, _ = slow_pictures(model, level, placed_of(model, rays_of(batch, p), transient), None)
        torch.testing.assert_close(picture[p], alone, **EXACT)


@pytest.mark.parametrize("row", ["hanerf", "hanerf-fast"])
def test_two_references_swapped_swap_two_pictures_of_one_view(row, compared):
    model, batch = vivid_row(row), small_batch(k=16)
    twice = Rays(*(torch.cat([r[:256], r[:256]]) for r in batch.rays))
    weights = LossWeights(appearance=0, mode_seeking=0)
    pictures = []
    for references in (batch.references, batch.references[::-1]):
        step(model, batch._replace(rays=twice, references=references), weights)
        pictures.append(compared[-1][0])
    first, swapped = pictures
    torch.testing.assert_close(first, swapped.flip(0), **EXACT)
    assert (first[0] - first[1]).abs().max() > 1e-3


@pytest.mark.parametrize("row", ["nerfw", "nerfw-fast"])
def test_a_step_teaches_the_codes_of_its_photos_alone(row):
    model, batch = vivid_row(row), small_batch(k=K)._replace(photos=torch.tensor([3, 1]))
    torch.stack(list(step(model, batch).values())).sum().backward()
    for embedding, width in ((model.embedding, CODE), (model.transient_embedding, TRANSIENT_CODE)):
        assert embedding.weight.grad.shape == (PHOTOS, width)
        assert (embedding.weight.grad.abs().sum(-1) > 0).tolist() == [False, True, False, True]


@pytest.mark.parametrize("row", CODED)
def test_without_a_code_nothing_is_rendered_and_the_error_names_the_key(row):
    model = vivid_row(row)
    with pytest.raises(ValueError, match=r"model\.appearance: (embedding|code) needs the code"):
        model.render(small_rays(3))


@pytest.mark.parametrize("row", CODED)
def test_rendering_and_fitting_are_in_the_code_that_is_given(row):
    """`render` shows the static field, `picture` what a photo shows: with its transients where there is a field."""
    model, rays = vivid_row(row), small_rays(12)
    code = torch.randn(1, CODE, generator=seeded(5))
    level = model.field.march(rays, codes=Codes(torch.cat([code] * 12))).levels[-1]
    for found, expected in zip(model.render(rays, chunk=5, code=code), level.composite(), strict=True):
        torch.testing.assert_close(found, expected, **EXACT)
    torch.testing.assert_close(model.picture(model.field.place(rays), code, None), level.composite().features, **EXACT)
    if model.transient_embedding is None:
        return
    transient = torch.randn(1, TRANSIENT_CODE, generator=seeded(6))
    expected, _ = slow_pictures(model, level, placed_of(model, rays, transient), None)
    torch.testing.assert_close(model.picture(model.field.place(rays), code, transient), expected, **EXACT)


# ------------------------------------------------------------------------------------------ Ha-NeRF: the other code

SOUGHT = LossWeights(appearance=0.5, mode_seeking=0.25, embedding=0.125)


@pytest.mark.parametrize("target", ["other", "own"])
@pytest.mark.parametrize("row", ["hanerf", "hanerf-fast"])
def test_a_step_with_codes_is_the_slow_one(row, target):
    weights = replace(SOUGHT, appearance_target=target)
    model, batch = vivid_row(row), small_batch(k=16)
    pictures, lent_pictures, codes, lent_codes, errors, masks = [], [], [], [], {}, []
    for p in range(2):
        lent = model.encode([batch.others[p]]).detach()
        march = march_of(model, batch, p)
        in_lent = model.field.march(rays_of(batch, p), codes=Codes(torch.cat([lent] * 256))).levels[-1]
        uv = torch.tensor([[y, x] for x, y in batch.positions[p].tolist()])  # row first
        masks.append(model.uvmask(batch.photos[p : p + 1], uv[None])[0])
        for name, level in zip(("coarse", "fine")[-len(march.levels) :], march.levels, strict=True):
            error = (level.composite().features - batch.colours[p]) ** 2
            errors.setdefault(name, []).append((1 - masks[p])[:, None] * error)
        pictures.append(march.levels[-1].composite().features)
        lent_pictures.append(in_lent.composite().features)
        codes.append(model.encode([batch.references[p]]))
        lent_codes.append(lent)
    asked, shown = (codes, pictures) if target == "own" else (lent_codes, lent_pictures)
    again = torch.cat([model.encoder(as_read(model, rgb)) for rgb in shown])
    off = torch.cat(asked).detach() - again
    apart = (torch.stack(pictures) - torch.stack(lent_pictures)).abs().mean()
    ratio = apart / (torch.cat(codes) - torch.cat(lent_codes)).abs().mean()
    expected = {
        "mask": weights.mask_weight(0) * (torch.stack(masks) ** 2).mean(),
        **{name: 0.5 * torch.stack(values).mean() for name, values in errors.items()},
        "embedding": 0.125 * (torch.cat(codes) ** 2).mean(),
        "appearance": 0.5 * (off.square() if target == "own" else off.abs()).mean(),
        "mode_seeking": 0.25 / (ratio + 1e-5),
    }
    assert_terms(step(model, batch, weights), expected)


def learned_by(term: Tensor, model: SceneModel) -> set[str]:
    """Which parts a term's gradient reaches; `fine.` and `coarse.` are those of the paper's field."""
    names, parameters = zip(*model.named_parameters(), strict=True)
    gradients = torch.autograd.grad(term, parameters, allow_unused=True, retain_graph=True)
    reached = [n for n, g in zip(names, gradients, strict=True) if g is not None and g.abs().sum() > 0]
    return {".".join(n.removeprefix("field.").split(".")[: 2 if n.startswith("field.fine") else 1]) for n in reached}


@pytest.mark.parametrize(("term", "reads_again"), [("appearance", {"encoder"}), ("mode_seeking", set())])
def test_what_the_other_appearance_teaches(term, reads_again, monkeypatch):
    """Its features teach the layers that see the code, and no others: what they are computed from is detached, as in
    the released code. They are composited with the place's weights, which are not detached: through these, density and
    trunk learn too. No code learns from it, for the other photo's is read without gradient.
    """
    model, batch = vivid_row("hanerf"), small_batch(k=16)
    colour = {"fine.directional", "fine.head"}
    reached = learned_by(step(model, batch, SOUGHT)[term], model)
    assert reached == colour | {"fine.layers", "fine.density"} | reads_again

    original = nerf_module.render_weights
    monkeypatch.setattr(nerf_module, "render_weights", lambda *args: original(*args).detach())
    assert learned_by(step(model, batch, SOUGHT)[term], model) == colour | reads_again


@pytest.mark.parametrize("term", ["appearance", "mode_seeking"])
def test_what_the_other_appearance_teaches_the_fast_field(term):
    """As above; density is the first output of the trunk, and what the colour layers read are the others."""
    model, batch = vivid_row("hanerf-fast"), small_batch(k=16)
    value = step(model, batch, SOUGHT)[term]
    reached = learned_by(value, model) - {"encoder"}
    assert reached == {"coloured", "background", "trunk", "grid"}
    (last,) = torch.autograd.grad(value, model.field.trunk[-1].weight, retain_graph=True)
    assert last[0].abs().sum() > 0
    assert last[1:].abs().sum() == 0


def test_the_other_appearance_comes_from_the_other_photos():
    model, batch = vivid_row("hanerf"), small_batch(k=16)
    changed = batch._replace(others=[1 - image for image in batch.others])
    before, after = step(model, batch, SOUGHT), step(model, changed, SOUGHT)
    for name in before:
        assert (before[name] != after[name]) == (name in ("appearance", "mode_seeking")), name


def test_a_place_is_taught_by_the_photo_in_its_own_code():
    model, batch = vivid_row("hanerf"), small_batch(k=16)
    terms = step(model, batch, SOUGHT)
    fine = {f"fine.{part}" for part in ("layers", "density", "bottleneck", "directional", "head")}
    assert learned_by(terms["fine"], model) == fine | {"encoder", "uvmask"}
    assert learned_by(terms["coarse"], model) == {"coarse"}  # unconditioned, and its mask teaches nothing
    assert learned_by(terms["mask"], model) == {"uvmask"}
    assert learned_by(terms["embedding"], model) == {"encoder"}


# -------------------------------------------------------------------------------------------------- uv masks


def test_a_uv_mask_is_asked_for_rows_before_columns():
    model, batch = vivid_row("hanerf"), small_batch(k=4)._replace(photos=torch.tensor([3, 1]))
    with torch.no_grad():
        found = model.masks(batch)
        for p, photo in enumerate((3, 1)):
            for n, (x, y) in enumerate(batch.positions[p].tolist()):
                alone = model.uvmask(torch.tensor([photo]), torch.tensor([[[y, x]]]))
                torch.testing.assert_close(found[p, n], alone[0, 0], **EXACT)
    assert found.std() > 1e-3


def test_a_whole_uv_mask_has_the_pixels_of_training():
    """Row r and column c of h x w are at ((r + 0.5) / h, (c + 0.5) / w), where a batch has its positions."""
    model = vivid_row("hanerf")
    whole = model.transient_mask((3, 5), torch.rand(3, 7, 9), photo=2)
    assert whole.shape == (3, 5)
    positions = torch.tensor([[(c + 0.5) / 5, (r + 0.5) / 3] for r in range(3) for c in range(5)])
    batch = small_batch(patches=1)._replace(photos=torch.tensor([2]), positions=positions[None])
    torch.testing.assert_close(whole.flatten(), model.masks(batch)[0].detach(), **EXACT)
    assert model.transient_mask((3, 5), torch.rand(3, 7, 9), photo=None) is None


def test_a_uv_mask_teaches_the_rows_of_its_photos():
    model, batch = vivid_row("hanerf"), small_batch(k=16)._replace(photos=torch.tensor([0, 2]))
    for name in ("fine", "mask"):
        (gradient,) = torch.autograd.grad(step(model, batch)[name], model.uvmask.embedding.weight)
        assert (gradient.abs().sum(-1) > 0).tolist() == [True, False, True, False], name


# ------------------------------------------------------------------------------------------------ fixed masks


@pytest.mark.parametrize("row", ["crnerf-a-masks", "crnerf-a-masks-fast"])
def test_fixed_masks_weigh_both_levels_and_have_no_size_to_pay_for(row):
    model, batch = vivid_row(row), small_batch(k=K)
    terms = step(model, batch)
    assert "mask" not in terms
    for name, level in zip(("fine", "coarse"), reversed(model.field.march(batch.rays).levels), strict=False):
        picture = model.colours(level.composite().features.view(2, K * K, -1), model.encode(batch.references))
        squared = (picture - batch.colours) ** 2
        by_ray = [(1 - batch.masks[p, n]) * squared[p, n].mean() for p in range(2) for n in range(K * K)]
        torch.testing.assert_close(terms[name], 0.5 * torch.stack(by_ray).mean(), **EXACT)
    assert model(batch, 0, None, LossWeights())[1]["mask"] == batch.masks.mean()


def test_fixed_masks_that_are_missing_are_said():
    with pytest.raises(ValueError, match=r"model\.transient: fixed, but the batch has no masks"):
        step(vivid_row("crnerf-a-masks-fast"), small_batch(k=K)._replace(masks=None))


@pytest.mark.parametrize("row", ["crnerf-b", "crossray", "hanerf-fast", "nerfw-fast"])
def test_masks_of_the_data_are_nobody_else_s_business(row):
    model, batch = vivid_row(row), small_batch(k=16)
    with torch.no_grad():
        assert step(model, batch) == step(model, batch._replace(masks=None))
