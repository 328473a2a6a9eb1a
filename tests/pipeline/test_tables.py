"""Tables of results: what stands in which column, what is bold, what is never compared, where each number is from."""

from __future__ import annotations

import json
import logging
import math
import os
import re
import shlex
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest
import typer

from pipeline import cli, tables
from pipeline.beyond_tables import all_tables
from pipeline.bootstrap import interval, tied
from pipeline.config import load_job, make_job, save_job
from pipeline.page import as_html, as_markdown, commands, traces
from pipeline.paper_tables import PAPER_SCENES
from pipeline.protocol import parse_protocol
from pipeline.published import published_tables, published_times
from pipeline.records import Results, Source
from pipeline.results import Evaluated, Trainee, budget_of, read_results, score_of
from pipeline.tables import best_of, score_tables, shown
from pipeline.timing_job import make_timing

ROOT = Path(__file__).resolve().parents[2]
TEST_DATA = Path(os.environ.get("CROSSRAY_TEST_DATA", ROOT.parent / "shared" / "data"))
TEX = TEST_DATA.parent / "paper" / "crnerf.tex"
FULL = "crnerf-full@R1"
ORIGIN = {
    "command": "crossray run job.yaml",
    "commit": "c" * 40,
    "date": "2026-01-02T03:04:05+00:00",
    "hardware": {"processor": "Abacus 3000", "cores": 2, "memory_GiB": 4.0, "gpus": []},
}


@pytest.fixture(autouse=True)
def _here(tmp_path, monkeypatch):
    """Nothing of the project's own results is found."""
    monkeypatch.chdir(tmp_path)


def photos(*values: float, metric: str = "psnr") -> list[dict]:
    """Scores of photos a.jpg, b.jpg, ..."""
    return [{"name": f"{'abcdefghij'[i]}.jpg", "key": str(i), metric: value} for i, value in enumerate(values)]


def job_of(name: str, **over) -> dict:
    """A job on the landmark: fast field, 60 s on one core."""
    scene = {"path": "data/landmark", "downscale": 1, "reference_downscale": 1}
    base = {"name": name, "method": "crossray", "scene": scene, "device": "cpu", "train": {"seconds": 60}}
    return base | over


def add_run(name: str, images: list[dict], protocol: str = FULL, step: int = 900, **over) -> Path:
    """A finished run below runs/, with one evaluation; returns its metrics.json."""
    where = over.pop("provenance", ORIGIN)
    job = make_job(job_of(name, **over))
    job.run.mkdir(parents=True, exist_ok=True)
    save_job(job, job.run / "job.yaml")
    trained = {"steps": step, "finished": True, "device": "Abacus 3000", "ranks": job.ranks, "train_seconds": 60.1}
    (job.run / "training.json").write_text(json.dumps(trained))
    path = job.run / "eval" / protocol / f"step-{step:08d}" / "metrics.json"
    path.parent.mkdir(parents=True)
    definition = parse_protocol(protocol)[0].model_dump(mode="json")
    content = {"protocol": protocol, "definition": definition, "step": step, "checkpoint_sha256": f"sha of {name}"}
    path.write_text(json.dumps(content | {"images": images, "device": "Abacus 3000", "provenance": where}))
    return path


def found(*folders: str) -> Results:
    """All that is below runs/, and in `folders`."""
    Path("runs").mkdir(exist_ok=True)
    return read_results([Path("runs")], [Path(folder) for folder in folders])


def table_of(results: Results, start: str) -> tables.Table:
    """The table whose title starts so."""
    return next(table for table in all_tables(results) if table.title.startswith(start))


def row_of(table: tables.Table, label: str) -> tables.Row:
    return next(row for row in table.rows if row.label == label)


def ours(table: tables.Table, label: str) -> list[tables.Entry]:
    """A row's measured cells."""
    return [entry for entry in row_of(table, label).entries if entry.kind == "ours"]


CROSSRAY = "crossray (CR-NeRF on the fast field)"


# --------------------------------------------------------------------------------------------------------- arithmetic


def test_a_mean_is_over_photos_of_the_mean_over_seeds():
    for seed, values in enumerate([(10.0, 20.0, 30.0), (14.0, 22.0, 30.0)]):
        add_run(f"run{seed}", photos(*values), step=900 + 100 * seed, patch={"seed": seed})
    (entry,) = ours(table_of(found(), "1. Comparison at R/4"), CROSSRAY)
    low, high = interval([12.0, 21.0, 30.0])
    assert [line.text for line in entry.lines] == [
        f"21.00 [{low:.1f}, {high:.1f}]",  # (12 + 21 + 30) / 3
        "-",  # no SSIM, no LPIPS
        "-",
        "2 seeds, 950 steps",
    ]


def test_an_interval_of_equal_scores_is_a_point_and_one_photo_has_none():
    assert shown([7.0, 7.0], "psnr") == "7.00 [7.0, 7.0]"
    assert shown([0.25], "ssim") == "0.2500"
    assert shown([math.inf, 7.0], "psnr") == "inf"
    assert shown(None, "psnr") == "-"


