"""Studies: what they expand to, what their tables say, and that one bad run spoils neither the others nor the rest."""

from __future__ import annotations

import fcntl
import json
import logging
import math
import os
import re
import shutil
import signal
import statistics
import subprocess
import sys
import time
from contextlib import nullcontext
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_run import cut_tiny, tiny_job, tiny_mapping

from model.methods import METHODS
from pipeline import cli
from pipeline.cells import Cell
from pipeline.config import JobError, make_job
from pipeline.errors import CrossrayError
from pipeline.evaluate import evaluate_run
from pipeline.launch import process
from pipeline.launch.process import Outcome, Spec, alone, ending, environment, last_line, run_one
from pipeline.launch.run import claim_run
from pipeline.launch.stop import stopped_by_signals
from pipeline.launch.study import needs_of, run_study, spec_of
from pipeline.launch.tasks import TaskError, in_process, ray_tasks
from pipeline.published import published_tables
from pipeline.study import StudyJob, expand, load_study, make_study, read_kind, result_of
from pipeline.study_tables import (
    Spread,
    as_markdown,
    as_rich,
    make_table,
    make_tables,
    published_columns,
    spread,
    tied_with_best,
)
from pipeline.train import train
from pipeline.work import Context

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
JOBS = ROOT / "jobs"
STUDIES = ("ablation", "num_rays", "transient")
SCENES = ["brandenburg_gate", "sacre_coeur", "trevi_fountain"]
PROTOCOL = "crnerf-full@R2"
PATIENCE = 100.0  # seconds until a test gives a process up


def one_after_the_other(**_):
    """In the place of `ray_tasks`: in this process, with real processes for the runs."""
    return nullcontext(in_process)


def small(**over) -> dict:
    """A study of two variants on one scene that need not be there."""
    return {
        "kind": "study",
        "name": "small",
        "base": {"model": {"field": "hash"}, "train": {"seconds": 7}},
        "variants": {"plain": {"method": "nerf"}, "ours": {"method": "crnerf"}},
        "scenes": {"gate": {"scene": {"path": "data/gate", "downscale": 4}}},
        "seeds": [3, 5],
    } | over


def refused(raw: dict, *parts: str, settings=()) -> str:
    with pytest.raises(JobError) as error:
        make_study(raw, settings, source="s.yaml")
    for part in ("s.yaml: ", *parts):
        assert part in str(error.value)
    return str(error.value)


# ------------------------------------------------------------------------------------------------------- expansion


def test_a_run_for_each_scene_variant_and_seed_and_each_variant_once_before_any_twice():
    scenes = {"gate": {"scene": {"path": "gate"}}, "fountain": {"scene": {"path": "fountain"}}}
    study = make_study(small(scenes=scenes, variants={"a": {}, "b": {"seeds": [0]}}))
    assert [(r.scene, r.variant, r.seed) for r in expand(study)] == [
        ("gate", "b", 0),
        ("fountain", "b", 0),
        ("gate", "a", 3),
        ("fountain", "a", 3),
        ("gate", "a", 5),
        ("fountain", "a", 5),
    ]
    run = expand(study)[2]
    assert run.job.name == "gate.a.seed3"
    assert run.job.run == Path("runs/small/gate.a.seed3")
    assert run.job.patch.seed == 3


def test_later_layers_win_base_scene_variant_seed_set():
    layers = {
        "base": {
            "method": "crnerf",
            "model": {"field": "hash"},
            "threads": 2,
            "train": {"epochs": 2, "warmup_steps": 2},
        },
        "scenes": {"gate": {"scene": {"path": "gate"}, "threads": 3, "train": {"epochs": 3, "log_every": 3}}},
        "variants": {"a": {"threads": 4, "train": {"log_every": 4}}},
    }
    (run,) = expand(make_study(small(**layers, seeds=[9])))
    train_job = run.job.train
    assert (run.job.threads, train_job.epochs, train_job.log_every, train_job.warmup_steps) == (4, 3, 4, 2)
    assert run.job.patch.seed == 9
    assert train_job.learning_rates.grid == 0.02  # of the fast field's recipe
    set_on_top = ["base.threads=5", "base.train.warmup_steps=6", "variants.a.train.log_every=7", "seeds=[1]", "name=x"]
    (run,) = expand(make_study(small(**layers), set_on_top))
    assert (run.job.threads, run.job.train.warmup_steps, run.job.train.log_every) == (5, 6, 7)
    assert run.job.train.epochs == 3
    assert run.job.run == Path("runs/x/gate.a.seed1")


def test_null_leaves_a_variant_or_a_scene_out():
    study = make_study(small(), ["variants.plain=null", "scenes.gate=null", "scenes.fountain={scene: {path: f}}"])
    assert [run.job.name for run in expand(study)] == ["fountain.ours.seed3", "fountain.ours.seed5"]
    refused(small(variants={"plain": None}), "variants.plain: ")  # in the file it is a slip


def test_a_study_does_not_change_the_mapping_it_is_made_from():
    raw, before = small(), json.dumps(small())
    make_study(raw, ["base.threads=2", "variants.plain=null"])
    assert json.dumps(raw) == before


def test_all_runs_share_the_shards_that_a_job_beside_the_study_would_use():
    variants = {"plain": {"method": "nerf"}, "masks": {"method": "crnerf-a-masks"}, "ours": {"method": "crnerf"}}
    study = make_study(small(runs="out/runs", variants=variants, seeds=[0]))
    found = {run.variant: run.job for run in expand(study)}
    scene = {"path": "data/gate", "downscale": 4}
    alone = {m: make_job({"name": "x", "method": m, "scene": scene, "runs": "out/runs"}) for m in METHODS}
    assert found["plain"].shards == found["ours"].shards == alone["nerf"].shards == Path("out/shards/gate-R4")
    assert found["masks"].shards == alone["crnerf-a-masks"].shards == Path("out/shards/gate-R4-masks")
    named = small(scenes={"gate": {"scene": {"path": "data/gate", "shards": "elsewhere"}}})
    assert {run.job.shards for run in expand(make_study(named))} == {Path("elsewhere")}


