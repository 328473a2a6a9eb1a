"""Protocols: what they are called, what each fixes, and which method they refuse."""

from __future__ import annotations

from importlib.resources import files

import pytest
import yaml

from model.methods import METHODS
from pipeline.config import make_job
from pipeline.errors import CrossrayError
from pipeline.fit import FitRecipe
from pipeline.protocol import Protocol, appearance_from, check_protocol, parse_protocol, policy_of, samples_of

NAMES = ("crnerf-full", "cross", "nerfw-half")


def job_of(method, **over):
    return make_job({"name": "x", "method": method, "scene": {"path": ".", "downscale": 2}, **over})


# What each fixes


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        # The paper's released evaluation: whole photo encoded, columns w//2.. scored, kornia's SSIM of window 3.
        ("crnerf-full@R4", ("whole", "right", "photo", "truncate", "window3")),
        # nerfbaselines' protocol `nerfw`: left half read, 11 x 11 SSIM over the valid region.
        ("nerfw-half@R1", ("left", "right", "photo", "truncate", "window11")),
        ("cross@R1", ("elsewhere", "whole", "clean", "round", "window11")),
    ],
)
def test_a_protocol_is_what_its_source_does(name, expected):
    protocol, _ = parse_protocol(name)
    assert (protocol.appearance, protocol.scored, protocol.truth, protocol.rounding, protocol.ssim) == expected
    assert (protocol.resize, protocol.lpips, protocol.mlp_samples) == ("lanczos", "alex-v0.1", (256, 256))


def test_learned_codes_are_fitted_as_nerfbaselines_does_and_alike_everywhere():
    """Codes are shared between protocols: for one photo and half there is one fit."""
    first, *others = (parse_protocol(f"{name}@R1")[0].fit for name in NAMES)
    assert all(fit == first for fit in others)
    assert first["mlp"] == FitRecipe(steps=1000, rays=1024, learning_rate=0.01, stages=3)


@pytest.mark.parametrize("field", ["mlp", "hash"])
@pytest.mark.parametrize("name", NAMES)
def test_fitting_what_was_read_takes_128_steps(name, field):
    assert parse_protocol(f"{name}@R1+fit")[0].fit_read[field].steps == 128


@pytest.mark.parametrize("name", NAMES)
def test_a_file_names_every_key_of_a_protocol_and_of_its_recipes(name):
    """Nothing that moves a number is left to a default."""
    raw = yaml.safe_load(files("pipeline.protocols").joinpath(f"{name}.yaml").read_text())
    assert raw.keys() == Protocol.model_fields.keys() - {"suffix"}
    for recipes in (raw["fit"], raw["fit_read"]):
        assert recipes.keys() == {"mlp", "hash"}
        assert all(recipe.keys() == FitRecipe.model_fields.keys() for recipe in recipes.values())


@pytest.mark.parametrize(
    "change",
    [{"resize": "bilinear"}, {"lpips": "vgg"}, {"rounding": "floor"}, {"ssim": "window7"}, {"scored": "left"},
     {"mlp_samples": [256]}, {"unheard": 1}],
)  # fmt: skip
def test_nothing_else_can_be_put_in_a_file(change):
    raw = parse_protocol("crnerf-full@R1")[0].model_dump()
    with pytest.raises(ValueError, match=next(iter(change))):
        Protocol.model_validate(raw | change)


@pytest.mark.parametrize("key", [key for key in Protocol.model_fields if key != "suffix"])
def test_no_key_may_be_left_out(key):
    raw = parse_protocol("crnerf-full@R1")[0].model_dump()
    del raw[key]
    with pytest.raises(ValueError, match=key):
        Protocol.model_validate(raw)


# Names


@pytest.mark.parametrize(
    ("name", "downscale", "suffix"),
    [
        ("crnerf-full@R4", 4, None),
        ("crnerf-full@R2", 2, None),
        ("nerfw-half@R1", 1, None),
        ("nerfw-half@R16+affine", 16, "affine"),
        ("nerfw-half@R1+fit", 1, "fit"),
        ("crnerf-full@R2+fit", 2, "fit"),
        ("cross@R1", 1, None),
        ("cross@R1+fit", 1, "fit"),
    ],
)
def test_a_protocol_is_named_with_its_downscale_and_its_suffix(name, downscale, suffix):
    protocol, found = parse_protocol(name)
    assert (found, protocol.suffix) == (downscale, suffix)
    plain = parse_protocol(name.partition("+")[0])[0]
    assert protocol == plain.model_copy(update={"suffix": suffix})  # a suffix changes nothing else


