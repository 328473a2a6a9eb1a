"""The job file: its schema, its defaults, and how a key is set from the command line.

Defaults depend on two things only: the method gives the choices of the model, and these choices (above all the field:
the paper's MLPs or the fast hash grid) give the recipe that trains it. What a job file says wins over both, and `--set`
over the file.
"""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import fields
from functools import reduce
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator

from model.losses import PRESETS, LossWeights, check_weights
from model.methods import AXES, FUSED_AT, METHODS, ModelSpec, check_spec, smallest_side
from pipeline.errors import CrossrayError
from pipeline.files import atomic_write, resolved
from pipeline.patches import PatchPlan

MOST_VALUES = 10_000  # of a job file
BRANCHES = ("int", "constrained-int", "literal['auto']")  # of unions: what pydantic names as if they were keys
UNKNOWN = ("extra_forbidden", "unexpected_keyword_argument")

# Keys of `train` that decide what is kept and shown, not what is learned: they may change between two starts of a run.
# So may what a person changes to go on after something broke: the resumed run says what is then not exact.
BOOKKEEPING = ("checkpoint_every", "keep_checkpoints", "log_every", "picture_every", "skip_steps", "any_ranks")


class JobError(CrossrayError):
    """A job file that cannot be run: which key, why, and the nearest right value."""


class Section(BaseModel):
    """A part of a job file; unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True, allow_inf_nan=False)

    @model_validator(mode="after")
    def _paths_that_can_be(self) -> Section:
        for name, value in self:
            if isinstance(value, Path) and "\0" in str(value):
                raise ValueError(f"{name}: {str(value)!r} holds a NUL character, which no path can")
        return self


class SceneJob(Section):
    """Which photos, at which size."""

    path: Path
    """Folder of the posed scene (Phototourism layout, or any COLMAP layout)."""
    downscale: int = Field(2, ge=1)
    """Photos are reduced by this factor: the paper's R/2 is 2, its R/4 is 4."""
    reference_downscale: int = Field(8, ge=1)
    """The appearance encoder and the segmenter see the original photo reduced by this factor."""
    shards: Path | None = None
    """Folder of the scene's shards; by default `shards/<scene>-R<downscale>` beside the runs."""
    on_bad_photo: Literal["refuse", "drop"] = "refuse"
    """What becomes of a photo whose file is missing, damaged, or not of its camera's size: an error that names it, or
    it is left out, and the log and the shards' manifest say so."""


Share = Annotated[float, Field(ge=0, lt=1)]


class LearningRates(Section):
    """Learning rates at the start of the decay, by part of the model."""

    grid: float = Field(5e-4, gt=0)
    """Hash tables."""
    field: float = Field(5e-4, gt=0)
    """Networks of the field, and the decoder."""
    appearance: float = Field(5e-4, gt=0)
    """Appearance encoder, content encoder, transform."""
    embedding: float = Field(5e-4, gt=0)
    """What is learned of each photo by itself: appearance codes, transient codes, codes of uv masks."""
    transient: float = Field(5e-4, gt=0)
    """Segmenter, uv mask."""