# ------------------------------------------------------------------------------------------------------ what is refused


def test_a_wrong_key_of_a_run_names_variant_scene_and_key():
    text = refused(
        small(variants={"plain": {}, "ours": {"train": {"epoch": 3}}}),
        "variant ours, scene gate: train.epoch: there is no such key; did you mean 'epochs'?",
    )
    assert "plain" not in text
    refused(small(variants={"plain": {"model": {"colour": "head"}}}), "variant plain, scene gate: model.appearance")
    refused(small(), "variant plain, scene gate: train.epochs: ", settings=["base.train.epochs=0"])


@pytest.mark.parametrize(
    ("over", "part"),
    [
        ({"varaints": {}}, "varaints: there is no such key; did you mean 'variants'?"),
        ({"variants": {}}, "variants: "),
        ({"scenes": {}}, "scenes: "),
        ({"scenes": {"a.b": {}}}, "scenes.a.b"),  # dots part the names of a run
        ({"variants": {"a b": {}}}, "variants.a b"),
        ({"seeds": []}, "seeds: "),
        ({"seeds": [-1]}, "seeds.0: "),
        ({"seeds": [1, 0, 1]}, "seeds: one of 1, 0, 1 is there twice"),
        ({"variants": {"a": {"seeds": [2, 2]}}}, "variants.a.seeds: one of 2, 2 is there twice"),
        ({"name": "a/b"}, "name: "),
        ({"kind": "train"}, "kind: "),
        ({"published": "ablation"}, "published: there is no table 'ablation'; did you mean 'ablation-R4'?"),
        ({"base": {"name": "x"}}, "base.name: cannot be set here"),
        ({"base": {"launcher": "torchrun"}}, "base.launcher: cannot be set here"),
        ({"scenes": {"gate": {"runs": "x"}}}, "scenes.gate.runs: cannot be set here"),
        ({"variants": {"a": {"patch": {"seed": 1}}}}, "variants.a.patch.seed: cannot be set here, `seeds`"),
    ],
)
def test_a_wrong_study_names_the_key(over, part):
    refused(small(**over), part)


def test_the_kind_of_a_file(tmp_path):
    path = tmp_path / "job.yaml"
    for text, kind in (("kind: study\n", "study"), ("name: x\n", "train"), ("- a\n", "train"), ("a: [", "train")):
        path.write_text(text)
        assert read_kind(path) == kind
    assert read_kind(tmp_path / "absent.yaml") == "train"


# ------------------------------------------------------------------------------------------------------ files of jobs/


@pytest.mark.parametrize("name", STUDIES)
def test_a_shipped_study_is_a_program_whose_keys_are_explained(name):
    path = JOBS / f"{name}.yaml"
    lines = path.read_text().splitlines()
    assert os.access(path, os.X_OK)
    assert lines[0] == "#!/usr/bin/env -S python -m pipeline run"
    study = load_study(path)
    assert (study.name, study.seeds) == (name, (0, 1, 2))
    assert len(expand(study)) == 3 * len(study.variants)
    assert {run.job.train.seconds for run in expand(study)} == {100}
    assert {run.job.model.field for run in expand(study)} == {"hash"}
    assert {run.job.ranks for run in expand(study)} == {1}
    top = [line for line in lines if re.match(r"[a-z]+:", line) and not line.startswith("kind:")]
    assert len(top) == len(StudyJob.model_fields) - 1
    assert all("  # " in line for line in top)
    full_size = load_study(path, ["base.model.field=mlp", "base.train.seconds=null", "base.train.epochs=20"])
    assert {(r.job.model.field, r.job.train.epochs, r.job.train.seconds) for r in expand(full_size)} == {
        ("mlp", 20, None)
    }


def test_the_ablation_has_every_row_of_the_methods():
    study = load_study(JOBS / "ablation.yaml")
    jobs = {run.variant: run.job for run in expand(study)}
    assert {job.method for job in jobs.values()} == METHODS.keys() - {"crossray"}
    assert all(jobs[name].method == name for name in METHODS.keys() - {"crossray"})
    ours = make_job({"name": "x", "method": "crossray", "scene": {"path": "data/landmark"}})
    assert jobs["crnerf"].model == ours.model  # so a row `crossray` would be the same again
    assert {jobs[f"crnerf-{t}"].model.transform for t in ("style-only", "mean-only", "closed-form")} == {
        "style_only",
        "mean_only",
        "closed_form",
    }
    assert (jobs["hanerf"].losses.appearance, jobs["hanerf"].losses.mode_seeking) == (1e-3, 1e-6)
    rows = published_tables()[study.published]
    assert rows.keys() == METHODS.keys() - {"crossray", "crnerf-a-masks"}


def test_the_number_of_rays_and_the_transient_handlers():
    rays = {run.variant: run.job.patch.size**2 for run in expand(load_study(JOBS / "num_rays.yaml"))}
    assert rays == {"rays400": 400, "rays576": 576, "rays784": 784, "rays1024": 1024, "rays1600": 1600}
    assert rays.keys() == published_tables()["num-rays-R4"].keys()
    jobs = {run.variant: run.job for run in expand(load_study(JOBS / "transient.yaml"))}
    assert {name: job.model.transient for name, job in jobs.items()} == {name: name for name in jobs}
    assert jobs.keys() == {"none", "fixed", "uvmask", "uncertainty", "segmenter"}
    assert {job.model.appearance for job in jobs.values()} == {"crossray"}


# --------------------------------------------------------------------------------------------------- published numbers