def test_best_by_hand():
    ten, eleven = [10.0, 20.0, 30.0], [11.0, 21.0, 31.0]
    assert best_of([ten, eleven, None], "psnr") == 1  # a decibel better on every photo
    assert best_of([ten, eleven], "lpips") == 0  # there lower is better
    swapped = [12.0, 20.0, 31.5]  # better in the mean, and on two photos of three, but not on b.jpg
    assert tied(swapped, ten)
    assert best_of([ten, swapped], "psnr") is None
    assert best_of([[0.0, 1.0, 2.0], ten, swapped], "psnr") is None  # a third that is worse does not break the tie
    assert best_of([None, eleven], "psnr") is None  # alone
    assert best_of([ten, list(ten)], "psnr") is None
    assert best_of([[math.inf, 10.0], [9.0, 9.0]], "psnr") is None  # no interval, so nothing is known


def test_bold_is_the_best_of_a_column_and_a_tie_is_not():
    add_run("ours", photos(20.0, 21.0, 22.0))
    add_run("plain", photos(15.0, 17.0, 16.0), method="nerf", model={"field": "hash"})
    table = table_of(found(), "1. Comparison at R/4")
    assert ours(table, CROSSRAY)[0].lines[0].best
    assert not ours(table, "NeRF")[0].lines[0].best
    add_run("hanerf", photos(20.5, 20.5, 21.5), method="hanerf", model={"field": "hash"})
    table = table_of(found(), "1. Comparison at R/4")
    assert not any(entry.lines[0].best for row in table.rows for entry in row.entries if entry.lines)


@pytest.mark.parametrize("value", [1.0, 99.0])
def test_published_numbers_are_never_bold_and_ours_never_because_of_them(value):
    """Ours alone in the very column of the paper's scene and protocol, far above and far below what is published."""
    train = {"epochs": 20, "steps_per_epoch": 17200}
    scene = {"path": "data/brandenburg_gate", "downscale": 4}
    images = [row | {"ssim": 0.5 + i / 10, "lpips": 0.1} for i, row in enumerate(photos(value, value + 1, value + 2))]
    over = {"method": "crnerf", "scene": scene, "ranks": 8, "device": "cuda", "train": train}
    add_run("gate", images, protocol="crnerf-full@R4", **over)
    table = table_of(found(), "1. Comparison at R/4")
    assert len(ours(table, "CR-NeRF")) == 1
    place = [entry.kind for entry in row_of(table, "CR-NeRF").entries].index("ours")
    assert table.heads[place].lines[:4] == (
        "Brandenburg Gate",
        "crnerf-full@R4",
        "the paper's MLPs",
        "20 epochs × 17,200 steps",
    )
    assert not any(line.best for row in table.rows for entry in row.entries for line in entry.lines)
    assert "**" not in "".join(line for line in as_markdown([table], "c").splitlines() if line.startswith("|"))
    text = [line.text for line in row_of(table, "CR-NeRF").entries[0].lines]
    assert text == ["26.86", "0.9069", "0.0733"]


# ------------------------------------------------------------------------------------------------------------ columns


def test_nothing_is_mixed_in_a_column():
    """Scene, protocol, downscale, field, budget and photos each make a column of their own."""
    scene = {"path": "data/reichstag", "downscale": 8}
    add_run("base", photos(20.0, 21.0))
    add_run("half", photos(20.0, 21.0), protocol="nerfw-half@R1")
    add_run("longer", photos(20.0, 21.0), train={"seconds": 120})
    add_run("wider", photos(20.0, 21.0), ranks=2)
    add_run("other-photos", photos(20.0, 21.0, 22.0))
    add_run("scene", photos(20.0, 21.0), protocol="crnerf-full@R8", scene=scene)
    add_run("mlp", photos(20.0, 21.0), method="crnerf")
    results = found()
    assert len({score.column for score in results.scores}) == 7
    table = table_of(results, "1. Comparison at R/4")
    heads = [
        ", ".join(head.lines[:5])
        for head in table.heads
        if head.kind == "ours" and head.lines[-2] != "nothing measured yet"
    ]
    assert sorted(heads) == sorted(
        [
            "landmark, crnerf-full@R1, fast field, 60 s, 1 core",
            "landmark, crnerf-full@R1, fast field, 60 s, 1 core",
            "landmark, crnerf-full@R1, fast field, 120 s, 1 core",
            "landmark, crnerf-full@R1, fast field, 60 s, 2 cores",
            "landmark, crnerf-full@R1, the paper's MLPs, 60 s, 1 core",
            "landmark, nerfw-half@R1, fast field, 60 s, 1 core",
            "reichstag, crnerf-full@R8, fast field, 60 s, 1 core",
        ]
    )
    assert len(ours(table, CROSSRAY)) == 6
    assert len(ours(table, "CR-NeRF")) == 1
    for row in table.rows:
        assert all(
            entry.kind != "ours" or head.kind == "ours" for head, entry in zip(table.heads, row.entries, strict=True)
        )