class TrainJob(Section):
    """How long, how fast, and what is kept."""

    epochs: int = Field(20, ge=1)
    """Epochs; an epoch has `steps_per_epoch` steps."""
    steps_per_epoch: Annotated[int, Field(ge=1)] | Literal["auto"] = "auto"
    """`auto`: training pixels / (rays a step x ranks), rounded down."""
    seconds: float | None = Field(None, gt=0)
    """Train for this many seconds instead of `epochs`; the schedule stretches to fit. Not repeatable to the bit."""
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """`auto`: bfloat16 inside the field where the hardware computes with it, else float32."""
    learning_rates: LearningRates = LearningRates()
    """By part of the model."""
    adam_betas: tuple[Share, Share] = (0.9, 0.999)
    """Adam's running-average coefficients."""
    adam_epsilon: float = Field(1e-8, gt=0)
    """Adam's epsilon."""
    warmup_steps: int = Field(0, ge=0)
    """Steps over which the learning rate rises from near zero."""
    decay: Literal["cosine", "exponential"] = "cosine"
    """`cosine`: to 1e-8, a step down each epoch (released code). `exponential`: from `decay_from` to `decay_floor`."""
    decay_from: float = Field(0.5, ge=0, lt=1)
    """Share of the training after which the exponential decay begins."""
    decay_floor: float = Field(0.03, gt=0, le=1)
    """Share of the learning rate that the exponential decay ends at."""
    colour_jitter: float = Field(0.0, ge=0, lt=1)
    """Strength of a random colour change applied to a photo and its reference alike: more appearances than photos."""
    checkpoint_every: int = Field(5000, ge=1)
    """Steps between checkpoints; the last step is always kept."""
    keep_checkpoints: int = Field(5, ge=2)
    """Newest checkpoints kept; older ones are removed."""
    log_every: int = Field(100, ge=1)
    """Steps between TensorBoard scalars."""
    picture_every: int = Field(2000, ge=1)
    """Steps between TensorBoard pictures of the fixed validation view."""
    skip_steps: tuple[Annotated[int, Field(ge=0)], ...] = ()
    """Steps that are left out: how a run goes on past a step whose loss was not a finite number."""
    any_ranks: bool = False
    """Allow to go on from a checkpoint of another number of ranks: each step then sees another number of rays."""
    deterministic: bool = False
    """On GPUs: algorithms that give the same bits each time, and a warning where torch has none. Not yet measured. On
    CPU it is always so."""


class EvaluateJob(Section):
    """What happens after training."""

    protocols: tuple[str, ...] = ()
    """Protocols to evaluate under, each with its downscale: `crnerf-full@R4`."""
    each_checkpoint: bool = False
    """Launcher `ray`: evaluate each checkpoint while training goes on, on what the ranks leave free of the cluster."""
    gpus: float = Field(0.25, gt=0, le=1)
    """Share of a GPU that an evaluation task takes, where the job trains on GPUs."""


class RayJob(Section):
    """Where the Ray launcher puts the ranks, and how often it starts them again."""

    cpus_per_rank: int | None = Field(None, ge=1)
    """CPUs that a rank reserves; by default as many as its `threads`."""
    placement: Literal["PACK", "SPREAD", "STRICT_PACK", "STRICT_SPREAD"] = "PACK"
    """Ray's placement strategy: ranks on few nodes, or on many."""
    max_failures: int = Field(3, ge=-1)
    """How often the ranks are started again after one of them, or a node, is lost; -1: without end."""


class Job(Section):
    """A training job: shards if they are absent, trains, evaluates."""

    kind: Literal["train"] = "train"
    """What the job does."""
    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", max_length=100)
    """Name of the run: its folder is `<runs>/<name>`; running the job again goes on from its last checkpoint."""
    method: str = "crnerf"
    """A row of the table of methods (`crossray methods`)."""
    scene: SceneJob
    """Which photos, at which size."""
    runs: Path = Path("runs")
    """Folder of all runs."""
    ranks: int = Field(1, ge=1)
    """Processes that train together: one a GPU, or one a CPU core."""
    launcher: Literal["auto", "local", "torchrun", "ray"] = "auto"
    """`local`: starts the ranks on this machine. `torchrun`: torchrun has started them. `ray`: Ray Train starts them on
    a cluster. `auto`: torchrun where its variables are set, else ray in a submitted job or where RAY_ADDRESS names a
    cluster, else local."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """`auto`: CUDA where there is a GPU."""
    threads: int = Field(1, ge=1, le=1024)
    """Torch threads a rank on CPU, whatever the launcher exports."""
    model: ModelSpec = ModelSpec()
    """What the model is made of."""
    patch: PatchPlan = PatchPlan()
    """What a rank sees in a step."""
    losses: LossWeights = LossWeights()
    """Weights of the loss terms."""
    train: TrainJob = TrainJob()
    """How long, how fast, and what is kept."""
    evaluate: EvaluateJob = EvaluateJob()
    """What happens after training."""
    ray: RayJob = RayJob()
    """Launcher `ray`: where the ranks go."""

    @property
    def run(self) -> Path:
        """The run's folder."""
        return self.runs / self.name

    @property
    def shards(self) -> Path:
        """The scene's shards at the job's downscale."""
        scene = self.scene
        masks = "-masks" if self.model.transient == "fixed" else ""  # shards with masks are another set of shards
        return scene.shards or self.runs.parent / "shards" / f"{resolved(scene.path).name}-R{scene.downscale}{masks}"