def test_every_published_row_has_all_scenes_and_metrics_of_its_table():
    tables = published_tables()
    all_three, psnr_ssim = ["psnr", "ssim", "lpips"], ["psnr", "ssim"]
    expected = {
        "comparison-R4": (["nerf", "nerfw", "hanerf", "crnerf-r", "crnerf"], SCENES, all_three),
        "comparison-R2": (["nerf", "nerfw", "hanerf", "crnerf-r", "crnerf"], SCENES, all_three),
        "ablation-R4": (["crnerf-b", "crnerf-a", "crnerf-t", "crnerf"], SCENES, all_three),
        "uncertainty-R4": (["crnerf-u", "crnerf"], SCENES, psnr_ssim),
        "masks-R4": (["crnerf-a", "crnerf-a-deeplabv3", "crnerf-a-maskrcnn", "crnerf"], SCENES[:1], all_three),
        "num-rays-R4": ([f"rays{n}" for n in (400, 576, 784, 1024, 1600)], SCENES[:1], ["psnr"]),
        "num-rays-hanerf-R4": ([f"rays{n}" for n in (400, 576, 784, 1024, 1600)], SCENES[:1], ["psnr"]),
    }
    for name, (rows, scenes, metrics) in expected.items():
        assert list(tables[name]) == rows, name
        for row, scores in tables[name].items():
            assert list(scores) == scenes, (name, row)
            assert all(list(numbers) == metrics for numbers in scores.values()), (name, row)
    assert tables.keys() - expected.keys() == {"methods-R4", "transient-R4"}  # the same numbers by other names
    for scores in (s for table in tables.values() for row in table.values() for s in row.values()):
        assert 15 < scores["psnr"] < 28
        assert 0.6 < scores.get("ssim", 0.7) < 0.91
        assert 0.07 < scores.get("lpips", 0.1) < 0.37


def test_published_numbers_as_they_stand_in_the_paper():
    tables = published_tables()
    assert tables["comparison-R4"]["crnerf"]["brandenburg_gate"] == {"psnr": 26.86, "ssim": 0.9069, "lpips": 0.0733}
    assert tables["comparison-R4"]["nerfw"]["sacre_coeur"] == {"psnr": 21.07, "ssim": 0.8422, "lpips": 0.1119}
    assert tables["comparison-R2"]["hanerf"]["trevi_fountain"] == {"psnr": 20.18, "ssim": 0.6908, "lpips": 0.2225}
    assert tables["comparison-R2"]["crnerf-r"]["sacre_coeur"] == {"psnr": 21.66, "ssim": 0.8171, "lpips": 0.1646}
    assert tables["ablation-R4"]["crnerf-t"]["sacre_coeur"] == {"psnr": 16.28, "ssim": 0.7650, "lpips": 0.1799}
    assert tables["uncertainty-R4"]["crnerf-u"]["trevi_fountain"] == {"psnr": 20.84, "ssim": 0.7382}
    assert tables["masks-R4"]["crnerf-a-maskrcnn"]["brandenburg_gate"]["psnr"] == 25.46
    assert tables["num-rays-R4"]["rays784"]["brandenburg_gate"] == {"psnr": 27.12}
    assert tables["num-rays-hanerf-R4"]["rays400"]["brandenburg_gate"] == {"psnr": 23.49}
    assert tables["transient-R4"]["none"] == tables["ablation-R4"]["crnerf-a"]
    assert tables["methods-R4"]["crnerf-u"] == tables["uncertainty-R4"]["crnerf-u"]


def test_the_paper_agrees_with_itself_where_a_number_is_printed_twice():
    tables = published_tables()
    whole = tables["comparison-R4"]["crnerf"]
    for name in ("ablation-R4", "masks-R4", "uncertainty-R4"):
        for scene, scores in tables[name]["crnerf"].items():
            assert scores.items() <= whole[scene].items()
    assert tables["masks-R4"]["crnerf-a"].items() <= tables["ablation-R4"]["crnerf-a"].items()
    assert tables["num-rays-R4"]["rays1024"]["brandenburg_gate"]["psnr"] == whole["brandenburg_gate"]["psnr"]


# ------------------------------------------------------------------------------------------------------- arithmetic


def test_mean_and_sample_deviation_by_hand():
    assert spread([2.0, 4.0, 9.0]) == (5.0, pytest.approx(math.sqrt((9 + 1 + 16) / 2)), 3)
    assert spread([3.5]) == Spread(3.5, None, 1)
    assert spread([]) is None


def test_ties_by_hand():
    a, b, c = Spread(10.0, 0.3, 3), Spread(9.5, 0.4, 3), Spread(9.4, 0.4, 3)
    assert tied_with_best([b, a, c, None], max) == [True, True, False, False]  # sqrt(0.09 + 0.16) = 0.5: 9.5 just ties
    assert tied_with_best([a, b, c], min) == [False, True, True]  # from 9.4: 0.1 <= 0.57, 0.6 > 0.5
    single = Spread(11.0, None, 1)
    assert tied_with_best([single, a, b], max) == [False, True, True]  # a single seed is compared with nothing
    assert tied_with_best([single, a, None], max) == [False, False, False]
    assert tied_with_best([single, single], max) == [False, False]


# Multiples of 1/8, so that the squares below are exact and a tie is one in both ways of writing the rule.
eighths = st.integers(0, 40).map(lambda n: n / 8)
spreads = st.builds(Spread, eighths, eighths | st.none(), st.just(3))


@settings(deadline=None, max_examples=50)
@given(st.lists(spreads | st.none(), max_size=6), st.sampled_from([max, min]))
def test_ties_against_the_rule_written_out(column, better):
    marks = tied_with_best(column, better)
    rows = [s for s in column if s is not None and s.sd is not None]
    if len(rows) < 2:
        assert not any(marks)
        return
    best = next(s for s in rows if s.mean == better(row.mean for row in rows))
    for s, mark in zip(column, marks, strict=True):
        compared = s is not None and s.sd is not None
        assert mark == (compared and (s.mean - best.mean) ** 2 <= s.sd**2 + best.sd**2)


