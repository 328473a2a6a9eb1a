"""Every loss term: by hand, and against the released code's numbers."""

from __future__ import annotations

import math

import pytest
import torch
from small_models import ROWS, small_batch, small_model

from model.losses import (
    PRESETS,
    LossWeights,
    appearance_consistency,
    content_preservation,
    embedding_size,
    log_uncertainty,
    loss_terms,
    mask_size,
    mode_seeking,
    photometric,
    uncertain_photometric,
)
from model.scene_model import needs_other

STEPS = (0, 1000, 2120, 2121, 5000)


def test_photometric_by_hand():
    rendered = torch.tensor([[1.0, 0.5, 0.0], [0.0, 0.0, 1.0]])
    photo = torch.tensor([[0.0, 0.5, 0.0], [0.0, 1.0, 0.0]])
    # Squares: 1, 0, 0 and 0, 1, 1.
    assert photometric(rendered, photo, None).item() == pytest.approx(3 / 6)
    mask = torch.tensor([0.75, 0.5])
    assert photometric(rendered, photo, mask).item() == pytest.approx((0.25 * 1 + 0.5 * 2) / 6)
    assert photometric(rendered, photo, torch.ones(2)).item() == 0  # all transient: nothing counts
    torch.testing.assert_close(photometric(rendered, photo, torch.zeros(2)), photometric(rendered, photo, None))


def test_photometric_masks_the_right_ray_of_the_right_patch():
    rendered, mask = torch.zeros(2, 3, 3), torch.zeros(2, 3)
    rendered[1, 2] = 1.0
    assert photometric(rendered, torch.zeros(2, 3, 3), mask).item() == pytest.approx(3 / 18)
    mask[1, 2] = 1.0
    assert photometric(rendered, torch.zeros(2, 3, 3), mask).item() == 0


def test_the_other_terms_by_hand():
    a, b = torch.tensor([[1.0, -2.0], [0.0, 0.5]]), torch.tensor([[0.0, -2.0], [2.0, 1.5]])
    assert mask_size(torch.tensor([0.5, 1.0])).item() == pytest.approx((0.25 + 1) / 2)
    assert appearance_consistency(a, b, "other").item() == pytest.approx((1 + 0 + 2 + 1) / 4)
    assert appearance_consistency(a, b, "own").item() == pytest.approx((1 + 0 + 4 + 1) / 4)
    assert content_preservation(a, b).item() == pytest.approx((1 + 0 + 4 + 1) / 4)
    assert embedding_size(a).item() == pytest.approx((1 + 4 + 0.25) / 4)


@pytest.mark.parametrize("target", ["other", "own"])
def test_the_appearance_target_is_detached_and_content_is_not(target):
    a, b = torch.rand(4, requires_grad=True), torch.rand(4, requires_grad=True)
    appearance_consistency(a, b, target).backward()
    assert a.grad is None
    assert b.grad is not None
    b.grad = None
    content_preservation(a, b).backward()
    torch.testing.assert_close(a.grad, -b.grad)
    assert a.grad.abs().min() > 0


def test_the_mask_schedule_by_hand():
    weights = LossWeights()
    assert weights.mask_weight(0) == 5e-2
    assert weights.mask_weight(1000) == pytest.approx(5e-2 / math.e)
    assert weights.mask_weight(2120) > 6e-3
    assert weights.mask_weight(2121) == 6e-3
    assert weights.mask_weight(10**6) == 6e-3
    own = LossWeights(mask_start=0.6, mask_end=0.04, mask_decay=0.0)
    assert own.mask_weight(12345) == 0.6


def test_the_defaults_are_the_released_weights():
    weights = LossWeights()
    assert (weights.appearance, weights.content, weights.embedding) == (1e-3, 1e-4, 1e-5)
    assert (weights.photometric, weights.appearance_target, weights.mode_seeking) == (0.5, "other", 1e-6)
    assert (weights.transient_density, weights.beta_min) == (0.01, 0.03)
    assert (weights.mask_start, weights.mask_end, weights.mask_decay) == (5e-2, 6e-3, 1e-3)


def test_mode_seeking_by_hand():
    picture, other = torch.tensor([0.5, 0.5]), torch.tensor([0.3, 0.6], requires_grad=True)
    code, other_code = torch.tensor([1.0, 2.0]), torch.tensor([1.5, 1.5])
    value = mode_seeking(picture, other, code, other_code)
    assert value.item() == pytest.approx(1 / (0.15 / 0.5 + 1e-5))  # mean |difference| of pictures over that of codes
    value.backward()
    assert other.grad[0] > 0  # the other picture is below: falling further makes them differ more
    assert other.grad[1] < 0


