"""Job files: every key documented, defaults in their order, and every mistake a message that names the key."""

from __future__ import annotations

import json
import os
import re
import subprocess
from contextlib import suppress
from pathlib import Path

import pytest
import yaml
from hypothesis import example, given, settings
from hypothesis import strategies as st

from model.losses import PRESETS, LossWeights
from model.methods import AXES, METHODS
from pipeline.config import RECIPES, Job, JobError, load_job, make_job, merge, parse_setting, parse_yaml, save_job
from pipeline.study import read_kind

ROOT = Path(__file__).resolve().parents[2]
SHEBANG = "#!/usr/bin/env -S python -m pipeline run"
BASE = {"name": "a", "scene": {"path": "data/x"}}


def job(over: dict | None = None, *sets: str) -> Job:
    return make_job(merge(BASE, over or {}), sets)


def refused(over: dict | None = None, *sets: str) -> str:
    with pytest.raises(JobError) as error:
        job(over, *sets)
    return str(error.value)


def nested(key: str, value: object) -> dict:
    for part in reversed(key.split(".")):
        value = {part: value}
    assert isinstance(value, dict)
    return value


# The schema


def test_every_key_has_a_description():
    schema = Job.model_json_schema()
    sections = {"Job": schema} | schema["$defs"]
    assert {"SceneJob", "TrainJob", "LearningRates", "ModelSpec", "MLPSpec", "HashSpec"} <= sections.keys()

    def description(node: dict) -> str:
        # Pydantic leaves out a description that says the same as the section's own.
        target = schema["$defs"].get(node.get("$ref", "").rsplit("/", 1)[-1], {})
        return node.get("description") or target.get("description", "")

    bare = [
        f"{section}.{key}"
        for section, node in sections.items()
        for key, value in node.get("properties", {}).items()
        if not description(value).strip()
    ]
    assert bare == []


def test_every_section_refuses_unknown_keys():
    schema = Job.model_json_schema()
    open_ones = [name for name, node in schema["$defs"].items() if node.get("additionalProperties") is not False]
    assert open_ones == []
    assert schema["additionalProperties"] is False


def test_the_schema_is_plain_json():
    assert json.loads(json.dumps(Job.model_json_schema()))["title"] == "Job"


# Mistakes


@pytest.mark.parametrize(
    ("key", "meant"),
    [
        ("methd", "method"),
        ("scene.downscal", "downscale"),
        ("train.epoch", "epochs"),
        ("train.learning_rates.gird", "grid"),
        ("patch.sise", "size"),
        ("losses.apearance", "appearance"),
        ("model.feild", "field"),
        ("model.mlp.widht", "width"),
        ("model.hash.level", "levels"),
        ("evaluate.protocol", "protocols"),
    ],
)
def test_an_unknown_key_names_the_nearest_one(key, meant):
    message = refused(nested(key, 1))
    assert f"{key}: there is no such key; did you mean '{meant}'?" in message
    assert message == refused({}, f"{key}=1")