def result(variant: str, seed: int, seconds: float, steps: int, mean: dict | None) -> dict:
    """A run of scene `gate` as study.json has it."""
    protocols = {} if mean is None else {"p@R4": {"mean": mean, "images": []}}
    return {
        "scene": "gate",
        "variant": variant,
        "seed": seed,
        "seconds": seconds,
        "steps": steps,
        "protocols": protocols,
    }


@pytest.fixture
def table():
    """Three variants, one of a single seed, one of none; CR-NeRF's rows of the paper beside them."""
    study = make_study(
        small(variants={"crnerf-u": {}, "crnerf": {}, "other": {}, "nothing": {}}, published="methods-R4")
    )
    results = [
        result("crnerf-u", 0, 100.2, 900, {"psnr": 20.0, "ssim": 0.5, "lpips": 0.30, "mask_iou": 0.25}),
        result("crnerf-u", 1, 100.4, 1000, {"psnr": 21.0, "ssim": 0.7, "lpips": 0.30, "mask_iou": None}),
        result("crnerf", 0, 101.0, 800, {"ssim": 0.7, "psnr": 22.0, "lpips": 0.20, "novel": 3.0}),
        result("crnerf", 1, 101.0, 810, {"ssim": 0.7, "psnr": 24.0, "lpips": 0.22, "novel": 4.0}),
        result("other", 0, 50.0, 7, {"psnr": 99.0}),
    ]
    return study, make_table(study, "gate", "p@R4", results)


def test_a_table_by_hand(table):
    _, made = table
    assert made.title == "gate, p@R4"
    assert made.header[:8] == [
        "variant",
        "PSNR",
        "SSIM",
        "LPIPS",
        "mask IoU",
        "novel",
        "training seconds",
        "steps",
    ]
    texts = [[cell.text for cell in row[:8]] for row in made.rows]
    assert texts == [
        ["crnerf-u", "20.50 ± 0.71 (2)", "0.6000 ± 0.1414 (2)", "0.3000 ± 0.0000 (2)", "0.250 (1)", "-"]
        + ["100 ± 0 (2)", "950 ± 71 (2)"],
        ["crnerf", "23.00 ± 1.41 (2)", "0.7000 ± 0.0000 (2)", "0.2100 ± 0.0141 (2)", "-", "3.500 ± 0.707 (2)"]
        + ["101 ± 0 (2)", "805 ± 7 (2)"],
        ["other", "99.00 (1)", "-", "-", "-", "-", "50 (1)", "7 (1)"],
        ["nothing", "-", "-", "-", "-", "-", "-", "-"],
    ]
    # PSNR: 2.5 > sqrt(0.5 + 2), so no tie; SSIM: 0.1 <= 0.1414; LPIPS: lower is better, 0.09 > 0.0141
    best = {(i, j) for i, row in enumerate(made.rows) for j, cell in enumerate(row) if cell.best}
    assert best == {(1, 1), (0, 2), (1, 2), (1, 3)}


def test_published_numbers_stand_in_columns_of_their_own(table):
    study, made = table
    header, cells = published_columns(study)
    assert header == [f"published: {scene}, PSNR / SSIM / LPIPS" for scene in SCENES]
    assert made.header[8:] == header
    assert cells["crnerf"] == [
        Cell("26.86 / 0.9069 / 0.0733"),
        Cell("22.03 / 0.8369 / 0.1060"),
        Cell("22.02 / 0.7488 / 0.1354"),
    ]
    assert cells["crnerf-u"][0] == Cell("24.72 / 0.8873 / -")
    assert cells["nothing"] == [Cell("-")] * 3
    assert [row[8:] for row in made.rows] == list(cells.values())
    assert published_columns(make_study(small())) == ([], {"plain": [], "ours": []})


def test_markdown_and_terminal_show_the_same_cells(table):
    study, made = table
    text = as_markdown(study, [made], {"gate.other.seed1": "exit status 2: it broke (log.txt)"})
    lines = text.splitlines()
    assert lines[0] == "# small"
    assert "sqrt(sd_a² + sd_b²)" in text
    assert "`methods-R4` in pipeline/published.yaml" in text
    assert "## gate, p@R4" in lines
    assert "- gate.other.seed1: exit status 2: it broke (log.txt)" in lines
    rows = [[c.strip() for c in line.strip("|").split("|")] for line in lines if line.startswith("|")]
    assert {len(row) for row in rows} == {11}
    assert rows[3][1] == "**23.00 ± 1.41 (2)**"
    shape = as_rich(made)
    assert [str(column.header) for column in shape.columns] == made.header
    assert [str(cell) for cell in shape.columns[1].cells] == [row[1].text for row in made.rows]
    assert [cell.style for cell in shape.columns[1].cells] == ["", "bold", "", ""]


def test_a_table_for_each_scene_and_protocol_of_its_runs():
    scenes = {
        "gate": {"scene": {"path": "g"}, "evaluate": {"protocols": ["crnerf-full@R2", "nerfw-half@R2"]}},
        "hall": {"scene": {"path": "h"}},
    }
    study = make_study(small(scenes=scenes))
    titles = [table.title for table in make_tables(study, expand(study), [])]
    assert titles == ["gate, crnerf-full@R2", "gate, nerfw-half@R2", "hall"]


# ------------------------------------------------------------------------------------------------------------ running


@pytest.fixture(scope="module")
def cut(tmp_path_factory):
    return cut_tiny(tmp_path_factory.mktemp("study"))


@pytest.fixture(scope="module")
def trained(cut):
    """The folder of a run of two steps, evaluated."""
    over = {"name": "finished", "train": {"epochs": 1, "steps_per_epoch": 2}, "evaluate": {"protocols": [PROTOCOL]}}
    job = tiny_job(cut, "nerf", over)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CROSSRAY_CACHE", str(cut / "cache"))
        claim_run(job)
        train(job, Context())
        evaluate_run(job.run, PROTOCOL)
    return job.run