RECIPES: dict[str, dict[str, Any]] = {
    "mlp": {},  # the paper's and the released code's values are the schema's defaults
    "hash": {
        "model": {"channels": 32, "encoder": "compact", "segmenter": "unet", "pixel_center": 0.5},
        "patch": {"size": 12, "photos": 4},
        "losses": {"preset": "fast"},
        "train": {
            "learning_rates": {
                "grid": 0.02,
                "field": 0.004,
                "appearance": 0.0012,
                "embedding": 0.02,
                "transient": 0.001,
            },
            "adam_betas": [0.9, 0.99],
            "adam_epsilon": 1e-15,
            "warmup_steps": 50,
            "decay": "exponential",
            "colour_jitter": 0.12,
            "checkpoint_every": 1000,
            "picture_every": 500,
        },
    },
}


# With the schedule of the segmenter, uv masks of the fast field fell to 0 early and stayed there.
UVMASK: dict[str, Any] = {
    "losses": {"mask_start": 0.05, "mask_end": 0.01, "mask_decay": 0.003},
    "train": {"learning_rates": {"embedding": 0.005}},
}


def load_job(path: Path, settings: Sequence[str] = ()) -> Job:
    """The job in a YAML file, with `key.sub=value` settings on top.

    Raises:
        JobError: the file, a key or a value is wrong; the message names it.
    """
    try:
        raw = parse_yaml(path.read_text())
    except OSError as error:
        raise JobError(f"{path}: cannot be read ({error.strerror})") from error
    except (yaml.YAMLError, ValueError) as error:
        raise JobError(f"{path}: not a YAML file: {error}") from error
    if not isinstance(raw, dict):
        raise JobError(f"{path}: a job file is a mapping of keys to values, not {type(raw).__name__}")
    return make_job(raw, settings, source=str(path))


class PlainLoader(yaml.SafeLoader):
    """YAML without what would be lost or could grow without end: a key that is there twice, and `<<`."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """As SafeLoader's; ConstructorError for such a key."""
        seen = set()
        for key, _ in node.value:
            if key.tag == "tag:yaml.org,2002:merge":
                raise yaml.constructor.ConstructorError(None, None, "merge keys (<<) are not read", key.start_mark)
            if isinstance(key, yaml.ScalarNode) and key.value in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"key {key.value!r} is there twice; keep one", key.start_mark
                )
            seen.add(key.value if isinstance(key, yaml.ScalarNode) else id(key))
        return super().construct_mapping(node, deep)


def parse_yaml(text: str) -> Any:
    """A YAML text as plain values.

    Raises:
        yaml.YAMLError: it is none, or has what `PlainLoader` refuses.
        ValueError: it stands for more values than a job has; a few lines of aliases can stand for billions.
    """
    try:
        value = PlainLoader(text).get_single_data()
    except (RecursionError, LookupError, AttributeError, TypeError) as error:  # of tags and depths not foreseen there
        raise ValueError(f"{type(error).__name__}: {error}") from error
    left, todo = MOST_VALUES, [value]
    while todo:
        node = todo.pop()
        inside = list(node.values()) if isinstance(node, dict) else node if isinstance(node, list) else []
        todo += inside
        left -= len(inside)
        if left < 0:
            raise ValueError(f"it stands for more than {MOST_VALUES} values")
    return value


def make_job(raw: dict[str, Any], settings: Sequence[str] = (), source: str = "job") -> Job:
    """Like load_job, from a mapping."""
    for setting in settings:
        raw = merge(raw, new_setting(raw, parse_setting(setting), source))
    try:
        job = Job.model_validate(with_defaults(raw))
        check_switches(job, raw)
        check_spec(job.model)
        check_weights(job.losses)
        check_training(job)
    except ValidationError as error:
        raise JobError("\n".join(f"{source}: {line}" for line in explained(error))) from None
    except ValueError as error:
        raise JobError(f"{source}: {error}") from None
    return job


