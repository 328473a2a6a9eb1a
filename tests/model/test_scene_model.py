"""The assembled model: chunks, statistics, masks, losses, running averages."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from small_models import BOX, ROWS, TRANSFORMS, small_batch, small_model, small_rays, small_spec
from torch import Tensor
from torch.nn import functional as F

from model.appearance.compact import at_size
from model.cameras import patch_grid
from model.losses import LossWeights
from model.scene_model import COMPACT_SIZE, RUNNING_MOMENTUM, Batch, SceneModel, as_images

CROSS_RAY = [
    *(row for row in ROWS if small_spec(row).appearance == "crossray" and small_spec(row).fused == "ray"),
    *TRANSFORMS,
]
MASKED = ["crnerf-t", "crnerf", "crossray", "crossray-fast"]


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def appearance_of(model: SceneModel, photos: int = 1) -> Tensor | None:
    images = [torch.rand(3, 17, 22, generator=seeded(i)) for i in range(photos)]
    if model.embedding is not None:
        return model.embedding(torch.arange(photos))
    return None if model.encoder is None else model.encode(images)


def code_of(model: SceneModel) -> Tensor | None:
    """What its field reads of the first appearance."""
    return appearance_of(model) if model.coded else None


# --------------------------------------------------------------------------------------------------- rendering


@pytest.mark.parametrize("row", ROWS)
def test_chunks_do_not_change_a_picture(row):
    model, rays = small_model(row), small_rays(6 * 9)
    with torch.no_grad():
        embedding, code = appearance_of(model), code_of(model)
        whole = model.render(rays, chunk=1000, code=code)
        points = model.point_features(rays) if model.spec.fused == "point" and model.transform else None
        statistics = model.content_statistics(whole.features, (6, 9), "view", points=points)
        picture = model.colours(whole.features[None], embedding, statistics)
        assert whole.features.std() > 1e-3
        assert picture.shape == (1, 54, 3)
        assert picture.min() >= 0
        assert picture.max() <= 1
        for chunk in (1, 7, 54):
            parts = model.render(rays, chunk=chunk, code=code)
            for name, a, b in zip(whole._fields, parts, whole, strict=True):
                torch.testing.assert_close(a, b, atol=1e-5, rtol=0, msg=lambda m, name=name: f"{name}: {m}")
            again = model.content_statistics(parts.features, (6, 9), "view", points=points)
            colours = model.colours(parts.features[None], embedding, again)
            torch.testing.assert_close(colours, picture, atol=1e-5, rtol=0)


def test_rendering_shows_the_last_level_without_noise_or_jitter():
    for row in ("crnerf", "crossray"):
        model, rays = small_model(row), small_rays(10)
        for samples in (None, (9, 5)):
            expected = model.field.march(rays, samples=samples).levels[-1].composite()
            for a, b in zip(model.render(rays, samples=samples), expected, strict=True):
                torch.testing.assert_close(a, b)
                assert not a.requires_grad


@pytest.mark.parametrize("row", ["crnerf", "crossray-fast"])
def test_bfloat16_changes_little_and_ends_in_float32(row):
    model, rays = small_model(row), small_rays(40)
    exact = model.render(rays)
    model.use_bfloat16 = True
    for a, b in zip(model.render(rays), exact, strict=True):
        assert a.dtype == torch.float32
        assert (a - b).abs().mean() < 0.02 * b.abs().mean() + 0.02
    terms, _ = model(small_batch(), 0, seeded(), LossWeights())
    assert all(value.dtype == torch.float32 and value.isfinite() for value in terms.values())


@pytest.mark.parametrize("row", ["crnerf", "crossray-fast"])
def test_bfloat16_ends_at_the_field(row):
    """Compositing is done in float32 also when a view is rendered."""
    model, rays = small_model(row), small_rays(40)
    model.use_bfloat16 = True
    with torch.no_grad():
        with model.autocast(rays.near.device):
            level = model.field.march(rays).levels[-1]
        expected = level.composite().features
    assert torch.equal(model.render(rays).features, expected)


# -------------------------------------------------------------------------------------------------- statistics


@pytest.mark.parametrize("row", CROSS_RAY)
def test_statistics_by_policy(row):
    model = small_model(row)
    h, w = 11, 17
    features = torch.rand(h * w, model.spec.channels, generator=seeded())
    with torch.no_grad():
        view = model.content_statistics(features, (h, w), "view")
        torch.testing.assert_close(view, model.transform.content_statistics(features[None]))
        patch = model.content_statistics(features, (h, w), "patch", patch=4)
        # A grid of 4 x 4 from the first row and column to the last; the 10 and the 16 are floor(size - 1).
        rows, cols = [0, 3, 6, 10], [0, 5, 10, 16]
        assert torch.equal(patch_grid(4, 1.0, 0.0, 0.0, h, w)[0][::4], torch.tensor(rows))
        picked = torch.stack([features[r * w + c] for r in rows for c in cols])
        torch.testing.assert_close(patch, model.transform.content_statistics(picked[None]))
        with pytest.raises(ValueError, match="not been trained"):
            model.content_statistics(features, (h, w), "running")
        model.running_mean.normal_()
        model.running_gram.normal_()
        model.running_count.fill_(1)
        running = model.content_statistics(features, (h, w), "running")
        assert torch.equal(running.mean, model.running_mean)
        assert torch.equal(running.gram, model.running_gram)


@pytest.mark.parametrize("row", ["nerf", "crnerf-b", "crnerf-t"])
def test_there_are_no_statistics_without_an_appearance(row):
    model = small_model(row)
    assert model.content_statistics(torch.rand(12, model.spec.channels), (3, 4), "view") is None
    with pytest.raises(ValueError, match="reads nothing"):
        model.encode([torch.rand(3, 16, 16)])


@pytest.mark.parametrize("row", CROSS_RAY)
def test_each_view_is_coloured_by_its_own_features_and_photo(row):
    model = small_model(row)
    features = torch.rand(2, 30, model.spec.channels, generator=seeded())
    with torch.no_grad():
        embedding = appearance_of(model, photos=2)
        together = model.colours(features, embedding)
        for i in range(2):
            alone = model.colours(features[i : i + 1], embedding[i : i + 1])
            torch.testing.assert_close(together[i : i + 1], alone, atol=1e-5, rtol=0)


@pytest.mark.parametrize("row", CROSS_RAY)
def test_colours_are_a_sigmoid_of_the_colour_map(row):
    model = small_model(row)
    features = torch.rand(1, 30, model.spec.channels, generator=seeded())
    with torch.no_grad():
        embedding = appearance_of(model)
        content = model.transform.content_statistics(features)
        A, b = model.colour_map(content, embedding)
        assert (A.shape, b.shape) == ((1, 3, model.spec.channels), (1, 3))
        expected = torch.stack([torch.sigmoid(A[0] @ f + b[0]) for f in features[0]])[None]
        torch.testing.assert_close(model.colours(features, embedding), expected, atol=1e-5, rtol=0)
        W, shift = model.transform.affine(content, model.transform.style_statistics(embedding))
        steps = model.decoder(features @ W.mT + shift[:, None])  # transform, then decode
        torch.testing.assert_close(expected, steps, atol=1e-5, rtol=0)


def test_given_statistics_are_used():
    model = small_model("crnerf")
    features, other = torch.rand(2, 1, 30, 64, generator=seeded()).unbind(0)
    with torch.no_grad():
        embedding = appearance_of(model)
        own = model.colours(features, embedding)
        given = model.colours(features, embedding, model.transform.content_statistics(other))
        torch.testing.assert_close(own, model.colours(features, embedding, None))
    assert (own - given).abs().max() > 1e-5


# --------------------------------------------------------------------------------------------- running averages


@pytest.mark.parametrize("row", ["crnerf-a", "crossray-fast"])
def test_the_first_update_is_the_batch_and_the_second_the_mean_of_both(row):
    model = small_model(row)
    first, second = torch.rand(2, 3, 20, model.spec.channels, generator=seeded()).unbind(0)
    statistics = [model.transform.content_statistics(f) for f in (first, second)]
    means = [s.mean.mean(0, keepdim=True) for s in statistics]
    grams = [s.gram.mean(0, keepdim=True) for s in statistics]
    model.track(statistics[0])
    assert model.running_count == 1
    torch.testing.assert_close(model.running_mean, means[0])
    torch.testing.assert_close(model.running_gram, grams[0])
    model.track(statistics[1])
    assert model.running_count == 2
    torch.testing.assert_close(model.running_mean, (means[0] + means[1]) / 2)
    torch.testing.assert_close(model.running_gram, (grams[0] + grams[1]) / 2)
    assert not model.running_mean.requires_grad
    model.running_count.fill_(10_000)
    before = model.running_mean.clone()
    model.track(statistics[0])
    torch.testing.assert_close(model.running_mean, before + RUNNING_MOMENTUM * (means[0] - before))


def test_a_step_tracks_the_fine_features_once():
    model, batch = small_model("crnerf"), small_batch()
    model(batch, 0, seeded(), LossWeights())
    assert model.running_count == 1
    fine = model.field.march(batch.rays, seeded()).levels[-1].composite().features.view(2, 256, 64)
    expected = fine.mean(dim=(0, 1))[None]
    torch.testing.assert_close(model.running_mean, expected.detach())
    assert {"running_mean", "running_gram", "running_count"} <= model.state_dict().keys()


# ------------------------------------------------------------------------------------------------------- masks


@pytest.mark.parametrize("row", MASKED)
def test_the_mask_lookup_is_resize_then_index(row):
    """The released code resizes the probability to the photo and indexes; here only the pixels at hand are computed."""
    model = small_model(row).eval()
    sizes = [(90, 121), (133, 70)]  # of the photos, about eight and five times those of the references
    references = [torch.rand(3, 17, 22, generator=seeded(0)), torch.rand(3, 26, 18, generator=seeded(1))]
    if model.spec.segmenter == "unet":
        references = [F.interpolate(r[None], size=(30, 44))[0] for r in references]
    positions, expected = [], []
    with torch.no_grad():
        for i, (h, w) in enumerate(sizes):
            rows = torch.randint(h, (40,), generator=seeded(i))
            cols = torch.randint(w, (40,), generator=seeded(i + 9))
            rows[:2], cols[:2] = torch.tensor([0, h - 1]), torch.tensor([0, w - 1])  # corners, where borders matter
            positions.append(torch.stack([(cols + 0.5) / w, (rows + 0.5) / h], dim=-1))
            seen = references[i][None]
            if model.spec.encoder == "compact":
                seen = at_size([references[i]], COMPACT_SIZE)
            logit = F.interpolate(model.segmenter(seen), size=seen.shape[2:], mode="bilinear", align_corners=False)
            mask = F.interpolate(logit.sigmoid(), size=(h, w), mode="bilinear", align_corners=False)[0, 0]
            torch.testing.assert_close(model.transient_mask((h, w), references[i], None), mask, atol=1e-5, rtol=0)
            expected.append(mask[rows, cols])
        batch = small_batch()._replace(references=references, positions=torch.stack(positions))
        found = model.masks(batch)
    assert found.shape == (2, 40)
    assert found.std() > 1e-3
    torch.testing.assert_close(found, torch.stack(expected), atol=1e-5, rtol=0)


def test_there_is_no_mask_without_a_segmenter():
    assert small_model("crnerf-a").masks(small_batch()) is None


@pytest.mark.parametrize("row", ["crnerf-t", "crnerf"])
def test_only_the_fine_level_teaches_the_segmenter(row):
    model = small_model(row)
    terms, _ = model(small_batch(), 0, seeded(), LossWeights())
    parameters = list(model.segmenter.parameters())
    assert all(
        g is None for g in torch.autograd.grad(terms["coarse"], parameters, allow_unused=True, retain_graph=True)
    )
    for name in ("fine", "mask"):
        gradients = torch.autograd.grad(terms[name], parameters, allow_unused=True, retain_graph=True)
        assert all(g is not None for g in gradients), name


def test_the_mask_weighs_the_coarse_level_too():
    model, batch = small_model("crnerf-t").eval(), small_batch()
    plain = small_model("crnerf-b")
    plain.load_state_dict({k: v for k, v in model.state_dict().items() if not k.startswith("segmenter")})
    with torch.no_grad():
        masked, _ = model(batch, 0, seeded(), LossWeights())
        full, _ = plain(batch, 0, seeded(), LossWeights())
    for name in ("fine", "coarse"):
        assert masked[name] < full[name]


# ------------------------------------------------------------------------------------------------------ losses


def slow_terms(model: SceneModel, batch: Batch, step: int, weights: LossWeights) -> dict[str, Tensor]:
    """The terms patch by patch, as the table in the method's reference writes them."""
    march = model.field.march(batch.rays, seeded())
    count, n = batch.colours.shape[:2]
    per_patch: dict[str, list[Tensor]] = {}

    def add(name: str, value: Tensor) -> None:
        per_patch.setdefault(name, []).append(value)

    def image(rgb: Tensor) -> list[Tensor]:
        return [rgb.mT.reshape(3, 16, 16)]

    def content_features(rgb: Tensor) -> Tensor:
        (x,) = image(rgb)
        x = at_size([x], COMPACT_SIZE) if model.spec.encoder == "compact" else x[None]
        return model.content_encoder(x)

    masks = model.masks(batch)
    for p in range(count):
        part = slice(p * n, (p + 1) * n)
        M, C = masks[p], batch.colours[p]
        embedding, other = (model.encode([images[p]]) for images in (batch.references, batch.others))
        levels = [level.composite().features[part][None] for level in march.levels]
        for name, F_cr, mask in zip(("coarse", "fine"), levels, (M.detach(), M), strict=True):
            picture = model.colours(F_cr, embedding)[0]
            add(name, 0.5 * ((1 - mask)[:, None] * (picture - C) ** 2).mean())
        add("mask", max(6e-3, 5e-2 * 2.718281828 ** (-1e-3 * step)) * (M**2).mean())
        add("embedding", weights.embedding * (embedding**2).mean())
        other = other.detach()  # in T as well as in the loss: the released code's bank holds no gradient
        in_other = model.colours(levels[1], other)[0]
        add("appearance", weights.appearance * (other - model.encode(image(in_other))).abs().mean())
        plain, styled = model.decoder(levels[1])[0], model.colours(levels[1], embedding)[0]
        add("content", weights.content * ((content_features(plain) - content_features(styled)) ** 2).mean())
    return {name: torch.stack(values).mean() for name, values in per_patch.items()}