@pytest.fixture(autouse=True)
def _environment(request, monkeypatch):
    monkeypatch.delenv("RANK", raising=False)
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    monkeypatch.setenv("COLUMNS", "400")
    if "cut" in request.fixturenames:
        monkeypatch.setenv("CROSSRAY_CACHE", str(request.getfixturevalue("cut") / "cache"))


def tiny_study(cut: Path, tmp_path: Path, **over) -> dict:
    """A study of tiny runs, its runs under tmp_path."""
    base = tiny_mapping(cut, "nerf", {"train": {"epochs": 1, "steps_per_epoch": 2}})
    scene = {"scene": base.pop("scene"), "evaluate": {"protocols": [PROTOCOL]}}
    for key in ("name", "runs"):
        base.pop(key)
    variants = {"a": {}, "b": {"train": {"log_every": 4}}}
    return {
        "kind": "study",
        "name": "tiny",
        "runs": str(tmp_path / "runs"),
        "base": base,
        "variants": variants,
        "scenes": {"wall": scene},
        "seeds": [0, 1],
    } | over


class Runs:
    """Stands in for the processes of runs: shell commands that leave a finished run's files, crash, or hang."""

    def __init__(self, finished: Path) -> None:
        self.finished = finished
        self.started: list[str] = []
        self.ends: dict[str, str] = {}

    def command(self, spec: Spec) -> list[str]:
        self.started.append(spec.name)
        copy = f"cp -r {self.finished}/checkpoints {self.finished}/eval {self.finished}/training.json {spec.run}/"
        return ["sh", "-c", self.ends.get(spec.name, copy)]


@pytest.fixture
def runs(trained, monkeypatch):
    stand_in = Runs(trained)
    monkeypatch.setattr(process, "command", stand_in.command)
    return stand_in


def test_a_crashing_run_ends_nothing_else_and_the_next_call_does_what_is_left(cut, tmp_path, runs):
    study = make_study(tiny_study(cut, tmp_path))
    runs.ends = {
        "wall.a.seed0": "echo going; echo 'crossray: it broke'; echo; exit 3",
        "wall.a.seed1": "kill -9 $$",
    }
    tables, failures = run_study(study, one_after_the_other)
    assert runs.started == ["wall.a.seed0", "wall.b.seed0", "wall.a.seed1", "wall.b.seed1"]
    folder = tmp_path / "runs" / "tiny"
    assert failures == {
        "wall.a.seed0": f"exit status 3: crossray: it broke ({folder}/wall.a.seed0/log.txt)",
        "wall.a.seed1": f"ended by SIGKILL: it printed nothing ({folder}/wall.a.seed1/log.txt)",
    }
    assert [[row[0].text, row[-1].text] for row in tables[0].rows] == [["a", "-"], ["b", "2 ± 0 (2)"]]
    record = json.loads((folder / "study.json").read_text())
    assert [run["run"] for run in record["runs"]] == [str(folder / f"wall.b.seed{k}") for k in (0, 1)]
    assert record["failures"] == failures
    assert "crossray: it broke" in (folder / "table.md").read_text()

    runs.started, runs.ends = [], {"wall.a.seed1": "echo still broken; exit 1"}
    tables, failures = run_study(study, one_after_the_other)
    assert runs.started == ["wall.a.seed0", "wall.a.seed1"]
    assert failures["wall.a.seed1"].startswith("exit status 1: still broken")
    log_file = (folder / "wall.a.seed0" / "log.txt").read_text()
    assert log_file == "going\ncrossray: it broke\n\n"  # kept, and nothing was printed in the second try

    runs.started, runs.ends = [], {}
    tables, failures = run_study(study, one_after_the_other)
    assert runs.started == ["wall.a.seed1"]
    assert failures == {}
    assert [row[-1].text for row in tables[0].rows] == ["2 ± 0 (2)", "2 ± 0 (2)"]

    def nothing(**_):
        raise AssertionError("nothing is left to be started")

    runs.started = []
    assert run_study(study, nothing) == (tables, {})
    assert runs.started == []


def test_study_json_tells_everything_about_a_run(cut, tmp_path, runs, trained):
    study = make_study(tiny_study(cut, tmp_path, variants={"a": {}}, seeds=[7]))
    run_study(study, one_after_the_other)
    (run,) = json.loads((study.folder / "study.json").read_text())["runs"]
    training = json.loads((trained / "training.json").read_text())
    (metrics,) = (json.loads(p.read_text()) for p in trained.glob("eval/*/*/metrics.json"))
    (meta,) = (json.loads(p.read_text()) for p in trained.glob("checkpoints/*/meta.json"))
    expected = {"variant": "a", "scene": "wall", "seed": 7, "steps": 2, "ranks": 1, "device": training["device"]}
    assert expected.items() <= run.items()
    assert run["seconds"] == training["train_seconds"]
    assert run["checkpoint_sha256"] == meta["sha256"]["model.safetensors"]
    assert run["protocols"][PROTOCOL]["mean"] == metrics["mean"]
    assert run["protocols"][PROTOCOL]["images"] == metrics["images"]
    assert run["protocols"][PROTOCOL]["versions"]["torch"] == run["source"]["versions"]["torch"]
    if (ROOT / ".git").exists():
        assert re.fullmatch(r"[0-9a-f]{40}(-changed)?", run["source"]["commit"])
    else:
        assert run["source"]["commit"] is None
    resolved = yaml.safe_load((study.folder / "wall.a.seed7" / "job.yaml").read_text())
    assert resolved["patch"]["seed"] == 7
    assert resolved["runs"] == str(study.folder)


def damage_training(run: Path) -> None:
    record = json.loads((run / "training.json").read_text())
    (run / "training.json").write_text(json.dumps(record | {"steps": 1}))


def damage_checkpoint(run: Path) -> None:
    (path,) = run.glob("checkpoints/*/model.safetensors")
    path.write_bytes(path.read_bytes()[:-1] + b"x")