def test_the_papers_columns_stand_in_one_half_of_the_comparison_alone():
    train = {"epochs": 20, "steps_per_epoch": 17200}
    scene = {"path": "data/trevi_fountain", "downscale": 2}
    over = {"method": "crnerf", "scene": scene, "ranks": 8, "device": "cuda", "train": train}
    add_run("trevi", photos(20.0, 21.0), protocol="crnerf-full@R2", **over)
    results = found()
    assert len(ours(table_of(results, "1. Comparison at R/2"), "CR-NeRF")) == 1
    assert not ours(table_of(results, "1. Comparison at R/4"), "CR-NeRF")
    assert len(ours(table_of(results, "2. Ablation"), "CR-NeRF")) == 1


def test_other_definitions_of_a_protocol_are_other_columns():
    add_run("now", photos(20.0, 21.0))
    path = add_run("before", photos(24.0, 25.0))
    content = json.loads(path.read_text())
    content["definition"]["rounding"] = "round"
    path.write_text(json.dumps(content))
    table = table_of(found(), "1. Comparison at R/4")
    entries = dict(zip(table.heads, row_of(table, CROSSRAY).entries, strict=True))
    measured = {entry.lines[0].text[:5]: head.lines for head, entry in entries.items() if entry.kind == "ours"}
    assert "another definition of the protocol" in measured["24.50"]
    assert "another definition of the protocol" not in measured["20.50"]
    assert {
        row.entries[table.heads.index(head)].kind
        for row in table.rows
        for head in entries
        if measured["24.50"] == head.lines
    } == {"ours", "none"}


def test_variants_are_rows_of_their_own_beyond_the_paper():
    add_run("ours", photos(20.0, 21.0))
    add_run("closed", photos(22.0, 23.0), model={"transform": "closed_form"})
    table = table_of(found(), "2. Ablation")
    row = row_of(table, "CR-NeRF, transform=closed_form, fast field")
    assert row.beyond
    assert row_of(table, CROSSRAY).beyond
    assert [r.label for r in table.rows if not r.beyond] == ["CR-NeRF-B", "CR-NeRF-A", "CR-NeRF-T", "CR-NeRF"]
    text = as_markdown([table], "c")
    assert "| CR-NeRF, transform=closed_form, fast field † |" in text


def test_fast_cr_nerf_is_crossray_and_other_patches_are_only_in_their_table():
    over = {"method": "crnerf", "model": {"field": "hash"}}
    add_run("rays", photos(20.0, 21.0), patch={"size": 20, "photos": 1}, **over)
    results = found()
    assert not ours(table_of(results, "1. Comparison at R/4"), CROSSRAY)
    assert len(ours(table_of(results, "4. Number of rays"), f"{CROSSRAY}, 400 rays")) == 1
    add_run("same", photos(20.0, 21.0), **over)
    assert len(ours(table_of(found(), "1. Comparison at R/4"), CROSSRAY)) == 1


def test_masks_are_told_apart_by_the_name_of_their_run():
    over = {"method": "crnerf-a-masks", "model": {"field": "hash"}}
    for name in ("gate-deeplabv3", "gate-maskrcnn", "gate-true"):
        add_run(name, photos(20.0, 21.0), **over)
    table = table_of(found(), "3. Transient")
    for label in ("CR-NeRF-A + DeepLabV3", "CR-NeRF-A + Mask R-CNN", "CR-NeRF-A + masks made elsewhere, fast field"):
        assert len(ours(table, label)) == 1


def test_affine_controls_have_a_table_of_their_own():
    add_run("plain", photos(15.0, 17.0), protocol=f"{FULL}+affine", method="nerf", model={"field": "hash"})
    results = found()
    assert not ours(table_of(results, "1. Comparison at R/4"), "NeRF")
    assert ours(table_of(results, "Beyond the paper: fits"), "NeRF, fast field")[0].lines[0].text.startswith("16.00")


# ------------------------------------------------------------------------------------------------------------- records


def test_code_and_settings_are_never_averaged():
    for seed in (0, 1):
        add_run(f"old{seed}", photos(10.0, 10.0), patch={"seed": seed}, provenance=ORIGIN | {"commit": "old"})
    add_run("new", photos(30.0, 30.0), patch={"seed": 2}, provenance=ORIGIN | {"commit": "new", "date": "2027-01-01"})
    (entry,) = ours(table_of(found(), "1. Comparison at R/4"), CROSSRAY)
    assert entry.lines[0].text == "10.00 [10.0, 10.0]"  # more seeds
    assert [source.commit for source in entry.others] == ["new"]
    add_run(
        "new-too", photos(32.0, 32.0), patch={"seed": 3}, provenance=ORIGIN | {"commit": "new", "date": "2027-01-01"}
    )
    (entry,) = ours(table_of(found(), "1. Comparison at R/4"), CROSSRAY)
    assert entry.lines[0].text == "31.00 [31.0, 31.0]"  # as many, and newer
    add_run(
        "tuned", photos(50.0, 50.0), patch={"seed": 4}, losses={"content": 0.5}, provenance=ORIGIN | {"commit": "new"}
    )
    (entry,) = ours(table_of(found(), "1. Comparison at R/4"), CROSSRAY)
    assert entry.lines[0].text == "31.00 [31.0, 31.0]"
    assert ("losses.content=0.5",) in [source.settings for source in entry.others]