@pytest.mark.parametrize("key", ["int", "scene.int", "train.int", "model.hash.int", "model.literal['auto']"])
def test_an_unknown_key_may_have_any_name(key):
    assert f"{key}: there is no such key" in refused(nested(key, 1))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("name", "../up"),
        ("name", ""),
        ("name", 5),
        ("name", "a b"),
        ("kind", "stduy"),
        ("scene.downscale", 0),
        ("scene.downscale", "two"),
        ("scene.path", 3),
        ("scene", None),
        ("scene", "data/x"),
        ("ranks", 0),
        ("ranks", -2),
        ("threads", 0),
        ("device", "gpu"),
        ("launcher", "slurm"),
        ("model", None),
        ("model", [1]),
        ("model.field", "hahs"),
        ("model.field", ["hash"]),
        ("patch.size", 1),
        ("patch.min_scale", 2),
        ("patch.photos", 1.5),
        ("train", 3),
        ("train.epochs", 0),
        ("train.epochs", -1),
        ("train.epochs", 2.5),
        ("train.epochs", None),
        ("train.seconds", 0),
        ("train.seconds", -1.0),
        ("train.seconds", "long"),
        ("train.learning_rates.grid", -1e-3),
        ("train.learning_rates.grid", "fast"),
        ("train.adam_betas", [0.9]),
        ("train.decay", "linear"),
        ("train.keep_checkpoints", 1),
        ("train.steps_per_epoch", "many"),
        ("evaluate.protocols", 3),
    ],
    ids=str,
)
def test_a_wrong_value_names_its_key(key, value):
    assert f"job: {key}" in refused(nested(key, value))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("train.steps_per_epoch", 0),
        ("train.steps_per_epoch", -3),
        ("train.seconds", float("inf")),
        ("train.learning_rates.grid", float("inf")),
        ("train.adam_betas", [2.0, 3.0]),
        ("model.channels", 0),
        ("model.mlp.width", -3),
        ("model.mlp.coarse_samples", 0),
        ("model.hash.samples", 0),
        ("model.hash.levels", -1),
        ("losses.appearance", float("nan")),
        ("losses.mask_end", -1.0),
    ],
    ids=str,
)
def test_a_value_that_cannot_work_is_refused_before_anything_runs(key, value):
    """Each of these would end in an error of torch's, in an endless run, or in a division by zero."""
    over = nested(key, value)
    if key == "model.channels":
        over = merge(over, {"method": "crossray"})  # whose encoder takes any number of channels
    assert key in refused(over)


def test_patches_too_small_for_the_released_encoder_are_refused():
    """Its appearance loss encodes a patch, and it reads pictures of 8 pixels a side and more."""
    assert "patch.size" in refused({"patch": {"size": 7}})
    assert job({"patch": {"size": 7}, "method": "nerf"}).patch.size == 7


def test_several_mistakes_are_said_at_once():
    message = refused({"ranks": 0, "train": {"epochs": 0, "epoch": 3}})
    assert len(message.splitlines()) == 3
    assert all(key in message for key in ("ranks:", "train.epochs:", "train.epoch:"))


def test_a_key_that_may_be_one_of_two_things_has_one_line():
    (line,) = refused({"train": {"steps_per_epoch": "foo"}}).splitlines()
    assert "train.steps_per_epoch: input should be a valid integer" in line
    assert line.endswith("or 'auto' (got 'foo')")


@pytest.mark.parametrize(
    "key", ["ranks", "train.steps_per_epoch", "train.epochs", "model.hash.log2_entries", "patch.min_scale"]
)
def test_a_switch_is_no_number(key):
    assert f"{key}: a number is wanted, not true" in refused(nested(key, True))


def test_a_switch_stays_one():
    assert job({"train": {"deterministic": True}}).train.deterministic


def test_a_list_is_called_as_yaml_calls_it():
    assert "evaluate.protocols: input should be a valid list (got 3)" in refused({"evaluate": {"protocols": 3}})


def test_a_missing_scene_is_said():
    with pytest.raises(JobError, match=r"scene: is missing"):
        make_job({"name": "a"})
    with pytest.raises(JobError, match=r"scene\.path: is missing"):
        make_job({"name": "a", "scene": {}})
    with pytest.raises(JobError, match=r"name: is missing"):
        make_job({"scene": {"path": "x"}})


@pytest.mark.parametrize("method", ["crosray", "", None, 3, 2.5, True, ["nerf"], {"nerf": 1}], ids=str)
def test_an_unknown_method_is_said(method):
    message = refused({"method": method})
    assert "method" in message
    if method == "crosray":
        assert "did you mean 'crossray'?" in message


def test_parts_that_do_not_fit_are_refused():
    assert "model.colour" in refused({"model": {"colour": "head"}})
    assert "model.channels" in refused({"model": {"channels": 16}})
    assert "min_scale" in refused({"patch": {"min_scale": 0.9, "max_scale": 0.2}})


# Files


def write(tmp_path: Path, text: str | bytes) -> Path:
    path = tmp_path / "job.yaml"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def test_a_job_file_with_its_shebang_loads(tmp_path):
    path = write(tmp_path, f"{SHEBANG}\nname: a\nscene: {{path: data/x}}\ntrain: {{epochs: 3}}\n")
    assert load_job(path).train.epochs == 3
    assert load_job(path, ["train.epochs=4"]).train.epochs == 4