def unfinished(run: Path) -> None:
    from pipeline.checkpoint import digest

    (path,) = run.glob("checkpoints/*/meta.json")
    meta = json.loads(path.read_text()) | {"finished": False}
    path.write_text(json.dumps(meta | {"digest": digest(meta)}))


def evaluation_of_another_checkpoint(run: Path) -> None:
    (path,) = run.glob("eval/*/*/metrics.json")
    path.write_text(path.read_text().replace(json.loads(path.read_text())["checkpoint_sha256"], "0" * 64))


@pytest.mark.parametrize(
    "harm",
    [
        lambda run: (run / "training.json").unlink(),
        lambda run: shutil.rmtree(run / "checkpoints"),
        lambda run: shutil.rmtree(run / "eval"),
        damage_training,
        damage_checkpoint,
        unfinished,
        evaluation_of_another_checkpoint,
    ],
)
def test_a_run_is_done_only_with_all_of_its_files(cut, tmp_path, trained, harm):
    run = expand(make_study(tiny_study(cut, tmp_path)))[0]
    shutil.copytree(trained, run.job.run)
    assert result_of(run) is not None
    harm(run.job.run)
    assert result_of(run) is None


def test_another_protocol_is_evaluated_and_another_job_is_refused_before_anything_runs(cut, tmp_path, runs):
    raw = tiny_study(cut, tmp_path)
    run_study(make_study(raw), one_after_the_other)
    runs.started = []
    more = make_study(raw, [f"scenes.wall.evaluate.protocols=[{PROTOCOL}, nerfw-half@R2]"])
    run_study(more, one_after_the_other)
    assert len(runs.started) == 4  # they are not done: one protocol is missing
    runs.started = []
    with pytest.raises(
        CrossrayError, match=r"wall\.b\.seed0 holds a run of another job:\n  train\.warmup_steps: 0 -> 9"
    ):
        run_study(make_study(raw, ["variants.b.train.warmup_steps=9"]), one_after_the_other)
    assert runs.started == []


def test_a_run_that_never_came_to_a_checkpoint_may_be_put_right(cut, tmp_path, runs):
    raw = tiny_study(cut, tmp_path, variants={"a": {}}, seeds=[0])
    runs.ends = {"wall.a.seed0": "exit 1"}
    assert run_study(make_study(raw), one_after_the_other)[1]
    runs.ends = {}
    _, failures = run_study(make_study(raw, ["base.train.warmup_steps=1"]), one_after_the_other)
    assert failures == {}


@pytest.mark.parametrize(
    ("setting", "part"),
    [
        (
            "scenes.wall.evaluate.protocols=[crnerf-full@R4]",
            r"variant a, scene wall: protocol crnerf-full@R4: the photos",
        ),
        ("scenes.wall.evaluate.protocols=[crnerf-fool@R2]", r"variant a, scene wall: protocol 'crnerf-fool'"),
        ("base.scene.downscale=1", r"variant a, scene wall: "),
        ("base.scene.shards=null", r"variant a, scene wall: .*nowhere"),
    ],
)
def test_what_cannot_run_is_refused_before_anything_runs(cut, tmp_path, runs, setting, part):
    settings = [setting]
    if "shards" in setting:
        settings.append(f"base.scene.path={tmp_path / 'nowhere'}")
    with pytest.raises(CrossrayError, match=part):
        run_study(make_study(tiny_study(cut, tmp_path), settings), one_after_the_other)
    assert runs.started == []


def test_shards_that_vanish_are_not_cut_by_the_process_of_a_run(cut, tmp_path, runs):
    (run, *_) = expand(make_study(tiny_study(cut, tmp_path)))
    run.job.run.mkdir(parents=True)
    spec = spec_of(run, tmp_path / "stop")._replace(shards=tmp_path / "gone")
    assert run_one(spec) == Outcome("wall.a.seed0", f"the shards in {tmp_path / 'gone'} are gone")
    assert runs.started == []


def test_what_a_run_asks_ray_for(cut, tmp_path, monkeypatch):
    import torch

    (run, *_) = expand(make_study(tiny_study(cut, tmp_path), ["base.ranks=3", "base.threads=2"]))
    assert needs_of(spec_of(run, tmp_path)) == {"num_cpus": 6, "num_gpus": 0}
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 4)
    assert needs_of(spec_of(run, tmp_path)) == {"num_cpus": 6, "num_gpus": 0}  # device: cpu
    on_gpus = run._replace(job=run.job.model_copy(update={"device": "auto"}))
    assert needs_of(spec_of(on_gpus, tmp_path)) == {"num_cpus": 0, "num_gpus": 3}


# -------------------------------------------------------------------------------------------------- a run's process


def spec_in(folder: Path, **over) -> Spec:
    folder.mkdir(exist_ok=True)
    (folder / "manifest.json").touch()
    whole = {"run": folder, "shards": folder, "folder": folder, "stop": folder / "stop", "threads": 3}
    return Spec(**({"name": "x", "cpus": 3, "gpus": 0} | whole | over))


def test_the_process_sees_its_threads_and_its_gpus_and_no_ray(tmp_path, monkeypatch):
    monkeypatch.setenv("RAY_ADDRESS", "10.0.0.1:6379")
    monkeypatch.setenv("OMP_NUM_THREADS", "64")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2,5")
    monkeypatch.setattr(process, "command", lambda spec: ["sh", "-c", "env; pwd"])
    outcome = run_one(spec_in(tmp_path))
    assert outcome == Outcome("x", f"exit status 0: {tmp_path}")
    printed = (tmp_path / "log.txt").read_text().splitlines()
    assert {"OMP_NUM_THREADS=3", "OMP_WAIT_POLICY=PASSIVE", "CUDA_VISIBLE_DEVICES=2,5"} <= set(printed)
    assert not [line for line in printed if line.startswith("RAY_")]
    assert "PATH" in environment(1)