@pytest.mark.parametrize(
    "name",
    ["crnerf-full", "crnerf-full@", "crnerf-full@4", "crnerf-full@R0", "crnerf-full@R04", "crnerf-full@R4+afine", "",
     "@R4", "crnerf-full@R4 ", "crnerf-full@R4\n", "CRNERF-FULL@R4", "../protocols/crnerf-full@R4", "crnerf-full@R4+",
     "crnerf-full@R4+fit+affine", "crnerf-full@R4+fit+fit", "crnerf-full@R4+FIT", "crnerf-full+fit@R4", "cross+fit"],
)  # fmt: skip
def test_a_bare_or_misspelt_name_says_how_to_write_it(name):
    with pytest.raises(CrossrayError, match=r"crnerf-full@R4.*known: crnerf-full, cross, nerfw-half.*\+affine.*\+fit"):
        parse_protocol(name)


def test_an_unknown_protocol_names_the_known_ones():
    with pytest.raises(CrossrayError, match=r"'crnerf-ful' is not known \(known: crnerf-full, cross, nerfw-half\)"):
        parse_protocol("crnerf-ful@R4")


def test_the_affine_control_may_not_look_at_what_cross_forbids():
    with pytest.raises(CrossrayError, match=r"cross@R1\+affine: .* looks at the scored photo"):
        parse_protocol("cross@R1+affine")


# Which methods


@pytest.mark.parametrize("method", METHODS)
def test_fit_is_for_methods_that_read_a_photo(method):
    """And the reason is said to the others."""
    job, appearance = job_of(method), METHODS[method].appearance
    check_protocol(job, "nerfw-half@R2")
    check_protocol(job, "nerfw-half@R2+affine")
    if appearance in ("crossray", "code"):
        check_protocol(job, "nerfw-half@R2+fit")
        return
    reason = "always fitted" if appearance == "embedding" else "no appearance to fit"
    with pytest.raises(CrossrayError, match=rf"nerfw-half@R2\+fit: .*{reason}.*evaluate under nerfw-half@R2$"):
        check_protocol(job, "nerfw-half@R2+fit")


def test_another_downscale_is_refused_with_the_one_that_fits():
    with pytest.raises(CrossrayError, match=r"crnerf-full@R4\+fit: .* at R2; evaluate under crnerf-full@R2"):
        check_protocol(job_of("crnerf"), "crnerf-full@R4+fit")


@pytest.mark.parametrize(
    ("method", "expected"),
    [
        ("nerf", ("nothing", "nothing", "nothing")),
        ("nerfw", ("left", "left", "elsewhere")),  # a fit to scored pixels would be training on them
        ("hanerf", ("whole", "left", "elsewhere")),
        ("crnerf", ("whole", "left", "elsewhere")),
    ],
)
def test_what_a_method_reads_from(method, expected):
    spec = job_of(method).model
    assert (
        tuple(appearance_from(spec, parse_protocol(f"{n}@R1")[0]) for n in ("crnerf-full", "nerfw-half", "cross"))
        == expected
    )
    assert appearance_from(spec, parse_protocol("crnerf-full@R1+fit")[0]) == expected[0]


def test_the_protocols_speak_of_the_samples_of_the_mlp_alone():
    protocol = parse_protocol("crnerf-full@R1")[0]
    assert samples_of(job_of("crnerf").model, protocol) == (256, 256)
    assert samples_of(job_of("crossray").model, protocol) is None


@pytest.mark.parametrize("policy", ["view", "patch", "running"])
def test_whose_statistics_are_used_is_what_the_model_says(policy):
    assert policy_of(job_of("crnerf", model={"statistics": policy}).model) == policy


@pytest.mark.parametrize("method", ["nerf", "nerfw", "hanerf", "crnerf-b"])
def test_without_a_transform_there_are_no_statistics(method):
    assert policy_of(job_of(method).model) == "none"
