"""METHODS: every system of the paper as a point in one design space.

A method is five choices: the field, where colour comes from, how appearance enters and where it is fused, and how
transients are handled. Nothing in the code asks for a method's name: parts are built from the choices alone, so a new
method is a new row.

The paper's text says that CR-NeRF-A and -T *remove* a module; its captions, its mask table and its numbers say that
they *add* one to -B. The rows below follow the numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

StatisticsPolicy = Literal["view", "patch", "running"]

CODE = 48  # numbers in a photo's appearance code (NeRF-W's l_a; Ha-NeRF's)
TRANSIENT_CODE = 16  # numbers in a photo's transient code (NeRF-W's l_tau)
VIEW_CODE = 128  # numbers in a photo's code for its uv mask (Ha-NeRF)
SMALLEST_SIDE = {"crossray": 8, "code": 16}  # pixels: released networks of this appearance read no smaller picture
SMALLEST_SEGMENTED = 9  # pixels: at 8 CGNet's last stage is 1 x 1, of which BatchNorm can take no variance

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
    appearance: Literal["none", "embedding", "code", "crossray"] = "crossray"
    """`embedding`: a learned code for each training photo (NeRF-W). `code`: a CNN reads it from a photo (Ha-NeRF).
    `crossray`: an encoder and a transform over all rays of a view (CR-NeRF). `none`: one appearance for all photos."""
    fused: Literal["none", "point", "ray"] = "ray"
    """Where appearance meets the place: at points, before volume rendering, or at rays, after it."""
    transient: Literal["none", "segmenter", "uncertainty", "uvmask", "fixed"] = "segmenter"
    """`segmenter`: a network masks each photo (CR-NeRF). `uncertainty`: a second, transient field and a variance for
    each ray (NeRF-W). `uvmask`: a mask for each photo as an MLP over its pixels (Ha-NeRF). `fixed`: masks read from the
    data (`crossray mask`). `none`: every pixel counts."""
    channels: int = 64
    """Channels of a feature (with colour `decoder`)."""
    encoder: Literal["released", "compact"] = "released"
    """Networks that read a photo's appearance, and the transform that goes with them: the released code's, or small
    ones for small pictures."""
    transform: Literal["learned", "style_only", "mean_only", "closed_form"] = "learned"
    """How `crossray` makes one appearance into another: `learned` from two second moments; `style_only` without the one
    over rays, `mean_only` without any, the controls for them; `closed_form` by Proposition 1, with nothing learned."""
    statistics: StatisticsPolicy = "view"
    """Whose content statistics `crossray` uses when a view is rendered: `view`, all rays of the view (released code);
    `patch`, a grid of 32 x 32 of its rays, as in training; `running`, averages kept in training, the same for every
    view. Training always uses a patch's own."""
    segmenter: Literal["cgnet", "unet"] = "cgnet"
    """Segmenter network: the released code's, or a small U-Net whose masks are as fine as its input."""
    pixel_center: float = 0.0
    """Where in its pixel a ray goes through: 0 in the released code, 0.5 is the middle."""
    mlp: MLPSpec = MLPSpec()
    """Sizes of the field `mlp`."""
    hash: HashSpec = HashSpec()
    """Sizes of the field `hash`."""


AXES = ("field", "colour", "appearance", "fused", "transient")
FUSED_AT = {"none": "none", "embedding": "point", "code": "point", "crossray": "ray"}  # where nothing else is said


@dataclass(frozen=True)
class Method:
    """One row: the choices, what the row reproduces, and what of it is unpublished, so that we had to choose."""

    field: str
    colour: str
    appearance: str
    fused: str
    transient: str
    reproduces: str
    our_choice: str = ""

    def axes(self) -> dict[str, str]:
        """The five choices, by the names that ModelSpec gives them."""
        return {axis: getattr(self, axis) for axis in AXES}


FAST = "the field, its recipe, and the small appearance networks and segmenter (model/appearance/compact.py)"
POINTS = (
    "statistics over all points of all rays, each counting alike (at test: of a 32 x 32 grid of rays); T at each "
    "point; D after volume rendering, so that only the place of fusion and its statistics differ from crnerf"
)
UNCERTAIN = (
    "the transient field gives features like the static one, composited with them before T and D; statistics come "
    "from the static features alone, which are all that there is at test, and so do the appearance losses; densities "
    "without noise, as in NeRF-W's code"
)