def test_a_run_is_alone_in_its_folder(tmp_path):
    spec = spec_in(tmp_path)
    with alone(spec) as lock:
        assert isinstance(lock, int)
        spec.stop.touch()
        with alone(spec) as other:
            assert other is None  # asked to stop while it waited
        holder = subprocess.Popen(["sleep", "0.6"], pass_fds=[lock])
    spec.stop.unlink()
    with alone(spec) as lock:  # the process has it from the task, and keeps it when the task is gone
        assert isinstance(lock, int)
        assert holder.poll() == 0


def test_stop_is_a_sigterm_and_all_the_time_that_saving_takes(tmp_path, monkeypatch):
    script = "trap 'sleep 0.5; echo saved; exit 0' TERM; touch ready; while true; do sleep 0.05; done"
    monkeypatch.setattr(process, "command", lambda spec: ["sh", "-c", script])
    spec = spec_in(tmp_path)
    stop = subprocess.Popen(["sh", "-c", f"while ! test -e {tmp_path}/ready; do sleep 0.02; done; touch {spec.stop}"])
    assert run_one(spec) == Outcome("x", None)
    assert stop.wait() == 0
    assert (tmp_path / "log.txt").read_text() == "saved\n"
    monkeypatch.setattr(process, "command", lambda spec: ["touch", "never"])
    assert run_one(spec) == Outcome("x", None)
    assert not (tmp_path / "never").exists()


def test_endings_in_words(tmp_path, monkeypatch):
    assert ending(2) == "exit status 2"
    assert ending(-9) == "ended by SIGKILL"
    path = tmp_path / "log.txt"
    path.write_bytes(b"old\n\xff new \n \n")
    assert last_line(path, 0) == "\ufffd new"
    assert last_line(path, path.stat().st_size) == "it printed nothing"
    monkeypatch.setattr(process, "command", lambda spec: [str(tmp_path / "absent")])
    assert "No such file" in str(run_one(spec_in(tmp_path)).how)


def test_signals_become_a_file_and_are_given_back(tmp_path):
    before = [signal.getsignal(n) for n in (signal.SIGTERM, signal.SIGINT)]
    path = tmp_path / "stop"
    for number in (signal.SIGTERM, signal.SIGINT):
        with stopped_by_signals(path):
            assert not path.exists()
            signal.raise_signal(number)
            assert path.exists()
            signal.raise_signal(number)  # one Ctrl-C may arrive twice
        assert not path.exists()
    assert [signal.getsignal(n) for n in (signal.SIGTERM, signal.SIGINT)] == before


def test_a_stopped_study_says_so_and_starts_nothing_more(cut, tmp_path, runs):
    study = make_study(tiny_study(cut, tmp_path))
    runs.ends = {"wall.b.seed0": f"kill -TERM {os.getpid()}; exec sleep 30"}
    with pytest.raises(KeyboardInterrupt):
        run_study(study, one_after_the_other)
    assert runs.started == ["wall.a.seed0", "wall.b.seed0"]
    assert not list(study.folder.glob(".stop*"))
    runs.started, runs.ends = [], {}
    assert run_study(study, one_after_the_other)[1] == {}
    assert runs.started == ["wall.b.seed0", "wall.a.seed1", "wall.b.seed1"]


# ------------------------------------------------------------------------------------------------- the command line


@pytest.fixture
def crossray(monkeypatch, capsys):
    """crossray(*words): what the command does in this process; exit status, standard output, standard error."""
    logger = logging.getLogger("crossray")
    before = logger.handlers[:], logger.level, logger.propagate

    def run(*words: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["crossray", *map(str, words)])
        try:
            cli.main()
            status = 0
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else (0 if end.code is None else 1)
        out, err = (re.sub(r"\x1b\[[0-9;]*m", "", text) for text in capsys.readouterr())
        return status, out, err

    yield run
    logger.handlers[:], logger.level, logger.propagate = before


def study_file(tmp_path: Path, raw: dict) -> Path:
    path = tmp_path / "study.yaml"
    path.write_text("#!/usr/bin/env -S python -m pipeline run\n" + yaml.safe_dump(raw, sort_keys=False))
    return path


def test_the_command_refuses_with_one_message(crossray, cut, tmp_path):
    path = study_file(tmp_path, tiny_study(cut, tmp_path))
    status, out, err = crossray("run", path, "--set", "variants.b.train.epoch=3")
    assert (status, out) == (2, "")
    assert (
        err
        == f"crossray: {path}: variant b, scene wall: train.epoch: there is no such key; did you mean 'epochs'? "
        + (err.partition("'epochs'? ")[2])
    )
    status, _, err = crossray("run", path, "--launcher", "torchrun")
    assert status == 2
    assert "--launcher" in err
    assert not (tmp_path / "runs").exists()


def test_the_command_prints_the_tables_and_ends_with_status_1_if_a_run_is_not_done(
    crossray, cut, tmp_path, runs, monkeypatch
):
    from pipeline.launch import study as module

    monkeypatch.setattr(module.run_study, "__defaults__", (one_after_the_other,))
    runs.ends = {"wall.b.seed1": "echo '[/x] broken'; exit 1"}
    path = study_file(tmp_path, tiny_study(cut, tmp_path))
    status, out, err = crossray("run", path)
    assert status == 1, err
    assert "Traceback" not in err
    folder = tmp_path / "runs" / "tiny"
    assert f"not done: wall.b.seed1: exit status 1: [/x] broken ({folder}/wall.b.seed1/log.txt)" in out
    assert f"wall, {PROTOCOL}" in out
    assert re.search(r"a .* 2 ± 0 \(2\)", out)
    assert str(folder / "table.md") in out
    runs.ends = {}
    assert crossray("run", path)[0] == 0


# ---------------------------------------------------------------------------------------------------------- for real