@pytest.mark.parametrize(
    "text",
    [
        "",
        "just words",
        "- a\n- list",
        "name: [unclosed",
        "a: b: c",
        "\t- x",
        b"\xff\xfe\x00",
        b"name: \xe4",
        "name: a\x00b",
        "name: 2024-02-30",  # reads as a date that does not exist
        "x: !!float abc",
        "x: !!python/object:os.system {}",
        "? [a, b]\n: c",
    ],
    ids=repr,
)
def test_a_file_that_is_no_job_names_itself(tmp_path, text):
    path = write(tmp_path, text)
    with pytest.raises(JobError, match=re.escape(str(path))):
        load_job(path)


def test_a_file_that_cannot_be_read_names_itself(tmp_path):
    for path in (tmp_path / "absent.yaml", tmp_path):
        with pytest.raises(JobError, match=rf"{re.escape(str(path))}: cannot be read"):
            load_job(path)


def test_a_mistake_in_a_file_names_file_and_key(tmp_path):
    path = write(tmp_path, "name: a\nscene: {path: x}\nranks: none\n")
    with pytest.raises(JobError, match=rf"{re.escape(str(path))}: ranks: "):
        load_job(path)


@pytest.mark.parametrize("text", ["5e-4", "5.0e-4", "0.0005", "'5e-4'", "5E-4"])
def test_5e_4_is_a_number_whatever_yaml_thinks(tmp_path, text):
    path = write(tmp_path, f"name: a\nscene: {{path: x}}\ntrain: {{learning_rates: {{grid: {text}}}}}\n")
    assert load_job(path).train.learning_rates.grid == 5e-4
    assert job({}, f"train.learning_rates.grid={text}").train.learning_rates.grid == 5e-4
    assert job({}, f"losses.appearance={text}").losses.appearance == 5e-4
    assert job({}, f"train.seconds={text}").train.seconds == 5e-4


# --set


@pytest.mark.parametrize(
    ("setting", "expected"),
    [
        ("a=1", {"a": 1}),
        ("a.b.c=x", {"a": {"b": {"c": "x"}}}),
        ("a=", {"a": None}),
        ("a=null", {"a": None}),
        ("a=x=y", {"a": "x=y"}),
        ("a=[1, b]", {"a": [1, "b"]}),
        ("a={b: 2}", {"a": {"b": 2}}),
        ("a=true", {"a": True}),
        ("a='5'", {"a": "5"}),
        ("a.b=[full@R4,half@R4]", {"a": {"b": ["full@R4", "half@R4"]}}),
    ],
)
def test_a_setting_is_a_nested_mapping(setting, expected):
    assert parse_setting(setting) == expected


@pytest.mark.parametrize("setting", ["", "a", "=3", "train.epochs 3", "a=[", "a={b", "name=2024-02-30"])
def test_a_setting_that_is_none_is_said_with_its_text(setting):
    with pytest.raises(JobError, match=re.escape(f"--set {setting}")):
        parse_setting(setting)


@pytest.mark.parametrize("setting", [".=1", "a..b=1", " =1", "train.=1", ".train=1"])
def test_a_setting_with_an_empty_key_is_refused(setting):
    refused({}, setting)


def test_settings_win_over_the_file_and_the_last_one_wins():
    found = job({"train": {"epochs": 2, "log_every": 7}}, "train.epochs=3", "ranks=2", "train.epochs=4")
    assert (found.train.epochs, found.train.log_every, found.ranks) == (4, 7, 2)


# Defaults


def test_the_defaults_are_the_papers():
    found = job()
    assert found.method == "crnerf"
    assert (found.train.epochs, found.train.decay, found.train.seconds) == (20, "cosine", None)
    assert set(found.train.learning_rates.model_dump().values()) == {5e-4}
    assert (found.patch.size, found.patch.photos) == (32, 1)
    assert (found.model.channels, found.model.encoder, found.model.segmenter) == (64, "released", "cgnet")
    assert found.train.colour_jitter == 0


@pytest.mark.parametrize("name", METHODS)
def test_a_method_brings_its_axes(name):
    model = job({"method": name}).model
    assert {axis: getattr(model, axis) for axis in AXES} == METHODS[name].axes()