METHODS: dict[str, Method] = {
    "nerf": Method("mlp", "head", "none", "none", "none", "NeRF: table 1"),
    "nerfw": Method(
        "mlp", "head", "embedding", "point", "uncertainty", "NeRF-W: table 1, as in nerf_pl",
        "how the paper's rows were made is not known; here, at test the code is fitted to the photo's left half",
    ),
    "hanerf": Method("mlp", "head", "code", "point", "uvmask", "Ha-NeRF: table 1"),
    "crnerf-b": Method("mlp", "decoder", "none", "none", "none", "CR-NeRF-B: ablation"),
    "crnerf-a": Method("mlp", "decoder", "crossray", "ray", "none", "CR-NeRF-A: ablation, B + appearance"),
    "crnerf-t": Method("mlp", "decoder", "none", "none", "segmenter", "CR-NeRF-T: ablation, B + transient"),
    "crnerf-u": Method(
        "mlp", "decoder", "crossray", "ray", "uncertainty", "CR-NeRF-U: uncertainty table", UNCERTAIN
    ),
    "crnerf-a-masks": Method(
        "mlp", "decoder", "crossray", "ray", "fixed", "CR-NeRF-A + DeepLabV3 or Mask R-CNN: mask table",
        "which classes count as transient (pipeline/segmentation/classes.py)",
    ),
    "crnerf-r": Method("mlp", "decoder", "crossray", "point", "segmenter", "CR-NeRF-R: table 1", POINTS),
    "crnerf": Method("mlp", "decoder", "crossray", "ray", "segmenter", "CR-NeRF: table 1"),
    "crossray": Method("hash", "decoder", "crossray", "ray", "segmenter", "ours: CR-NeRF on the fast field", FAST),
}  # fmt: skip


LEAST = {  # sizes below these have no meaning
    "channels": 1,
    "pixel_center": 0,
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


MOST = {
    "hash.levels": 32,
    "hash.log2_entries": 24,
    "hash.max_resolution": 2**16,
    "channels": 4096,
    "mlp.width": 2**16,
    "mlp.xyz_frequencies": 24,
    "mlp.dir_frequencies": 24,
    "pixel_center": 1,
}


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
    check_fusion(spec)
    if spec.encoder == "released" and spec.appearance == "crossray" and spec.channels != 64:
        raise ValueError(
            f"model.channels: the released encoder gives 64 channels, not {spec.channels}; "
            "set model.channels to 64 or model.encoder to compact"
        )


def smallest_side(spec: ModelSpec) -> int:
    """Pixels of the shorter side of the smallest picture whose appearance the model can read."""
    return SMALLEST_SIDE.get(spec.appearance, 1) if spec.encoder == "released" else 1


def smallest_reference(spec: ModelSpec) -> int:
    """Pixels of the shorter side of the smallest reference that the model can be trained with."""
    segments = spec.transient == "segmenter" and spec.segmenter == "cgnet"
    return max(smallest_side(spec), SMALLEST_SEGMENTED if segments else 1)


def check_fusion(spec: ModelSpec) -> None:
    """ValueError where appearance cannot enter in the way that is asked for."""
    if spec.appearance == "crossray" and spec.colour == "head":
        raise ValueError(
            "model.appearance: crossray needs model.colour: decoder, because it transforms features "
            "before they are decoded; with colour: head the field already gives RGB"
        )
    if spec.appearance == "none" and spec.fused != "none":
        raise ValueError(
            f"model.fused: {spec.fused}, but with model.appearance: none there is nothing to fuse; none fits"
        )
    if spec.appearance != "none" and spec.fused == "none":
        raise ValueError(
            f"model.fused: none, but model.appearance: {spec.appearance} has to be fused somewhere; "
            f"{FUSED_AT[spec.appearance]} fits"
        )
    if spec.appearance in ("embedding", "code") and spec.fused == "ray":
        raise ValueError(
            f"model.fused: ray needs model.appearance: crossray, because a code ({spec.appearance}) is an input of the "
            "network that gives each point its colour; point fits"
        )
    if spec.appearance != "crossray" and spec.transform != "learned":
        raise ValueError(
            f"model.transform: {spec.transform} needs model.appearance: crossray; with {spec.appearance} there is "
            "nothing to transform"
        )
    if spec.appearance != "crossray" and spec.statistics != ModelSpec.statistics:
        raise ValueError(
            f"model.statistics: {spec.statistics} needs model.appearance: crossray; with {spec.appearance} no "
            f"statistics are taken, and {ModelSpec.statistics} fits"
        )