def test_mode_seeking_of_one_photo_alone_is_a_constant():
    other = torch.tensor([0.3, 0.6], requires_grad=True)
    value = mode_seeking(torch.tensor([0.5, 0.5]), other, torch.ones(2), torch.ones(2))
    assert value.item() == pytest.approx(1e5)
    value.backward()
    assert other.grad.abs().sum() == 0


def test_the_uncertain_terms_by_hand():
    rendered, photo = torch.tensor([[1.0, 0.5, 0.0], [0.0, 0.0, 1.0]]), torch.zeros(2, 3)
    beta = torch.tensor([0.5, 2.0])
    assert uncertain_photometric(rendered, photo, beta).item() == pytest.approx((1.25 / 0.25 + 1 / 4) / 6)
    assert log_uncertainty(beta).item() == pytest.approx(3 + (math.log(0.5) + math.log(2)) / 2)


@pytest.mark.parametrize("row", ROWS)
@pytest.mark.parametrize("preset", PRESETS)
def test_the_listed_terms_are_those_of_a_step(row, preset):
    model, weights = small_model(row), LossWeights(**PRESETS[preset], preset=preset)
    batch = small_batch()
    if not needs_other(model.spec, weights):
        batch = batch._replace(others=[])
    with torch.no_grad():
        terms, _ = model(batch, 0, torch.Generator().manual_seed(0), weights)
    assert set(terms) == set(loss_terms(model.spec, weights))


def test_the_paper_weighs_the_pixels_with_lambda():
    paper = LossWeights(**PRESETS["paper"])
    assert (paper.photometric, paper.appearance, paper.content, paper.embedding) == (1e-3, 1.0, 1e-5, 0.0)
    assert paper.mask_weight(0) == paper.mask_weight(10**6) == pytest.approx(1e-3 * 6e-3)
    assert paper.appearance_target == "own"


def released_terms(inputs: dict, step: int) -> dict:
    """The terms under the released names, put together as SceneModel does."""
    weights, mask = LossWeights(), inputs["out_mask"].squeeze(-1)
    return {
        "c_l": weights.photometric * photometric(inputs["rgb_coarse"], inputs["targets"], mask.detach()),
        "f_l": weights.photometric * photometric(inputs["rgb_fine"], inputs["targets"], mask),
        "r_ms": weights.mask_weight(step) * mask_size(mask),
        "rec_a_random": weights.appearance
        * appearance_consistency(inputs["a_embedded_random"], inputs["a_embedded_random_rec"], "other"),
        "content_constraint": weights.content
        * content_preservation(inputs["content_wo_a_embed"], inputs["content_with_a_embed"]),
        "kl_a": weights.embedding * embedding_size(inputs["a_embedded"]),
    }


def inputs_of(vectors: dict) -> dict:
    return {k.removeprefix("in/"): v for k, v in vectors.items() if k.startswith("in/")}


@pytest.mark.real
@pytest.mark.parametrize("step", STEPS)
def test_golden_terms(golden, step):
    vectors = golden("losses")
    expected = {k.split("/")[-1]: v for k, v in vectors.items() if k.startswith(f"out/step_{step}/")}
    assert expected.pop("r_md") == 0  # the released code's mask digit term is off
    assert LossWeights().mask_weight(step) == pytest.approx(expected.pop("mask_weight").item(), abs=3e-8)
    terms = released_terms(inputs_of(vectors), step)
    terms["total"] = torch.stack(list(terms.values())).sum()
    assert terms.keys() == expected.keys()
    for name, value in terms.items():
        torch.testing.assert_close(value, expected[name], atol=3e-8, rtol=0, msg=lambda m, name=name: f"{name}: {m}")


@pytest.mark.real
def test_golden_terms_without_a_mask(golden):
    vectors = golden("losses")
    inputs = inputs_of(vectors)
    for name, rendered in (("c_l", "rgb_coarse"), ("f_l", "rgb_fine")):
        value = LossWeights().photometric * photometric(inputs[rendered], inputs["targets"], None)
        torch.testing.assert_close(value, vectors[f"out/variant_no_mask/{name}"], atol=3e-8, rtol=0)


@pytest.mark.real
def test_golden_gradients(golden):
    vectors = golden("losses")
    inputs = {k: v.requires_grad_() for k, v in inputs_of(vectors).items()}
    torch.stack(list(released_terms(inputs, 1000).values())).sum().backward()
    checked = 0
    for key, expected in vectors.items():
        if key.startswith("grad/step_1000/"):
            name = key.split("/")[-1]
            gradient = inputs[name].grad
            gradient = torch.zeros_like(expected) if gradient is None else gradient
            torch.testing.assert_close(gradient, expected, atol=1e-9, rtol=0, msg=lambda m, name=name: f"{name}: {m}")
            checked += 1
    assert checked == 8