def test_the_hash_field_brings_its_recipe_to_any_method():
    ours = job({"method": "crossray"})
    assert (ours.model.encoder, ours.model.segmenter, ours.model.pixel_center) == ("compact", "unet", 0.5)
    recipe = RECIPES["hash"]
    assert (ours.train.decay, ours.patch.size) == (recipe["train"]["decay"], recipe["patch"]["size"])
    assert ours.train.learning_rates.model_dump() == recipe["train"]["learning_rates"]
    assert ours.train.learning_rates != job().train.learning_rates
    assert ours.train.colour_jitter > 0
    nerf = job({"method": "nerf", "model": {"field": "hash"}})
    assert (nerf.model.field, nerf.model.colour, nerf.model.appearance) == ("hash", "head", "none")
    assert nerf.train.colour_jitter == 0  # a changed colour could not be explained by anything
    same = ours.train.model_dump() | {"colour_jitter": 0}
    assert nerf.train.model_dump() == same
    assert nerf.patch == ours.patch


def test_a_field_set_by_hand_brings_its_recipe_too():
    assert job({"method": "nerf"}, "model.field=hash") == job({"method": "nerf", "model": {"field": "hash"}})
    assert job({"method": "crossray"}, "model.field=mlp").train.decay == "cosine"


def test_without_appearance_no_colour_is_jittered():
    assert job({"method": "crossray", "model": {"appearance": "none"}}).train.colour_jitter == 0
    assert job({"method": "nerf"}).train.colour_jitter == 0


def test_the_file_wins_over_the_recipe_and_the_recipe_over_the_method():
    model = {"encoder": "released", "channels": 64}
    found = job({"method": "crossray", "train": {"learning_rates": {"grid": 0.5}}, "model": model})
    assert found.train.learning_rates.grid == 0.5
    assert found.train.learning_rates.field == RECIPES["hash"]["train"]["learning_rates"]["field"]
    assert (found.model.encoder, found.model.segmenter, found.model.field) == ("released", "unet", "hash")
    assert job({"method": "crnerf", "model": {"transient": "none"}}).model.transient == "none"


def test_merging_changes_neither_mapping():
    base, over = {"a": {"b": 1}, "c": 2}, {"a": {"d": 3}, "c": {"e": 4}}
    assert merge(base, over) == {"a": {"b": 1, "d": 3}, "c": {"e": 4}}
    assert base == {"a": {"b": 1}, "c": 2}
    assert over == {"a": {"d": 3}, "c": {"e": 4}}


def test_shards_have_a_place_by_default():
    found = job({"scene": {"path": "data/trevi", "downscale": 4}, "runs": "/x/runs"})
    assert found.shards == Path("/x/shards/trevi-R4")
    assert found.run == Path("/x/runs/a")
    assert job({"scene": {"shards": "/y"}}).shards == Path("/y")


def test_an_appearance_alone_is_fused_where_it_can_be():
    for appearance, fused in (("embedding", "point"), ("code", "point"), ("none", "none"), ("crossray", "ray")):
        assert job({"method": "crnerf", "model": {"appearance": appearance}}).model.fused == fused
    assert job({"method": "crnerf-r"}).model.fused == "point"
    assert job({"method": "crnerf-r", "model": {"appearance": "crossray"}}).model.fused == "point"  # as the row says
    assert job({"method": "crnerf", "model": {"fused": "point"}}).model.fused == "point"


def test_presets_bring_weights_and_single_keys_win():
    assert job({"method": "crnerf"}).losses == LossWeights()
    paper = job({"method": "crnerf", "losses": {"preset": "paper", "content": 0.5}}).losses
    assert (paper.preset, paper.photometric, paper.appearance, paper.content) == ("paper", 1e-3, 1.0, 0.5)
    assert job({"method": "crossray"}).losses == LossWeights(preset="fast", **PRESETS["fast"])
    assert job({"method": "crossray", "losses": {"preset": "released"}}).losses == LossWeights()