def test_the_newest_step_alone_counts_and_only_where_the_training_ended(caplog):
    add_run("run", photos(10.0, 10.0), step=800)
    path = add_run("run", photos(20.0, 20.0), step=900)
    assert [score.steps for score in found().scores] == [900]
    trained = path.parents[3] / "training.json"
    trained.write_text(json.dumps(json.loads(trained.read_text()) | {"finished": False}))
    with caplog.at_level(logging.WARNING, "crossray"):
        assert found().scores == ()
    assert "step 900 is not the end of the training" in caplog.text


def test_an_imported_checkpoint_says_so_and_has_no_commands():
    path = add_run("released", photos(25.0, 26.0), method="crnerf")
    (path.parents[3] / "training.json").unlink()
    (path.parents[3] / "imported.json").write_text("{}")
    table = table_of(found(), "1. Comparison at R/4")
    assert table.heads[-1].lines[3] == "imported checkpoint"
    assert {row.entries[-1].kind for row in table.rows} == {"ours", "none"}


def study_of(**over) -> dict:
    """study.json as an older version wrote it: no protocol definition, no command, no date, no hardware."""
    run = {
        "run": "runs/s/landmark.a.seed0",
        "scene": "landmark",
        "variant": "a",
        "seed": 0,
        "steps": 900,
        "device": "Abacus 3000",
        "checkpoint_sha256": "1234",
        "source": {"commit": "abc", "machine": "x86_64"},
        "protocols": {FULL: {"mean": {"psnr": 1.0}, "images": photos(20.0, 22.0)}},
    }
    job = job_of("x")
    study = {
        "kind": "study",
        "name": "s",
        "base": {"device": "cpu", "train": {"seconds": 60}},
        "variants": {"a": {"method": "crossray", "seeds": None}},
        "scenes": {"landmark": {"scene": job["scene"], "evaluate": {"protocols": [FULL]}}},
    }
    return {"study": study, "runs": [run | over], "failures": {}}


def test_an_older_study_is_read_and_what_it_lacks_is_not_made_up():
    Path("results").mkdir()
    Path("results/s.json").write_text(json.dumps(study_of()))
    table = table_of(found("results"), "1. Comparison at R/4")
    (entry,) = ours(table, CROSSRAY)
    assert entry.lines[0].text.startswith("21.00 [")
    (source,) = entry.sources
    assert source == Source(
        file="results/s.json",
        run="runs/s/landmark.a.seed0",
        commit="abc",
        hardware="Abacus 3000, x86_64",
        notes=("the protocol's definition is not recorded",),
    )
    for text in (as_markdown([table], "c"), as_html([table], "c")):
        assert "command not recorded" in text
        assert "date not recorded" in text
        assert "commit not recorded" not in text


def test_a_checkpoint_that_stands_in_two_files_counts_once():
    path = add_run("run", photos(20.0, 22.0))
    Path("results").mkdir()
    Path("results/s.json").write_text(json.dumps(study_of(checkpoint_sha256="sha of run")))
    (score,) = found("results").scores
    assert score.source.file == str(path)


def test_damaged_and_foreign_files_are_one_warning_each(caplog):
    add_run("good", photos(20.0, 22.0))
    add_run("cut", photos(1.0)).write_text('{"protocol": ')
    add_run("empty", [])
    add_run("nameless", [{"psnr": 3.0}])
    add_run("unknown-protocol", photos(1.0)).write_text(
        json.dumps({"protocol": "x", "step": 900, "images": photos(1.0)})
    )
    folder = Path("results")
    folder.mkdir()
    files = {
        "list": [1],
        "strange": {"a": 1},
        "bad-study": {"study": {}, "runs": []},
        "bad-timing": {"format": 1, "rows": 3},
    }
    for name, content in files.items():
        (folder / f"{name}.json").write_text(json.dumps(content))
    (folder / "binary.json").write_bytes(b"\xff\xfe\x00")
    (folder / "deep.json").write_text("[" * 100_000)
    (folder / "other-benchmark.json").write_text(json.dumps({"machine": {"cores": 2}, "numbers": [1]}))
    with caplog.at_level(logging.WARNING, "crossray"):
        results = found("results")
    assert [score.images["a.jpg"]["psnr"] for score in results.scores] == [20.0]
    lines = [record.getMessage() for record in caplog.records]
    for name in ("cut", "empty", "nameless", "unknown-protocol", *files, "binary", "deep"):
        assert sum(f"/{name}" in line for line in lines) == 1, name
    assert len(lines) == 10