def check_switches(job: Job, raw: dict[str, Any]) -> None:
    """ValueError for a true or false where a number is wanted: pydantic takes them for 1 and 0."""
    for key, value in flatten(raw).items():
        if isinstance(value, bool) and not isinstance(found := reduce(getattr, key.split("."), job), bool):
            wanted = "a number" if isinstance(found, int | float) else "another value"
            raise ValueError(f"{key}: {wanted} is wanted, not {str(value).lower()}")


def check_training(job: Job) -> None:
    """Refuse patches that the appearance losses cannot encode, colours that nothing could explain, and free masks."""
    model, losses = job.model, job.losses
    least = smallest_side(model)
    compares_content = model.appearance == "crossray" and losses.content > 0
    if job.patch.size < least and (losses.appearance > 0 or compares_content):
        raise ValueError(
            f"patch.size: {job.patch.size} is too small for the appearance losses with model.appearance: "
            f"{model.appearance} and model.encoder: released, which encode a rendered patch; at least {least}"
        )
    if model.transient in ("segmenter", "uvmask") and losses.mask_end == 0:
        raise ValueError(
            f"losses.mask_end: 0 makes masks free, and model.transient: {model.transient} would mask everything; the "
            f"preset {losses.preset} has {PRESETS[losses.preset].get('mask_end', LossWeights.mask_end)}"
        )
    if job.train.colour_jitter > 0 and model.appearance in ("none", "embedding"):
        raise ValueError(
            f"train.colour_jitter: {job.train.colour_jitter} changes a photo's colours in each step, and with "
            f"model.appearance: {model.appearance} nothing is read from the changed photo; 0 fits"
        )


def save_job(job: Job, path: Path) -> None:
    """The resolved job: every key with its value."""
    atomic_write(path, yaml.safe_dump(job.model_dump(mode="json"), sort_keys=False))


def read_saved(path: Path) -> dict[str, Any]:
    """The `job.yaml` of a run as {"a.b": value}, without a look at what the keys mean.

    Raises:
        JobError: it is damaged.
    """
    try:
        raw = parse_yaml(path.read_text())
    except (OSError, yaml.YAMLError, ValueError) as error:
        raise JobError(f"{path} is damaged ({error}): restore it, or remove that run") from error
    if not isinstance(raw, dict):
        raise JobError(f"{path} is damaged (it is not a mapping): restore it, or remove that run")
    return flatten(raw)


def with_defaults(raw: dict[str, Any]) -> dict[str, Any]:
    """`raw` over its preset of losses, over the recipe of its choices, over the choices of its method."""
    name = raw.get("method", Job.model_fields["method"].default)
    if not isinstance(name, str) or name not in METHODS:
        raise ValueError(f"method: {name!r} is not known{nearest(str(name), list(METHODS))}")
    axes = METHODS[name].axes()
    chosen = {k: v for k, v in as_dict(raw.get("model")).items() if k in axes and isinstance(v, str)}
    if "appearance" in chosen and chosen["appearance"] != axes["appearance"]:
        axes["fused"] = FUSED_AT.get(chosen["appearance"], "none")
    axes |= chosen
    recipe = merge(recipe_of(axes), {"model": axes})
    preset, usual = as_dict(raw.get("losses")).get("preset"), recipe.get("losses", {}).get("preset", "released")
    if preset is None or preset == usual:
        return merge(merge({"losses": PRESETS[usual]}, recipe), raw)
    known = PRESETS.get(preset, {}) if isinstance(preset, str) else {}
    return merge(merge({**recipe, "losses": known}, {"losses": {"preset": preset}}), raw)


def recipe_of(axes: dict[str, str]) -> dict[str, Any]:
    """What trains these choices well."""
    recipe = RECIPES.get(axes["field"], {})
    if axes["appearance"] in ("none", "embedding"):  # a changed colour could not be explained by anything
        recipe = merge(recipe, {"train": {"colour_jitter": 0.0}})
    if axes["transient"] == "uncertainty":  # as NeRF-W's code: two fields whose densities are compared, without noise
        recipe = merge(recipe, {"model": {"mlp": {"density_noise": 0.0}}})
    if axes["field"] == "hash" and axes["transient"] == "uvmask":
        recipe = merge(recipe, UVMASK)
    return recipe


