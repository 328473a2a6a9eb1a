"""Studies: many training runs from one job file, and what they end in (pipeline/study_tables.py has their tables).

A study is `variants` x `scenes` x `seeds`. A run is a training job put together from layers, later ones on top: `base`,
the keys of its scene, the keys of its variant, its seed. `--set base.KEY=VALUE` comes last of all, for every run;
`--set variants.NAME=null` and `--set scenes.NAME=null` leave one out.

    <runs>/<study>/<scene>.<variant>.seed<k>/   a run like any other
    <runs>/<study>/study.json                   every run that is done: what, how long, scores, per-image scores
    <runs>/<study>/table.md                     mean and spread over seeds, published numbers beside them
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import yaml
from pydantic import ConfigDict, Field, ValidationError

from pipeline.checkpoint import MODEL, CheckpointError, latest_checkpoint
from pipeline.config import (
    UNKNOWN,
    Job,
    JobError,
    Section,
    as_dict,
    explain,
    make_job,
    merge,
    nearest,
    parse_setting,
    parse_yaml,
)
from pipeline.evaluate import recorded
from pipeline.manifest import MANIFEST, read_manifest
from pipeline.published import published_tables
from pipeline.resume import checkpoints

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$", max_length=40)]
Seeds = Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)]
Keys = dict[str, Any]

# Keys of a training job that the study itself decides, and how.
TAKEN = {
    "kind": "a study is made of training jobs",
    "name": "a run is named after its scene, variant and seed",
    "runs": "`runs` of the study says where its runs are",
    "launcher": "a study starts its runs itself",
    "patch.seed": "`seeds` of the study, or of the variant, says it",
}

RECORDED = (  # of an evaluation
    "definition",
    "samples",
    "appearance_from",
    "statistics",
    "mean",
    "interval",
    "images",
    "seconds",
    "device",
    "versions",
    "provenance",
)


class Variant(Section):
    """Keys of a training job on top of `base` and the scene's, and the variant's own seeds if it has any."""

    model_config = ConfigDict(extra="allow")

    seeds: Seeds | None = None
    """Instead of the study's."""

    @property
    def keys(self) -> Keys:
        """The keys of the training job."""
        return self.model_extra or {}


class StudyJob(Section):
    """A study: training jobs that share what can be shared, and tables over their results."""

    kind: Literal["study"] = "study"
    """What the job does."""
    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", max_length=100)
    """Name of the study: its runs are in `<runs>/<name>`; running it again goes on where it was."""
    runs: Path = Path("runs")
    """Folder of all runs."""
    base: Keys = Field({})
    """Keys of a training job that all runs have in common."""
    variants: Annotated[dict[Name, Variant], Field(min_length=1)]
    """What is compared: the rows of the tables."""
    scenes: Annotated[dict[Name, Keys], Field(min_length=1)]
    """Scenes, with the protocols that suit them: a table each scene and protocol."""
    seeds: Seeds = (0,)
    """Every variant is trained once a seed (`patch.seed`)."""
    published: str | None = None
    """Table of pipeline/published.yaml whose rows are named like the variants."""

    @property
    def folder(self) -> Path:
        """Where everything of the study is."""
        return self.runs / self.name


class Run(NamedTuple):
    """One training run of a study."""

    scene: str
    variant: str
    seed: int
    job: Job


# ---------------------------------------------------------------------------------------------------- from the file


def read_kind(path: Path) -> str:
    """The `kind` of a job file. "train" for a file that cannot be read: `load_job` says what is wrong with it."""
    try:
        raw = parse_yaml(path.read_text())
    except (OSError, yaml.YAMLError, ValueError):
        return "train"
    kind = raw.get("kind") if isinstance(raw, dict) else None
    return kind if isinstance(kind, str) else "train"


def load_study(path: Path, settings: Sequence[str] = ()) -> StudyJob:
    """The study in a YAML file of this kind (`read_kind`), with `key.sub=value` settings on top.

    Raises:
        JobError: a key or a value is wrong; the message names it, and where there is one the variant and the scene.
    """
    try:
        raw = parse_yaml(path.read_text())
    except (yaml.YAMLError, ValueError) as error:
        raise JobError(f"{path}: not a YAML file: {error}") from error
    return make_study(raw, settings, source=str(path))


def make_study(raw: Keys, settings: Sequence[str] = (), source: str = "study") -> StudyJob:
    """Like load_study, from a mapping."""
    for setting in settings:
        raw = apply(raw, parse_setting(setting))
    try:
        study = StudyJob.model_validate(raw)
    except ValidationError as error:
        raise JobError("\n".join(f"{source}: {explain_study(e)}" for e in error.errors())) from None
    check_taken(study, source)
    check_seeds(study, source)
    if study.published is not None and study.published not in published_tables():
        raise JobError(
            f"{source}: published: there is no table {study.published!r}"
            f"{nearest(study.published, list(published_tables()))}"
        )
    expand(study, source)
    return study