def test_infinity_is_shown_and_is_nobodys_victory():
    add_run("same", photos(math.inf, 30.0))
    add_run("plain", photos(10.0, 10.0), method="nerf", model={"field": "hash"})
    table = table_of(found(), "1. Comparison at R/4")
    (entry,) = ours(table, CROSSRAY)
    assert entry.lines[0] == tables.Cell("inf")


# ------------------------------------------------------------------------------------------------------------ commands


def test_every_empty_cell_has_a_command_that_fills_just_this_cell(monkeypatch):
    """Each command is parsed, its job made, and what that job would give is looked up: the same row and column."""
    monkeypatch.chdir(ROOT)
    asked = []
    genuine = tables.command

    def watched(row, column, protocols):
        text = genuine(row, column, protocols)
        asked.append((row, column, protocols, text))
        return text

    monkeypatch.setattr(tables, "command", watched)
    results = read_results([], [ROOT / "benchmarks" / "results"])
    made = score_tables(results.scores)
    lacking = [entry for table in made for row in table.rows for entry in row.entries if entry.kind == "lacking"]
    assert len(lacking) == len(asked) > 100
    for row, column, protocols, text in asked:
        mask, _, run = text.rpartition(" && ")
        words = shlex.split(run)
        settings = [word for word in words[1:] if word != "--set"]
        assert len(words) == 1 + 2 * len(settings)
        job = load_job(ROOT / words[0], settings)
        assert job.evaluate.protocols == tuple(protocols)
        assert column.protocol in protocols
        evaluated = Evaluated(definition=None, images=[{"name": name} for name in column.photos] or photos(1.0))
        trainee = Trainee(job, job.name, 0, 1, "sha", budget_of(job, column.budget.machine or None, {}))
        score = score_of(trainee, column.protocol, evaluated, Source("f"))
        assert row.takes(score), text
        photos_of = column.photos or frozenset(["a.jpg"])
        assert score.column == column._replace(photos=photos_of), text
        assert bool(mask) == bool(row.masks)
        if mask:
            assert shlex.split(mask) == ["crossray", "mask", f"data/{column.scene}", "--with", row.masks, "--replace"]


def test_the_commands_of_times_exist():
    known = typer.main.get_command(cli.app).commands
    for table in all_tables(Results())[6:8]:
        for text in commands(table):
            program, command, *_ = shlex.split(text)
            assert (program, command) == ("crossray", "timing")
            assert command in known


def test_cells_that_no_training_can_fill_have_no_command():
    add_run("ours", photos(20.0, 21.0))
    table = table_of(found(), "1. Comparison at R/4")
    assert row_of(table, "CR-NeRF").entries[-1].lines[0].text == "as crossray"
    assert [entry.kind for entry in row_of(table, CROSSRAY).entries[:-1]] == ["none"] * 6


# ---------------------------------------------------------------------------------------------------------- provenance


def test_every_cell_of_ours_is_traced_by_row_and_letter():
    path = add_run("ours", photos(20.0, 21.0))
    add_run("half", photos(20.0, 21.0), protocol="nerfw-half@R1")
    table = table_of(found(), "1. Comparison at R/4")
    cells = {(row.label, id(entry)) for row in table.rows for entry in row.entries if entry.kind == "ours"}
    traced = [trace.cells for trace in traces(table)]
    assert traced == [{CROSSRAY: ["d"]}, {CROSSRAY: ["e"]}]  # a, b, c: the paper's three scenes, nothing measured
    assert len(cells) == 2
    for text in (as_markdown([table], "c"), as_html([table], "c")):
        for part in (str(path), ORIGIN["command"], ORIGIN["commit"], ORIGIN["date"], "Abacus 3000, 2 cores, 4.0 GiB"):
            assert part in text
    title = re.search(r'<td class="ours" title="([^"]*)"', as_html([table], "c"))
    assert title is not None
    assert title[1].splitlines()[2:5] == [
        f"command: {ORIGIN['command']}",
        f"commit: {'c' * 40}",
        f"date: {ORIGIN['date']}",
    ]


def test_every_number_of_ours_in_any_table_has_a_source(monkeypatch):
    monkeypatch.chdir(ROOT)
    made = all_tables(read_results([], [Path("benchmarks/results")]))
    entries = [entry for table in made for row in table.rows for entry in row.entries]
    assert sum(entry.kind == "ours" for entry in entries) > 50
    for entry in entries:
        assert bool(entry.sources) == (entry.kind == "ours")
        assert all(Path(source.file).is_file() for source in entry.sources)
        assert entry.kind in ("ours", "published") or not any(line.best for line in entry.lines)
        assert entry.kind != "published" or not any(line.best for line in entry.lines)