def test_the_terms_of_a_step_equal_the_table():
    weights = LossWeights(appearance=0.5, content=0.3, embedding=0.2)
    model, batch = small_model("crnerf").eval(), small_batch()
    terms, watched = model(batch, 500, seeded(), weights)
    expected = slow_terms(model, batch, 500, weights)
    assert terms.keys() == expected.keys()
    for name, value in expected.items():
        torch.testing.assert_close(terms[name], value, atol=1e-6, rtol=1e-4, msg=lambda m, name=name: f"{name}: {m}")
    torch.testing.assert_close(watched["mask"], model.masks(batch).mean().detach())
    torch.testing.assert_close(
        *(torch.autograd.grad(t["appearance"], model.encoder.layers[0].weight)[0] for t in (terms, expected)),
        atol=1e-8,  # what would come through the other photo's embedding is 8e-8, of gradients up to 1e-4
        rtol=0,
    )


def test_gradients_of_the_appearance_terms_go_where_the_released_code_sends_them():
    model = small_model("crnerf")
    terms, _ = model(small_batch(), 0, seeded(), LossWeights())
    parts = {
        name: list(getattr(model, name).parameters())
        for name in ("encoder", "content_encoder", "transform", "decoder", "segmenter")
    } | {"fine": list(model.field.fine.parameters()), "coarse": list(model.field.coarse.parameters())}
    reached = {
        "appearance": {"encoder", "transform", "decoder", "fine"},
        "content": {"encoder", "content_encoder", "transform", "decoder", "fine"},
        "embedding": {"encoder"},
        "mask": {"segmenter"},
        "fine": {"encoder", "transform", "decoder", "fine", "segmenter"},
        "coarse": {"encoder", "transform", "decoder", "coarse"},
    }
    for term, expected in reached.items():
        found = set()
        for part, parameters in parts.items():
            gradients = torch.autograd.grad(terms[term], parameters, allow_unused=True, retain_graph=True)
            if any(g is not None and g.abs().sum() > 0 for g in gradients):
                found.add(part)
        assert found == expected, term


