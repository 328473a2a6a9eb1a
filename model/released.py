"""Names of parameters, those of released codes -> ours: one map a module, for checkpoints and golden vectors.

A map covers every parameter and buffer of its module, so a released state dict is either read whole or
refused.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from torch import Tensor, nn


def _layer(theirs: str, ours: str) -> dict[str, str]:
    return {f"{theirs}.{part}": f"{ours}.{part}" for part in ("weight", "bias")}


def _kernel(theirs: str, ours: str) -> dict[str, str]:
    return {f"{theirs}.conv.weight": f"{ours}.weight"}


def _norm_act(theirs: str, ours: str) -> dict[str, str]:
    parts = ("weight", "bias", "running_mean", "running_var", "num_batches_tracked")
    norm = {f"{theirs}.bn.{part}": f"{ours}.0.{part}" for part in parts}
    return norm | {f"{theirs}.act.weight": f"{ours}.1.weight"}


def _conv_norm_act(theirs: str, ours: str) -> dict[str, str]:
    return _kernel(theirs, f"{ours}.0") | _norm_act(theirs, f"{ours}.1")


def _context_and_gate(theirs: str, ours: str) -> dict[str, str]:
    return (
        _kernel(f"{theirs}.F_loc", f"{ours}.context.local")
        | _kernel(f"{theirs}.F_sur", f"{ours}.context.surrounding")
        | _layer(f"{theirs}.F_glo.fc.0", f"{ours}.gate.squeeze")
        | _layer(f"{theirs}.F_glo.fc.2", f"{ours}.gate.excite")
    )


def _down_block(theirs: str, ours: str) -> dict[str, str]:
    return (
        _conv_norm_act(f"{theirs}.conv1x1", f"{ours}.halve")  # the name misleads: it is 3x3
        | _context_and_gate(theirs, ours)
        | _norm_act(theirs, f"{ours}.join")
        | _kernel(f"{theirs}.reduce", f"{ours}.reduce")
    )


def _context_block(theirs: str, ours: str) -> dict[str, str]:
    return (
        _conv_norm_act(f"{theirs}.conv1x1", f"{ours}.narrow")
        | _context_and_gate(theirs, ours)
        | _norm_act(f"{theirs}.bn_prelu", f"{ours}.join")
    )


def _moment_net(theirs: str, ours: str) -> dict[str, str]:
    per_ray = [_layer(f"{theirs}.convs.{i}", f"{ours}.per_ray.{i}") for i in (0, 2, 4)]
    return _joined(*per_ray, _layer(f"{theirs}.fc", f"{ours}.read_off"))


def _joined(*maps: dict[str, str]) -> dict[str, str]:
    return {theirs: ours for names in maps for theirs, ours in names.items()}


# nerf_coarse and nerf_fine -> RadianceMLP
NERF_MLP = _joined(
    *(_layer(f"xyz_encoding_{i + 1}.0", f"layers.{i}") for i in range(8)),
    _layer("static_sigma.0", "density"),
    _layer("xyz_encoding_final", "bottleneck"),
    _layer("dir_encoding.0", "directional"),
    _layer("static_rgb.0", "head"),
)

# enc_a (E2) and enc_cont (E5) -> ReleasedEncoder
ENCODER = _joined(
    _layer("conv1", "layers.0"),
    _layer("conv2", "layers.1"),
    _layer("conv3", "layers.3"),
    _layer("conv4", "layers.6"),
    _layer("conv5", "layers.8"),
    _layer("conv6", "layers.11"),
    _layer("conv7", "layers.14"),
)

# multi_net (T) -> ReleasedTransform
TRANSFORM = _joined(
    _layer("compress", "compress"),
    _layer("unzip", "expand"),
    _moment_net("cnet", "content"),
    _moment_net("snet", "style"),
)

# decoder (D) -> AffineDecoder
DECODER = _layer("feat_2_rgb_list.0", "linear")

# the segmenter (S) -> CGNet
CGNET = _joined(
    *(_conv_norm_act(f"level1_{i}", f"stage1.{i}") for i in range(3)),
    _norm_act("b1", "join1"),
    _down_block("level2_0", "down2"),
    _context_block("level2.0", "stage2.0"),
    _norm_act("bn_prelu_2", "join2"),
    _down_block("level3_0", "down3"),
    _context_block("level3.0", "stage3.0"),
    _norm_act("bn_prelu_3", "join3"),
    _kernel("classifier.0", "classifier"),
)

# Ha-NeRF: enc_a -> ReleasedCode. Its fine network is a NERF_MLP.
CODE_NETWORK = _joined(
    *(_layer(f"model.{3 * i + 1}", f"layers.{2 * i}") for i in range(5)),
    _layer("model.16", "head"),
)

# Ha-NeRF: implicit_mask -> UVMask.layers; the table of photos belongs to a scene, not to the network.
UV_MASK = _joined(*(_layer(f"mask_mapping.{i}", str(i)) for i in (0, 2, 4, 6, 8)))

# NeRF-W in nerf_pl: what its fine network has beside a NERF_MLP -> TransientHead
TRANSIENT_HEAD = _joined(
    *(_layer(f"transient_encoding.{i}", f"layers.{i}") for i in (0, 2, 4, 6)),
    _layer("transient_sigma.0", "density"),
    _layer("transient_rgb.0", "features"),
    _layer("transient_beta.0", "beta"),
)

# A whole CR-NeRF checkpoint: what the names of each network begin with, and the map for the rest of the name
CRNERF = {
    "nerf_coarse.": NERF_MLP,
    "nerf_fine.": NERF_MLP,
    "enc_a.": ENCODER,
    "enc_cont.": ENCODER,
    "decoder.multi_net.": TRANSFORM,
    "decoder.decoder.": DECODER,
    "implicit_mask.": CGNET,
}
TRAINING_ONLY = ("enc_cont.", "implicit_mask.")  # E5 and S: no picture needs them

# In released state dicts, but never used: the blur of the decoder's upsampling, of which there are 0 steps.
IGNORED = frozenset({"rgb_upsample.1.f", "decoder.decoder.rgb_upsample.1.f"})

_WITHIN_DECODER = dict.fromkeys(TRANSFORM, "decoder.multi_net.") | dict.fromkeys(
    (*DECODER, "rgb_upsample.1.f"), "decoder.decoder."
)


def under(state: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """The entries whose name starts with `prefix`, without it."""
    return {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}


def split_crnerf(state: Mapping[str, Tensor]) -> tuple[dict[str, dict[str, Tensor]], list[str]]:
    """The state dict of a CR-NeRF checkpoint by network: {prefix in CRNERF: its entries}, and the names of no network.

    Names stay whole, as messages need them. A `module.` in front of every name (DataParallel) is dropped, and names
    of T and D that stand directly below `decoder.` are put where they belong. A network without entries is left out.
    """
    wrapped = all(name.startswith("module.") for name in state)
    state = under(state, "module.") if wrapped else state
    parts: dict[str, dict[str, Tensor]] = {}
    strangers = []
    for name, value in state.items():
        name = _in_its_place(name, state)
        prefix = next((prefix for prefix in CRNERF if name.startswith(prefix)), None)
        if prefix is None:
            strangers.append(name)
        else:
            parts.setdefault(prefix, {})[name] = value
    return parts, strangers


def load_crnerf(modules: Mapping[str, nn.Module], state: Mapping[str, Tensor]) -> list[str]:
    """Copy the state dict of a CR-NeRF checkpoint into `modules` {prefix in CRNERF: network}.

    Returns the prefixes of TRAINING_ONLY that `state` lacks: those networks are left as they were. Networks of
    `state` that are not in `modules` are passed over. ValueError, with every offending name of all networks, if
    anything else is missing, unknown or of another shape; networks that are whole are then loaded all the same.
    """
    parts, strangers = split_crnerf(state)
    absent = [prefix for prefix in modules if prefix not in parts and prefix in TRAINING_ONLY]
    problems = _listed("unknown", strangers)
    for prefix, module in modules.items():
        if prefix in absent:
            continue
        try:
            load_released(module, parts.get(prefix, {}), {prefix + name: ours for name, ours in CRNERF[prefix].items()})
        except ValueError as error:
            problems.append(str(error))
    if problems:
        raise ValueError("this is no released CR-NeRF: " + "; ".join(problems))
    return absent


def _in_its_place(name: str, state: Mapping[str, Tensor]) -> str:
    rest = name.removeprefix("decoder.")
    whole = _WITHIN_DECODER.get(rest, "decoder.") + rest
    return name if name == rest or whole in state else whole


def load_released(module: nn.Module, state: Mapping[str, Tensor], names: Mapping[str, str]) -> None:
    """Copy a released state dict into `module` through `names` {released: ours}.

    A 1x1 kernel fills a linear layer. ValueError, with every offending name, if `state` has a name that is
    neither in `names` nor in IGNORED, lacks one, or a shape differs; also if `names` does not fill the module
    exactly. `module` is then left as it was.
    """
    ours = module.state_dict()
    filled = {name: state[theirs] for theirs, name in names.items() if theirs in state}
    problems = [
        *_listed("unknown", state.keys() - names.keys() - IGNORED),
        *_listed("missing", names.keys() - state.keys()),
        *_listed("not in our module", set(names.values()) - ours.keys()),
        *_listed("left unfilled in our module", ours.keys() - set(names.values())),
        *(
            f"{theirs} has shape {tuple(state[theirs].shape)}, {name} needs {tuple(ours[name].shape)}"
            for theirs, name in names.items()
            if theirs in state and name in ours and not _fits(state[theirs], ours[name])
        ),
    ]
    if problems:
        raise ValueError(f"this is no released {type(module).__name__}: " + "; ".join(problems))
    module.load_state_dict({name: value.reshape(ours[name].shape) for name, value in filled.items()})


def _fits(theirs: Tensor, ours: Tensor) -> bool:
    is_pointwise = theirs.ndim == 4 and ours.ndim == 2 and theirs.shape[2:] == (1, 1)
    return theirs.shape == ours.shape or (is_pointwise and theirs.shape[:2] == ours.shape)


def _listed(what: str, names: Iterable[str]) -> list[str]:
    names = sorted(names)
    return [f"{what}: {', '.join(names)}"] if names else []