def timing_record() -> dict:
    """timing.json of two images and a step."""
    image = {
        "table": "inference",
        "method": "crnerf",
        "field": "mlp",
        "downscale": 4,
        "width": 248,
        "height": 186,
        "appearances": 1,
        "how": "rendered",
        "samples": [64, 64],
        "samples_as": "trained",
        "unit": "image",
        "seconds": 2.5,
        "low": 2.25,
        "high": 3.0,
        "repeats": 3,
        "peak_memory_MiB": 512.0,
        "memory_of": "host",
        "threads": 1,
        "precision": "float32",
        "device": "Abacus 3000",
    }
    step = image | {"table": "training", "unit": "step", "how": "trained", "minutes": 12345.0, "rays": 1024}
    step |= {"photos": 763, "steps": 344000}
    step |= {"downscale": None, "width": None, "height": None, "appearances": None, "extrapolated": "from 3 steps"}
    many = image | {"table": "appearances", "appearances": 64, "how": "recoloured", "seconds": 0.05}
    return {"format": 1, "rows": [image, step, image | {"table": "appearances"}, many], "provenance": ORIGIN}


def test_times_stand_beside_the_published_ones():
    Path("results").mkdir()
    Path("results/timing-x.json").write_text(json.dumps(timing_record()))
    made = all_tables(found("results"))
    inference, training = made[6:8]
    assert [line.text for line in row_of(inference, "CR-NeRF").entries[0].lines] == ["4.02 s"]
    assert [entry.lines[0].text for entry in row_of(training, "Ha-NeRF").entries[:3]] == ["20", "17200", "1701"]
    (entry,) = ours(inference, "CR-NeRF")
    assert [line.text for line in entry.lines] == ["2.5 s [2.25, 3]", "rendered, 64 + 64 samples", "512 MiB (host)"]
    (entry,) = ours(training, "CR-NeRF")
    assert [line.text for line in entry.lines][:3] == [
        "12,345 min",
        "2.5 s a step [2.25, 3]",
        "extrapolated",
    ]
    assert entry.sources[0].notes == ("from 3 steps",)
    assert entry.sources[0].command == ORIGIN["command"]
    for table in (inference, training):
        (lacking,) = [entry for entry in row_of(table, "Ha-NeRF").entries if entry.kind == "lacking"]
        program, command, what, *words = shlex.split(lacking.command)
        assert (program, command) == ("crossray", "timing")
        job = make_timing({"name": "x", "what": [what]}, [word for word in words if word != "--set"])
        assert (job.device, job.threads, job.precision) == ("cpu", 1, ("float32",))
        if table is inference:
            assert (job.inference.methods, job.inference.samples, job.inference.downscales) == (
                ("hanerf",),
                ("trained",),
                (4,),
            )
            assert job.size(4) == (186, 248)
        else:
            assert (job.training.methods, job.training.ranks) == (("hanerf",), 1)
            assert (job.training.rays, job.training.photos) == (1024, 763)
    many = next(table for table in made if "images a second" in table.title)
    assert [entry.lines[0].text for entry in many.rows[0].entries] == ["0.4", "20"]
    assert "| CR-NeRF |" in as_markdown([many], "c")  # in a table that the paper lacks as a whole no row is marked
    assert not any(line.best for row in inference.rows for entry in row.entries for line in entry.lines)


def test_the_race_and_the_overheads_are_shown_if_they_were_run():
    training = {"steps": 900, "ranks": 2}
    run = {"seconds": 36.0, "training": training, "best_step": 800, "best_psnr": 22.0, "images": [21.0, 23.0]}
    slow = run | {"seconds": 1800.0, "best_psnr": 20.0, "images": [19.0, 21.0]}
    Path("results").mkdir()
    Path("results/race.json").write_text(json.dumps({"crossray": run, "crnerf": slow, "provenance": ORIGIN}))
    Path("results/overheads.json").write_text(json.dumps({"machine": {"cores": 2}, "seconds": {"ray": 26.3}}))
    results = found("results")
    table = table_of(results, "Beyond the paper: the fast preset")
    assert [entry.lines[0].text for entry in row_of(table, CROSSRAY).entries] == [
        "36 s on 2 cores",
        "900",
        "22.00 [21.0, 23.0]",
        "step 800",
    ]
    assert "between 2.00 and 2.00 dB" in table.text
    assert table_of(results, "Beyond the paper: operations").rows[0].label == "seconds, ray"


