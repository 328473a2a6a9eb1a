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

AFFINE = "+affine"  # suffix of the control: colours fitted to the photo's left half by one affine map


class Protocol(BaseModel):
    """What is read, what is scored, and how (one file each in pipeline/protocols)."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    appearance: Literal["whole", "left", "elsewhere"]
    scored: Literal["right", "whole"]
    truth: Literal["photo", "clean"]
    rounding: Literal["truncate", "round"]
    ssim: Literal["window3", "window11"]
    mlp_samples: tuple[int, int]
    fit: dict[Literal["mlp", "hash"], FitRecipe]


def parse_protocol(name: str) -> tuple[Protocol, int, bool]:
    """`crnerf-full@R4[+affine]` -> protocol, downscale, whether the affine control is asked for.

    Raises:
        CrossrayError: an unknown name, or one without its downscale.
    """
    known = sorted(
        p.name.removesuffix(".yaml") for p in files("pipeline.protocols").iterdir() if p.name.endswith(".yaml")
    )
    match = re.fullmatch(r"([a-z0-9-]+)@R([1-9][0-9]*)(\+affine)?", name)
    if match is None:
        raise CrossrayError(
            f"protocol {name!r}: write a protocol with its downscale, for example {known[0]}@R4 "
            f"(known: {', '.join(known)}; a trailing {AFFINE} adds the affine control)"
        )
    if match[1] not in known:
        raise CrossrayError(f"protocol {match[1]!r} is not known (known: {', '.join(known)})")
    text = files("pipeline.protocols").joinpath(f"{match[1]}.yaml").read_text()
    protocol, affine = Protocol.model_validate(yaml.safe_load(text)), match[3] is not None
    if affine and protocol.appearance == "elsewhere":
        raise CrossrayError(f"protocol {name}: the affine control looks at the scored photo, which {match[1]} forbids")
    return protocol, int(match[2]), affine


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


def check_downscale(job: Job, protocol_name: str, downscale: int) -> None:
    """CrossrayError where a protocol's pictures are not of the size of the job's photos."""
    if downscale != job.scene.downscale:
        raise CrossrayError(
            f"protocol {protocol_name}: the photos of {job.name} are at R{job.scene.downscale}; "
            f"evaluate under {protocol_name.split('@')[0]}@R{job.scene.downscale}, or train at R{downscale}"
        )


def check_protocol(job: Job, name: str) -> None:
    """CrossrayError where a job's runs cannot be evaluated under a protocol."""
    protocol, downscale, _ = parse_protocol(name)
    check_downscale(job, name, downscale)
    if protocol.truth == "clean":
        check_truth(job)


def check_protocols(job: Job) -> None:
    """CrossrayError for a protocol that could only be refused after the training."""
    for name in job.evaluate.protocols:
        check_protocol(job, name)