@pytest.mark.parametrize(
    ("row", "term", "zero"),
    [
        ("crnerf", "appearance", {"appearance": 0.0}),
        ("crnerf", "content", {"content": 0.0}),
        ("crnerf", "embedding", {"embedding": 0.0}),
        ("crnerf", "mask", {"mask_start": 0.0, "mask_end": 0.0}),
        ("crossray", "interlevel", {"interlevel": 0.0}),
    ],
)
def test_terms_of_weight_zero_are_absent(row, term, zero):
    """LossWeights: a term with weight 0 is not computed."""
    model = small_model(row)
    with torch.no_grad():
        with_all, _ = model(small_batch(), 0, seeded(), LossWeights())
        without, _ = model(small_batch(), 0, seeded(), LossWeights(**zero))
    assert term in with_all
    assert without.keys() == with_all.keys() - {term}


def test_a_step_depends_on_its_generator_alone():
    for row in ("crnerf", "crossray"):
        model, batch = small_model(row).eval(), small_batch()
        with torch.no_grad():
            first, same, other = (model(batch, 0, seeded(s), LossWeights())[0] for s in (1, 1, 2))
        assert first == same
        assert first["fine"] != other["fine"]


# ------------------------------------------------------------------------------------------------------- parts


@pytest.mark.parametrize("row", ROWS)
def test_parameter_groups_cover_every_parameter_once(row):
    model = small_model(row)
    groups = model.parameter_groups()
    grouped = [id(p) for group in groups.values() for p in group]
    assert sorted(grouped) == sorted(id(p) for p in model.parameters())
    names = {id(p): name for name, p in model.named_parameters()}
    parts = {
        "grid": ("field.grid.table", "field.proposal_grid.table"),
        "field": ("field.", "decoder."),
        "appearance": ("encoder.", "content_encoder.", "transform."),
        "embedding": ("embedding.weight", "transient_embedding.weight", "uvmask.embedding.weight"),
        "transient": ("segmenter.", "uvmask."),
    }
    for group, parameters in groups.items():
        assert parameters, group
        assert all(names[id(p)].startswith(parts[group]) for p in parameters), group
    spec = model.spec
    assert ("grid" in groups) == (spec.field == "hash")
    assert ("appearance" in groups) == (spec.appearance in ("code", "crossray"))
    assert ("embedding" in groups) == (spec.appearance == "embedding" or spec.transient in ("uncertainty", "uvmask"))
    assert ("transient" in groups) == (spec.transient in ("segmenter", "uvmask"))


def test_as_images_is_row_major():
    colours = torch.arange(2 * 9 * 3).view(2, 9, 3)
    images = as_images(colours)
    assert [tuple(image.shape) for image in images] == [(3, 3, 3)] * 2
    for row in range(3):
        for col in range(3):
            assert torch.equal(images[1][:, row, col], colours[1, 3 * row + col])


def test_a_spec_decides_the_parts():
    model = SceneModel(replace(small_spec("nerf"), field="hash"), BOX)
    assert model.decoder is None
    picture = model.colours(model.render(small_rays(12)).features[None], None)
    assert picture.shape == (1, 12, 3)
    assert picture.min() >= 0
    assert picture.max() <= 1 + 1e-6
