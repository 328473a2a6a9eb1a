"""METHODS: every system of the paper as a point in one design space.

A method is four choices: the field, where colour comes from, how appearance enters, and how transients are handled.
Nothing in the code asks for a method's name: parts are built from the choices alone, so a new method is a new row.

The paper's text says that CR-NeRF-A and -T *remove* a module; its captions, its mask table and its numbers say that
they *add* one to -B. The rows below follow the numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

STRICT = {
    "extra": "forbid",
    "use_attribute_docstrings": True,
    "allow_inf_nan": False,
}  # read by the job schema; plain data here


@dataclass(frozen=True)
class MLPSpec:
    """The NeRF field of the released code: a coarse and a fine MLP, hierarchical sampling."""

    __pydantic_config__ = STRICT

    width: int = 256
    """Units in each of the eight trunk layers."""
    coarse_samples: int = 64
    """Stratified samples a ray, seen by the coarse MLP."""
    fine_samples: int = 64
    """Further samples a ray drawn from the coarse weights; the fine MLP sees both kinds."""
    xyz_frequencies: int = 15
    """Octaves of the positional encoding of a point."""
    dir_frequencies: int = 4
    """Octaves of the positional encoding of a direction."""
    density_noise: float = 1.0
    """Standard deviation of the noise added to densities in training."""


@dataclass(frozen=True)
class HashSpec:
    """The fast field: multiresolution hash grid, one proposal grid, a background that depends on direction only."""

    __pydantic_config__ = STRICT

    levels: int = 12
    """Levels of the grid."""
    log2_entries: int = 15
    """Base-2 logarithm of the table entries a level."""
    min_resolution: int = 8
    """Cells a side of the coarsest level."""
    max_resolution: int = 512
    """Cells a side of the finest level."""
    width: int = 64
    """Units in each hidden layer."""
    proposal_samples: int = 32
    """Samples a ray, seen by the proposal grid alone."""
    samples: int = 16
    """Samples a ray, drawn from the proposal's weights, seen by the field."""
    density_bias: float = -1.5
    """Density of the untrained field is exp(density_bias); a low start avoids fog."""


@dataclass(frozen=True)
class ModelSpec:
    """What a SceneModel is made of: the axes of the design space, then the size of each part."""

    __pydantic_config__ = STRICT

    field: Literal["mlp", "hash"] = "mlp"
    """`mlp`: the NeRF networks of the paper. `hash`: the fast field."""
    colour: Literal["head", "decoder"] = "decoder"
    """`head`: RGB at each point, then volume rendering. `decoder`: features are rendered, then decoded."""
    appearance: Literal["none", "crossray"] = "crossray"
    """`crossray`: appearance encoder and transform over all rays of a view. `none`: one appearance for all photos."""
    transient: Literal["none", "segmenter"] = "segmenter"
    """`segmenter`: a network predicts each photo's transient mask. `none`: every pixel counts."""
    channels: int = 64
    """Channels of a feature (with colour `decoder`)."""
    encoder: Literal["released", "compact"] = "released"
    """Appearance encoder and transform: the released code's, or small ones for small pictures."""
    segmenter: Literal["cgnet", "unet"] = "cgnet"
    """Segmenter network: the released code's, or a small U-Net whose masks are as fine as its input."""
    pixel_center: float = 0.0
    """Where in its pixel a ray goes through: 0 in the released code, 0.5 is the middle."""
    mlp: MLPSpec = MLPSpec()
    """Sizes of the field `mlp`."""
    hash: HashSpec = HashSpec()
    """Sizes of the field `hash`."""


@dataclass(frozen=True)
class Method:
    """One row: the choices, and what the row reproduces."""

    field: str
    colour: str
    appearance: str
    transient: str
    reproduces: str

    def axes(self) -> dict[str, str]:
        """The four choices, by the names that ModelSpec gives them."""
        return {k: getattr(self, k) for k in ("field", "colour", "appearance", "transient")}


METHODS: dict[str, Method] = {
    "nerf": Method("mlp", "head", "none", "none", "NeRF, the paper's table 1"),
    "crnerf-b": Method("mlp", "decoder", "none", "none", "CR-NeRF-B, ablation"),
    "crnerf-a": Method("mlp", "decoder", "crossray", "none", "CR-NeRF-A, ablation: B + appearance"),
    "crnerf-t": Method("mlp", "decoder", "none", "segmenter", "CR-NeRF-T, ablation: B + transient"),
    "crnerf": Method("mlp", "decoder", "crossray", "segmenter", "CR-NeRF, the paper's table 1"),
    "crossray": Method("hash", "decoder", "crossray", "segmenter", "ours: CR-NeRF on the fast field"),
}


LEAST = {  # sizes below these have no meaning
    "channels": 1,
    "mlp.width": 2,
    "mlp.coarse_samples": 4,
    "mlp.fine_samples": 1,
    "mlp.xyz_frequencies": 0,
    "mlp.dir_frequencies": 0,
    "mlp.density_noise": 0,
    "hash.levels": 1,
    "hash.log2_entries": 1,
    "hash.min_resolution": 1,
    "hash.width": 1,
    "hash.proposal_samples": 1,
    "hash.samples": 1,
}


MOST = {"hash.levels": 32, "hash.log2_entries": 24, "hash.max_resolution": 2**16, "channels": 4096, "mlp.width": 2**16}


def check_spec(spec: ModelSpec) -> None:
    """Refuse choices that do not fit together, with the reason.

    Raises:
        ValueError: an appearance that has no decoder to act on, or sizes that cannot work; it names the key.
    """
    for key in LEAST.keys() | MOST.keys():
        section, _, name = key.rpartition(".")
        value = getattr(getattr(spec, section) if section else spec, name)
        if value < LEAST.get(key, value):
            raise ValueError(f"model.{key}: {value} is too small; at least {LEAST[key]}")
        if value > MOST.get(key, value):
            raise ValueError(f"model.{key}: {value} is too large; at most {MOST[key]}")
    if spec.hash.min_resolution > spec.hash.max_resolution:
        raise ValueError(
            f"model.hash.min_resolution: {spec.hash.min_resolution} exceeds max_resolution {spec.hash.max_resolution}"
        )
    if spec.appearance == "crossray" and spec.colour == "head":
        raise ValueError(
            "model.appearance: crossray needs model.colour: decoder, because it transforms rendered features "
            "before they are decoded; with colour: head the field already gives RGB"
        )
    if spec.encoder == "released" and spec.appearance == "crossray" and spec.channels != 64:
        raise ValueError(
            f"model.channels: the released encoder gives 64 channels, not {spec.channels}; "
            "set model.channels to 64 or model.encoder to compact"
        )