def test_flicker_and_bars_are_shown_as_their_benchmarks_write_them(caplog):
    run = {
        "run": "a",
        "truth": {"frame": 0.5, "point": 1.0},
        "flicker": {"view": {"frame": 2.0, "point": 3.25}, "running": {"frame": 1.5, "point": 2.0}},
        "psnr": {FULL: {"view": [20.0, 22.0], "running": [21.0, 21.0]}},
    }
    bar = {"bar": "(a) 64 appearances", "measured": 31.25, "wanted": ">= 20 x", "met": True}
    Path("results").mkdir()
    Path("results/flicker.json").write_text(json.dumps({"runs": [run], "provenance": ORIGIN}))
    Path("results/appearances.json").write_text(json.dumps({"bars": [bar], "provenance": ORIGIN}))
    Path("results/race.json").write_text(json.dumps({"crnerf": {"seconds": "an hour"}, "provenance": ORIGIN}))
    with caplog.at_level(logging.WARNING, "crossray"):
        results = found("results")
        table = table_of(results, "Beyond the paper: flicker")
    texts = {row.label: [entry.lines[0].text for entry in row.entries] for row in table.rows}
    assert texts == {
        "a, statistics: view": ["2", "3.25", "21.00 [20.0, 22.0]"],
        "a, statistics: running": ["1.5", "2", "21.00 [21.0, 21.0]"],
        "a, the truth itself": ["0.5", "1", "-"],
    }
    table = table_of(results, "Beyond the paper: many appearances")
    assert [entry.lines[0].text for entry in table.rows[0].entries] == ["31.2", ">= 20 x", "met"]
    assert "results/race.json: left out of the tables" in caplog.text
    assert not any("fast preset" in made.title for made in all_tables(results))


# --------------------------------------------------------------------------------------------------------------- pages


