"""A protocol fixes everything that moves a number (one file each in pipeline/protocols), and is always named with its
downscale: `crnerf-full@R4`."""

from __future__ import annotations

import re
from importlib.resources import files
from typing import Literal

import yaml
from pydantic import BaseModel, ConfigDict

from model.methods import ModelSpec
from pipeline.config import Job
from pipeline.errors import CrossrayError
from pipeline.fit import FitRecipe
from pipeline.truth import check_truth

Suffix = Literal["affine", "fit"]


class Protocol(BaseModel):
    """What is read, what is scored, and how: a file each in pipeline/protocols, which names every key but `suffix`."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    resize: Literal["lanczos"]
    """How photos are reduced: by Lanczos to floor(w / downscale) x floor(h / downscale) pixels, 8-bit. At R1 they are
    what the file holds."""
    appearance: Literal["whole", "left", "elsewhere"]
    """What of the test photo the appearance is read from: all of it; its left ceil(w / 2) columns; nothing, but another
    view in the same light."""
    scored: Literal["right", "whole"]
    """Which columns are scored: from w // 2 on, or all. At an odd width the middle one is in both halves."""
    truth: Literal["photo", "clean"]
    """What is compared with: the photo, or the landmark's view without tourists."""
    rounding: Literal["truncate", "round"]
    """How predictions become 8-bit."""
    ssim: Literal["window3", "window11"]
    """`window3`: 3 x 3 Gaussian, reflected border, all pixels. `window11`: 11 x 11, pixels whose window is inside."""
    lpips: Literal["alex-v0.1"]
    """The network of LPIPS, and the version of its heads."""
    mlp_samples: tuple[int, int]
    """Samples a ray of the field `mlp`, coarse and fine; the fast field keeps those of training."""
    fit: dict[Literal["mlp", "hash"], FitRecipe]
    """How learned codes are fitted, by field."""
    fit_read: dict[Literal["mlp", "hash"], FitRecipe]
    """How an appearance that was read from a photo is fitted further under a name that ends in `+fit`, by field."""
    suffix: Suffix | None = None
    """The step that the name asks for beside these: `affine`, the control, or `fit`."""


def parse_protocol(name: str) -> tuple[Protocol, int]:
    """`crnerf-full@R4[+affine|+fit]` -> protocol, downscale.

    Raises:
        CrossrayError: an unknown name, or one without its downscale, or a suffix that cannot be.
    """
    known = sorted(
        p.name.removesuffix(".yaml") for p in files("pipeline.protocols").iterdir() if p.name.endswith(".yaml")
    )
    match = re.fullmatch(r"([a-z0-9-]+)@R([1-9][0-9]*)(?:\+(affine|fit))?", name)
    if match is None:
        raise CrossrayError(
            f"protocol {name!r}: write a protocol with its downscale, for example {known[0]}@R4 "
            f"(known: {', '.join(known)}; a trailing +affine adds the affine control, +fit a fit to the left half)"
        )
    if match[1] not in known:
        raise CrossrayError(f"protocol {match[1]!r} is not known (known: {', '.join(known)})")
    text = files("pipeline.protocols").joinpath(f"{match[1]}.yaml").read_text()
    protocol = Protocol.model_validate(yaml.safe_load(text) | {"suffix": match[3]})
    if protocol.suffix == "affine" and protocol.appearance == "elsewhere":
        raise CrossrayError(f"protocol {name}: the affine control looks at the scored photo, which {match[1]} forbids")
    return protocol, int(match[2])


def appearance_from(spec: ModelSpec, protocol: Protocol) -> str:
    """What appearances are read from. A learned code is fitted, which on scored pixels would be training on them: so it
    sees the left half where others see the whole photo."""
    if spec.appearance == "none":
        return "nothing"
    fitted = spec.appearance == "embedding" and protocol.appearance == "whole"
    return "left" if fitted else protocol.appearance


def samples_of(spec: ModelSpec, protocol: Protocol) -> tuple[int, int] | None:
    """Sample counts of the rendering; None keeps those of training (the protocols only speak of the MLP field)."""
    return protocol.mlp_samples if spec.field == "mlp" else None


def policy_of(spec: ModelSpec) -> str:
    """Whose content statistics a cross-ray transform uses when a view is rendered; `none` without a transform."""
    return spec.statistics if spec.appearance == "crossray" else "none"


def check_downscale(job: Job, protocol_name: str, downscale: int) -> None:
    """CrossrayError where a protocol's pictures are not of the size of the job's photos."""
    if downscale != job.scene.downscale:
        raise CrossrayError(
            f"protocol {protocol_name}: the photos of {job.name} are at R{job.scene.downscale}; "
            f"evaluate under {protocol_name.split('@')[0]}@R{job.scene.downscale}, or train at R{downscale}"
        )


def check_suffix(spec: ModelSpec, name: str, protocol: Protocol) -> None:
    """CrossrayError where `+fit` has nothing to add to what a method does anyway."""
    if protocol.suffix != "fit":
        return
    plain = name.removesuffix("+fit")
    if spec.appearance == "none":
        raise CrossrayError(f"protocol {name}: model.appearance: none has no appearance to fit; evaluate under {plain}")
    if spec.appearance == "embedding":
        raise CrossrayError(
            f"protocol {name}: model.appearance: embedding reads nothing from a photo, so its codes are always fitted; "
            f"evaluate under {plain}"
        )


def check_protocol(job: Job, name: str) -> None:
    """CrossrayError where a job's runs cannot be evaluated under a protocol."""
    protocol, downscale = parse_protocol(name)
    check_downscale(job, name, downscale)
    check_suffix(job.model, name, protocol)
    if protocol.truth == "clean":
        check_truth(job)


def check_protocols(job: Job) -> None:
    """CrossrayError for a protocol that could only be refused after the training."""
    for name in job.evaluate.protocols:
        check_protocol(job, name)