@pytest.mark.slow
def test_a_real_study_through_the_command_line(crossray, cut, tmp_path):
    """Two variants, two seeds, Ray, real processes; then nothing is started again, Ray included."""
    path = study_file(tmp_path, tiny_study(cut, tmp_path, variants={"nerf": {}, "crnerf": {"method": "crossray"}}))
    words = ["run", path, "--set", "base.model.channels=8", "--set", "published=comparison-R4"]
    status, out, err = crossray(*words)
    assert status == 0, (out, err)
    folder = tmp_path / "runs" / "tiny"
    record = json.loads((folder / "study.json").read_text())
    assert [(r["variant"], r["seed"], r["steps"]) for r in record["runs"]] == [
        ("nerf", 0, 2),
        ("crnerf", 0, 2),
        ("nerf", 1, 2),
        ("crnerf", 1, 2),
    ]
    psnr = {
        v: [r["protocols"][PROTOCOL]["mean"]["psnr"] for r in record["runs"] if r["variant"] == v] for v in ("nerf",)
    }
    cell = f"{statistics.fmean(psnr['nerf']):.2f} ± {statistics.stdev(psnr['nerf']):.2f} (2)"
    text = (folder / "table.md").read_text()
    assert cell in text
    assert cell in out
    assert "26.86 / 0.9069 / 0.0733" in text
    assert psnr["nerf"][0] != psnr["nerf"][1]  # the seed does something
    logs = {p: p.read_bytes() for p in folder.glob("*/log.txt")}
    assert len(logs) == 4
    assert all(b"trained, 2 steps" in content for content in logs.values())
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "ray", None)  # importing it fails
        status, again, _ = crossray(*words)
    assert status == 0
    assert cell in again
    assert {p: p.read_bytes() for p in folder.glob("*/log.txt")} == logs


@pytest.mark.slow
def test_the_process_of_a_run_needs_no_ray_and_a_real_crash_is_told(cut, tmp_path, monkeypatch):
    (tmp_path / "path").mkdir()
    (tmp_path / "path" / "ray.py").write_text("raise SystemExit('this process must leave Ray alone')\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "path"))
    variants = {"good": {}, "bad": {"train": {"learning_rates": {"field": 1e30}, "steps_per_epoch": 20}}}
    study = make_study(tiny_study(cut, tmp_path, variants=variants, seeds=[0]))
    _, failures = run_study(study, one_after_the_other)
    assert failures.keys() == {"wall.bad.seed0"}
    assert re.match(r"exit status 2: .*finite", failures["wall.bad.seed0"]), failures
    assert "trained, 2 steps" in (study.folder / "wall.good.seed0" / "log.txt").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("ctrl_c", [False, True])
def test_a_stopped_study_leaves_checkpoints_and_goes_on(cut, tmp_path, ctrl_c):
    raw = tiny_study(cut, tmp_path, variants={"a": {}}, seeds=[0, 1, 2])
    raw["base"]["train"]["seconds"] = 4.0 if ctrl_c else 3600.0
    path = study_file(tmp_path, raw)
    folder = tmp_path / "runs" / "tiny"
    words = [sys.executable, "-m", "pipeline", "run", str(path)]
    with (tmp_path / "output").open("w+b") as output:
        study = subprocess.Popen(words, cwd=ROOT, stdout=output, stderr=subprocess.STDOUT, start_new_session=True)
    try:
        deadline = time.monotonic() + PATIENCE
        while not list(folder.glob("*/tensorboard/*")):  # a run trains
            assert study.poll() is None, (tmp_path / "output").read_text()
            assert time.monotonic() < deadline
            time.sleep(0.02)
        if ctrl_c:
            os.killpg(study.pid, signal.SIGINT)  # as a terminal does: Ray's processes get it, too
        else:
            study.send_signal(signal.SIGTERM)
        assert study.wait(PATIENCE) == 130, (tmp_path / "output").read_text()
    finally:
        if study.poll() is None:
            study.kill()
            study.wait()
    assert "run the same command again to go on" in (tmp_path / "output").read_text()
    metas = [json.loads(p.read_text()) for p in folder.glob("*/checkpoints/*/meta.json")]
    assert metas
    assert not any(meta["finished"] for meta in metas)
    assert not list(folder.glob(".stop*"))
    for path_of_lock in folder.glob("*/.running.lock"):  # nobody trains any more
        with path_of_lock.open("a") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    if ctrl_c:
        found = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
        assert found.returncode == 0, found.stderr
        assert any("resuming" in p.read_text() for p in folder.glob("*/log.txt"))
        assert len(json.loads((folder / "study.json").read_text())["runs"]) == 3


def meet(spec):
    """Wait until the other task is there, too: only tasks that run at once can meet."""
    folder, mine, theirs = spec
    (folder / mine).touch()
    deadline = time.monotonic() + 20
    while not (folder / theirs).exists():
        if time.monotonic() > deadline:
            return "alone"
        time.sleep(0.02)
    return "met"


def die(spec):
    if spec == "dies":
        os.kill(os.getpid(), signal.SIGKILL)
    return spec


@pytest.mark.slow
def test_tasks_take_what_they_need_and_a_dying_one_ends_nothing_else(tmp_path, monkeypatch):
    import ray

    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))  # workers import this module by name
    with ray_tasks(num_cpus=2):
        assert not ray.cluster_resources().get("GPU")
        with ray_tasks(needs=lambda spec: {"num_cpus": 1, "num_gpus": 0}) as mapper:
            assert list(mapper(meet, [(tmp_path, "a", "b"), (tmp_path, "b", "a")])) == ["met", "met"]
        with ray_tasks(needs=lambda spec: {"num_cpus": 64}, died=lambda spec, error: f"{spec}: {error}") as mapper:
            results = sorted(mapper(die, ["lives", "dies", "lives, too"]))
        assert results[0].startswith("dies: die: the process of a task died")
        assert results[1:] == ["lives", "lives, too"]
        with (
            ray_tasks(needs=lambda spec: {"num_cpus": 0, "num_gpus": 2}) as mapper,
            pytest.raises(TaskError, match="2 GPUs"),
        ):
            list(mapper(die, ["lives"]))