def new_setting(raw: dict[str, Any], setting: dict[str, Any], source: str) -> dict[str, Any]:
    """`setting`; JobError where it names a method or a preset, and `raw` spells out all that these stand for."""
    every_axis = set(AXES) <= as_dict(raw.get("model")).keys()
    every_weight = {field.name for field in fields(LossWeights)} <= as_dict(raw.get("losses")).keys()
    spelt_out = {
        "method": every_axis and "method" in setting,
        "losses.preset": every_weight and "preset" in as_dict(setting.get("losses")),
    }
    for key in (key for key, there in spelt_out.items() if there):
        raise JobError(
            f"{source}: --set {key}=... would change the name alone: this file spells out all choices, as the job.yaml "
            "of a run does; set it on the job file that the run was made from"
        )
    return setting


def parse_setting(setting: str) -> dict[str, Any]:
    """`a.b=c` -> {a: {b: c}}, with c read as YAML."""
    key, equals, value = setting.partition("=")
    if not equals or not key:
        raise JobError(f"--set {setting}: write key=value, for example --set train.epochs=5")
    try:
        nested = parse_yaml(value)
    except (yaml.YAMLError, ValueError) as error:
        raise JobError(f"--set {setting}: {value!r} is not YAML: {error}") from error
    for part in reversed(key.strip().split(".")):
        nested = {part: nested}
    return nested


def merge(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """`over` on top of `base`, mapping by mapping."""
    merged = dict(base)
    for key, value in over.items():
        both = isinstance(value, dict) and isinstance(merged.get(key), dict)
        merged[key] = merge(merged[key], value) if both else value
    return merged


def flatten(mapping: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """{a: {b: c}} -> {"a.b": c}."""
    flat: dict[str, Any] = {}
    for key, value in mapping.items():
        flat |= flatten(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return flat


def as_dict(value: Any) -> dict[str, Any]:
    """`value` if it is a mapping, else an empty one (the schema complains later)."""
    return value if isinstance(value, dict) else {}


def explained(error: ValidationError, schema: type = Job) -> list[str]:
    """What is wrong with a job file, a line a key: of a key that may be one of two things, what it is not."""
    lines: dict[str, str] = {}
    for one in error.errors():
        key, _, reason = explain(one, schema).partition(": ")
        if key in lines:
            reason = f"{lines[key].rpartition(' (got ')[0]}, or {reason.removeprefix('input should be ')}"
        lines[key] = reason
    return [f"{key}: {reason}" if reason else key for key, reason in lines.items()]


def explain(error: Any, schema: type = Job) -> str:
    """One pydantic error of a job file with this schema as `key: what is wrong, nearest right name`."""
    location = [str(part) for part in error["loc"]]
    if not location:
        return error["msg"].removeprefix("Value error, ")
    if location[-1] in BRANCHES and error["type"] not in UNKNOWN:
        location.pop()
    key = ".".join(location)
    if error["type"] in UNKNOWN:
        return f"{key}: there is no such key{nearest(location[-1], keys_at(location[:-1], schema))}"
    if error["type"] == "missing":
        return f"{key}: is missing"
    if key == "kind":
        return f"kind: {error['input']!r} is not known (valid: train, study, reeval, timing)"
    reason = error["msg"].replace("valid tuple", "valid list")  # as YAML calls it
    return f"{key}: {reason[:1].lower()}{reason[1:]} (got {error['input']!r})"


def keys_at(location: list[str], schema: type = Job) -> list[str]:
    """The valid keys of the section at `location`."""
    whole = TypeAdapter(schema).json_schema()
    node = whole
    for part in location:
        node = resolve(node.get("properties", {}).get(part, {}), whole)
    return list(node.get("properties", {}))


def resolve(node: dict[str, Any], schema: dict[str, Any]) -> dict[str, Any]:
    """Follow a JSON Schema reference."""
    reference = node.get("$ref") or next((n["$ref"] for n in node.get("allOf", []) if "$ref" in n), None)
    return schema["$defs"][reference.rsplit("/", 1)[-1]] if reference else node


def nearest(name: str, valid: list[str]) -> str:
    """`; did you mean x? (valid: ...)`."""
    close = difflib.get_close_matches(name, valid, n=1, cutoff=0.5)
    guess = f"; did you mean {close[0]!r}?" if close else ""
    return f"{guess} (valid: {', '.join(valid)})" if valid else guess