def apply(raw: Keys, setting: Keys) -> Keys:
    """`raw` with one setting on top: one of `base` wins over scenes and variants, and null leaves one of these out.

    Raises:
        JobError: it leaves out what is not there, or adds a variant that says nothing of its model.
    """
    for part in ("variants", "scenes"):
        there = list(as_dict(raw.get(part)))
        for name, keys in as_dict(setting.get(part)).items():
            means_new = isinstance(keys, dict) and (part == "scenes" or keys.keys() & {"method", "model"})
            if name not in there and not means_new:
                raise JobError(f"--set {part}.{name}: there is no such entry{nearest(name, there)}")
    raw = merge(raw, setting)
    if "base" in setting:
        raw["variants"] = {
            name: merge(keys, as_dict(setting["base"])) if isinstance(keys, dict) else keys
            for name, keys in as_dict(raw.get("variants")).items()
        }
    for part in ("variants", "scenes"):
        for name, keys in as_dict(setting.get(part)).items():
            if keys is None:
                raw[part] = {k: v for k, v in raw[part].items() if k != name}
    return raw


def explain_study(error: Any) -> str:
    """One pydantic error of a study, as `pipeline.config.explain` puts those of a job."""
    if error["type"] in UNKNOWN:
        key = str(error["loc"][-1])
        return f"{key}: there is no such key{nearest(key, list(StudyJob.model_fields))}"
    return explain(error)


def check_seeds(study: StudyJob, source: str) -> None:
    """JobError for a seed that is there twice: both runs would be the same one."""
    lists = {"seeds": study.seeds} | {f"variants.{name}.seeds": v.seeds or () for name, v in study.variants.items()}
    for key, seeds in lists.items():
        if len(set(seeds)) < len(seeds):
            raise JobError(f"{source}: {key}: one of {', '.join(map(str, seeds))} is there twice")


def check_taken(study: StudyJob, source: str) -> None:
    """JobError for a key that the study itself decides."""
    layers = {"base": study.base}
    layers |= {f"scenes.{name}": keys for name, keys in study.scenes.items()}
    layers |= {f"variants.{name}": variant.keys for name, variant in study.variants.items()}
    for (layer, keys), (key, reason) in product(layers.items(), TAKEN.items()):
        section, _, last = key.rpartition(".")
        if last in (as_dict(keys.get(section)) if section else keys):
            raise JobError(f"{source}: {layer}.{key}: cannot be set here, {reason}")


def expand(study: StudyJob, source: str = "study") -> list[Run]:
    """Every run of the study, in the order in which they are best done: each variant once before any twice.

    Raises:
        JobError: a training job that cannot be; the message names the variant and the scene.
    """
    runs = [
        Run(scene, name, seed, run_job_of(study, scene, name, seed, f"{source}: variant {name}, scene {scene}"))
        for (scene, (name, variant)) in product(study.scenes, study.variants.items())
        for seed in variant.seeds or study.seeds
    ]
    return sorted(runs, key=lambda run: run.seed)


def run_job_of(study: StudyJob, scene: str, variant: str, seed: int, source: str) -> Job:
    """The training job of one run. Its shards are where those of a job in `study.runs` would be, so that all share."""
    keys = merge(merge(study.base, study.scenes[scene]), study.variants[variant].keys)
    ours = {"name": f"{scene}.{variant}.seed{seed}", "runs": str(study.runs), "patch": {"seed": seed}}
    job = make_job(merge(keys, ours), source=source)
    shards = job.scene.model_copy(update={"shards": job.shards})
    return job.model_copy(update={"runs": study.folder, "scene": shards})


# -------------------------------------------------------------------------------------------------------- results


def result_of(run: Run) -> Keys | None:
    """What study.json says of a run; None unless it was trained to its end and evaluated under every protocol."""
    job = run.job
    try:
        training = json.loads((job.run / "training.json").read_text())
        checkpoint = latest_checkpoint(checkpoints(job))
    except (FileNotFoundError, CheckpointError):
        return None
    if checkpoint is None or not checkpoint.meta["finished"] or training["steps"] != checkpoint.step:
        return None
    if (job.shards / MANIFEST).is_file() and read_manifest(job.shards).content_hash != checkpoint.meta["shards"]:
        return None  # trained on other photos or masks than there are now
    scores = {name: recorded(job.run, name, checkpoint) for name in job.evaluate.protocols}
    if any(score is None for score in scores.values()):
        return None
    source = job.run / "source.json"
    return {
        "run": str(job.run),
        "scene": run.scene,
        "variant": run.variant,
        "seed": run.seed,
        "steps": training["steps"],
        "seconds": training["train_seconds"],
        "device": training["device"],
        "ranks": training["ranks"],
        "checkpoint_sha256": checkpoint.meta["sha256"][MODEL],
        "source": json.loads(source.read_text()) if source.is_file() else None,
        "protocols": {
            name: {key: score[key] for key in RECORDED if key in score}
            for name, score in scores.items()
            if score is not None
        },
    }