class Page(HTMLParser):
    """Collects tags and cells, and that all that is opened is closed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict]] = []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in ("meta", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


HOSTILE = "a|b<script>alert(1)</script>`*[x](javascript:0)_&\"'"


def test_hostile_names_stay_text():
    scene = {"path": f"data/{HOSTILE.replace('/', '')}", "downscale": 1}
    add_run(
        "evil", photos(20.0, 21.0), scene=scene, provenance=ORIGIN | {"command": f"crossray {HOSTILE}\n```\n</details>"}
    )
    table = table_of(found(), "1. Comparison at R/4")
    page = as_html([table], HOSTILE)
    tags = {tag for tag, _ in Page(page).tags}
    assert "script" not in tags
    assert not any("onerror" in attributes for _, attributes in Page(page).tags)
    text = as_markdown([table], "crossray tables")
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert len({line.count("|") for line in lines}) == 1
    assert "<script" not in "".join(lines)
    assert sum(line.startswith("```") for line in text.splitlines()) == 4  # two blocks, and each is closed
    assert "](javascript" not in "".join(lines)
    for filler in commands(table):
        assert filler.count("\n") == 0
        words = shlex.split(filler)
        load_job(ROOT / words[0], [word for word in words[1:] if word != "--set"])


def test_both_formats_show_the_same_cells_and_tell_published_from_ours():
    add_run("ours", photos(20.0, 21.0, 22.0))
    add_run("plain", photos(15.0, 17.0, 16.0), method="nerf", model={"field": "hash"})
    made = all_tables(found())
    text, page = as_markdown(made, "crossray tables"), as_html(made, "crossray tables")
    assert "*26.86*<br>*0.9069*<br>*0.0733*" in text
    assert "**21.00 [20.3, 21.7]**" in text.replace(shown([20.0, 21.0, 22.0], "psnr"), "21.00 [20.3, 21.7]")
    tags = Page(page).tags
    classes = [attributes.get("class") for tag, attributes in tags if tag == "td"]
    cells = [entry.kind for table in made for row in table.rows for entry in row.entries]
    assert classes == cells
    assert page.count("http") == 0  # nothing is loaded
    ids = [attributes["id"] for _, attributes in tags if "id" in attributes]
    assert len(ids) == len(set(ids))
    assert {a["href"][1:] for tag, a in tags if tag == "a"} <= set(ids)


def test_empty_results_are_the_papers_numbers_and_commands():
    made = all_tables(found())
    assert [table.title for table in made] == [
        "1. Comparison at R/4",
        "1. Comparison at R/2",
        "2. Ablation",
        "3. Transient handlers",
        "4. Number of rays",
        "5. Uncertainty in place of masks",
        "6. Inference time",
        "7. Training time",
    ]
    kinds = {entry.kind for table in made for row in table.rows for entry in row.entries}
    assert kinds == {"published", "lacking", "none"}
    shown_numbers = sum(
        line.text != "-"
        for table in made
        for row in table.rows
        for entry in row.entries
        if entry.kind == "published"
        for line in entry.lines
    )
    assert shown_numbers == 45 + 45 + 36 + 12 + 10 + 12 + 8 + 9  # every number of the paper's seven tables


def test_the_published_page_is_what_the_recorded_results_give(monkeypatch):
    """docs/results.md was made from benchmarks/results as it is: `crossray tables --out docs`."""
    monkeypatch.chdir(ROOT)
    text = Path("docs/results.md").read_text()
    command = text.split("```sh\n", 1)[1].split("\n", 1)[0]
    assert command.startswith("crossray tables --out docs")
    assert as_markdown(all_tables(read_results([], [Path("benchmarks/results")])), command) == text


# -------------------------------------------------------------------------------------------------------- command line


@pytest.fixture
def crossray(monkeypatch, capsys):
    """crossray(*words): exit status, standard output, standard error."""
    logger = logging.getLogger("crossray")
    before = logger.handlers[:], logger.level, logger.propagate

    def run(*words: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["crossray", *map(str, words)])
        try:
            cli.main()
            status = 0
        except SystemExit as end:
            status = int(end.code or 0)
        out, err = capsys.readouterr()
        return status, out, err

    yield run
    logger.handlers[:], logger.level, logger.propagate = before


def test_the_command_writes_a_page(crossray):
    add_run("ours", photos(20.0, 21.0))
    status, out, _ = crossray("tables", "--out", "made")
    assert (status, out) == (0, "made/results.md: 1 scores, 0 times\n")
    text = Path("made/results.md").read_text()
    assert text.startswith("# Results\n")
    assert "crossray tables --out made\n" in text
    status, _, _ = crossray("tables", "--out", "made", "--format", "html")
    assert status == 0
    assert Path("made/results.html").read_text().startswith("<!doctype html>")
    status, out, _ = crossray("tables")
    assert (status, out) == (0, text.replace("crossray tables --out made\n", "crossray tables\n"))


def test_the_command_reads_several_folders_and_says_what_is_wrong(crossray, tmp_path):
    add_run("ours", photos(20.0, 21.0))
    Path("runs").rename("there")
    Path("results").mkdir()
    Path("results/s.json").write_text(json.dumps(study_of()))
    status, out, _ = crossray("tables", "--runs", "there", "--results", "results", "--out", ".")
    assert (status, out) == (0, "results.md: 2 scores, 0 times\n")
    for words, part in (
        (["--runs", "absent"], "absent: no such folder"),
        (["--results", "absent"], "absent: no such folder"),
        (["--format", "htm"], "--format htm: there is no such format; did you mean 'html'?"),
    ):
        status, _, err = crossray("tables", *words)
        assert status == 2
        assert part in err
    (Path("results") / "bad.json").write_text("{")
    status, _, err = crossray("tables", "--runs", "there", "--results", "results", "--out", ".")
    assert status == 0
    assert "results/bad.json: left out of the tables" in err


# ---------------------------------------------------------------------------------------------------- published numbers


def test_the_papers_tables_of_times():
    """Typed from the tables of the LaTeX source."""
    assert published_times() == {
        "inference": {
            "hanerf": {"single-R4": 4.92, "single-R2": 14.01, "multiple-R4": 3.88, "multiple-R2": 24.09},
            "crnerf": {"single-R4": 4.02, "single-R2": 15.07, "multiple-R4": 0.92, "multiple-R2": 2.12},
        },
        "training": {
            "nerfw": {"epochs": 20, "iterations": 17200, "minutes": 1504},
            "hanerf": {"epochs": 20, "iterations": 17200, "minutes": 1701},
            "crnerf": {"epochs": 20, "iterations": 17200, "minutes": 1583},
        },
    }
    assert "times" not in published_tables()


@pytest.mark.real
@pytest.mark.skipif(not TEX.is_file(), reason="the paper's LaTeX source is not beside CROSSRAY_TEST_DATA")
def test_all_published_numbers_against_the_papers_source():
    """Every row of every table of scores, found as a row of the source: each number, in this order."""
    source = re.sub(
        r"\\cellcolor\[rgb\]\{[^}]*\}|\$?\\text(bf)?\{|\\secondbest\{|_\{\([^)]*\)\}|[${}~\s]|%", "", TEX.read_text()
    )
    expected = 0
    own = ("methods-R4", "transient-R4")  # the same numbers by other names
    for name, table in published_tables().items():
        for row, scores in table.items():
            if name in own:
                continue
            if name.startswith("num-rays"):
                continue
            separator = "/" if name.startswith("uncertainty") else "&"
            digits = {"psnr": 2, "ssim": 4, "lpips": 4}
            cells = [
                separator.join(f"{value:.{digits[metric]}f}" for metric, value in s.items()) for s in scores.values()
            ]
            assert "&" + "&".join(cells) + "\\\\" in source.replace("\\tnote*", ""), (name, row)
            expected += sum(map(len, scores.values()))
    for name in ("num-rays-R4", "num-rays-hanerf-R4"):
        cells = [f"{scores['brandenburg_gate']['psnr']:.2f}" for scores in published_tables()[name].values()]
        assert "&" + "&".join(cells) + "\\\\" in source
        expected += len(cells)
    for times in published_times()["inference"].values():
        assert "&" + "&".join(f"{value:.2f}s" for value in times.values()) + "\\\\" in source
        expected += len(times)
    for times in published_times()["training"].values():
        assert "&".join(f"{value:g}" for value in times.values()) + "\\\\" in source
        expected += len(times)
    assert expected == 45 + 45 + 36 + 12 + 10 + 12 + 8 + 9
    assert set(PAPER_SCENES) == {
        scene for table in published_tables().values() for row in table.values() for scene in row
    }