def test_uv_masks_on_the_fast_field_are_trained_more_gently():
    recipe = job({"method": "hanerf", "model": {"field": "hash"}})
    assert (recipe.losses.mask_start, recipe.losses.preset) == (0.05, "fast")
    assert recipe.train.learning_rates.embedding == 0.005
    assert recipe.train.learning_rates.grid == 0.02  # the rest of the field's recipe stays
    asked = job({"method": "hanerf", "model": {"field": "hash"}, "losses": {"preset": "fast"}})
    assert asked == recipe  # a key that is set to its default changes nothing
    released = job({"method": "hanerf", "model": {"field": "hash"}, "losses": {"preset": "released"}})
    assert released.losses == LossWeights()
    assert job({"method": "hanerf"}).losses == LossWeights()


@pytest.mark.parametrize("setting", ["method=nerf", "losses.preset=paper"])
def test_a_resolved_job_keeps_its_method_and_preset(tmp_path, setting):
    """It spells out every choice, so that only the name would change."""
    save_job(job({"method": "crnerf"}), tmp_path / "job.yaml")
    with pytest.raises(JobError, match=r"would change the name alone"):
        load_job(tmp_path / "job.yaml", [setting])
    assert load_job(tmp_path / "job.yaml", ["model.transient=none"]).model.transient == "none"


@pytest.mark.parametrize("transient", ["segmenter", "uvmask"])
def test_masks_that_cost_nothing_are_refused(transient):
    with pytest.raises(JobError, match=r"losses\.mask_end: 0 makes masks free"):
        job({"method": "crnerf", "model": {"transient": transient}, "losses": {"mask_end": 0.0}})
    job({"method": "crnerf-a", "losses": {"mask_end": 0.0}})


@pytest.mark.parametrize(("key", "value"), [("pixel_center", -5), ("pixel_center", 300), ("mlp.xyz_frequencies", 129)])
def test_sizes_out_of_range_are_refused(key, value):
    with pytest.raises(JobError, match=rf"model\.{key}: {value}"):
        make_job({"name": "x", "scene": {"path": "."}}, [f"model.{key}={value}"])


def test_masks_have_shards_of_their_own():
    plain, masked = (job({"method": method}) for method in ("crnerf-a", "crnerf-a-masks"))
    assert masked.shards.name == plain.shards.name + "-masks"
    assert job({"method": "crnerf-a-masks", "scene": {"shards": "/s"}}).shards == Path("/s")


@pytest.mark.parametrize("appearance", ["none", "embedding"])
def test_colours_that_nothing_explains_are_not_changed(appearance):
    over = {"method": "crossray", "model": {"appearance": appearance}}
    assert job(over).train.colour_jitter == 0
    with pytest.raises(JobError, match=rf"train\.colour_jitter: 0\.3 changes .*{appearance}"):
        job(over | {"train": {"colour_jitter": 0.3}})


def test_two_fields_are_compared_without_noise():
    assert job({"method": "nerfw"}).model.mlp.density_noise == 0
    assert job({"method": "hanerf"}).model.mlp.density_noise == 1


def test_a_code_network_needs_larger_patches():
    with pytest.raises(JobError, match=r"patch\.size: 12 is too small .* at least 16"):
        job({"method": "hanerf", "patch": {"size": 12}})
    job({"method": "hanerf", "patch": {"size": 16}})
    job({"method": "hanerf", "patch": {"size": 12}, "losses": {"preset": "fast"}})


# The resolved job


@pytest.mark.parametrize(
    "over",
    [
        {},
        {"method": "crossray", "train": {"seconds": 3.5}},
        {"method": "nerf", "model": {"field": "hash"}},
        {"method": "crossray", "model": {"appearance": "none"}, "losses": {"preset": "paper"}},
        {"method": "hanerf", "losses": {"preset": "fast", "appearance": 0.25}},
        {"train": {"steps_per_epoch": 17, "adam_betas": [0.5, 0.75]}, "scene": {"shards": "/s"}},
        {"evaluate": {"protocols": ["crnerf-full@R2"]}},
    ],
    ids=str,
)
def test_the_resolved_job_loads_back_equal(tmp_path, over):
    resolved = job(over)
    save_job(resolved, tmp_path / "job.yaml")
    assert load_job(tmp_path / "job.yaml") == resolved
    written = yaml.safe_load((tmp_path / "job.yaml").read_text())
    assert written["train"].keys() == resolved.train.model_dump().keys()  # every key with its value


# Any mapping at all

scalars = st.none() | st.booleans() | st.integers(-5, 100) | st.floats() | st.text(max_size=6) | st.dates()
values = st.recursive(
    scalars, lambda v: st.lists(v, max_size=3) | st.dictionaries(st.text(max_size=6), v, max_size=3), max_leaves=4
)


def sections() -> st.SearchStrategy[dict]:
    """Mappings whose keys are mostly those of the schema, at every depth, with values of any kind."""
    schema = Job.model_json_schema()

    def of(node: dict) -> st.SearchStrategy[dict]:
        node = schema["$defs"][node["$ref"].rsplit("/", 1)[-1]] if "$ref" in node else node
        known = {key: (of(value) | values if "$ref" in value else values) for key, value in node["properties"].items()}
        odd = st.dictionaries(
            st.text(max_size=6) | st.integers() | st.sampled_from(["int", "auto"]), values, max_size=1
        )
        return st.tuples(st.fixed_dictionaries({}, optional=known), odd).map(lambda pair: pair[1] | pair[0])

    return of(schema)


@given(sections())
@example({"int": 3})
@example({"method": ["nerf"]})
@settings(deadline=None, max_examples=60)
def test_only_job_errors_come_out(mapping):
    for raw in (mapping, mapping | BASE):
        with suppress(JobError):
            make_job(raw)


@given(st.text(max_size=12), st.text(max_size=12))
@example("name", "2024-02-30")
@settings(deadline=None, max_examples=60)
def test_only_job_errors_come_out_of_settings(key, value):
    with suppress(JobError):
        job({}, f"{key}={value}")


# The job files of the repository

JOBS = sorted((ROOT / "jobs").glob("*.yaml"))
TRAIN_JOBS = [path for path in JOBS if read_kind(path) == "train"]


class TestJobFiles:
    def test_there_are_some(self):
        assert {"train_scene.yaml", "train_scene_cpu.yaml"} <= {path.name for path in JOBS}

    @pytest.mark.parametrize("path", TRAIN_JOBS, ids=lambda p: p.name)
    def test_it_loads(self, path):
        found = load_job(path)
        assert found.evaluate.protocols
        for protocol in found.evaluate.protocols:
            assert protocol.endswith(f"@R{found.scene.downscale}")

    @pytest.mark.parametrize("path", JOBS, ids=lambda p: p.name)
    def test_it_is_a_program(self, path):
        assert path.read_text().splitlines()[0] == SHEBANG
        assert os.access(path, os.X_OK)
        listed = subprocess.run(
            ["git", "ls-files", "--stage", str(path)], cwd=ROOT, capture_output=True, text=True, check=False
        ).stdout
        assert not listed or listed.startswith("100755 "), "git keeps it without its executable bit"

    @pytest.mark.parametrize("path", TRAIN_JOBS, ids=lambda p: p.name)
    def test_the_shared_keys_are_said_where_they_can_be_set(self, path):
        assert load_job(path, ["scene.path=data/other", "name=other"]).scene.path == Path("data/other")

    def test_the_papers_schedule(self):
        found = load_job(ROOT / "jobs" / "train_scene.yaml")
        assert (found.ranks, found.train.epochs, found.train.steps_per_epoch) == (8, 20, 17200)
        assert found.patch.photos * found.patch.size**2 == 1024
        assert (found.method, found.train.decay, found.scene.downscale) == ("crnerf", "cosine", 2)
        assert set(found.train.learning_rates.model_dump().values()) == {5e-4}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("method: nerf\nname: a\nmethod: crnerf\n", "'method' is there twice"),
        ("a: &a {b: 1}\nc:\n  <<: *a\n", "merge keys"),
        ("[" * 5000, "RecursionError"),
        ("a: !!bool x", "KeyError"),
        ("a: !!timestamp x", "AttributeError"),
    ],
)
def test_yaml_that_would_lose_or_grow_is_refused(text, words):
    with pytest.raises((ValueError, yaml.YAMLError), match=words):
        parse_yaml(text)


def test_aliases_are_read():
    assert parse_yaml("a: &a [1]\nb: *a\n") == {"a": [1], "b": [1]}


def test_a_path_with_a_nul_is_refused():
    with pytest.raises(JobError, match=r"runs: .* NUL"):
        make_job({"name": "a", "scene": {"path": "."}, "runs": "a\0b"})
