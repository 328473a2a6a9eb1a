"""The command line: what the user has to put right is one message and exit status 2, never a traceback."""

from __future__ import annotations

import json
import logging
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from tiny_run import cut_tiny, tiny_job, tiny_mapping

from model.methods import METHODS
from pipeline import cli
from pipeline.config import Job

ROOT = Path(__file__).resolve().parents[2]
COMMANDS = (
    "quickstart",
    "landmark",
    "mask",
    "shard",
    "verify",
    "run",
    "submit",
    "timing",
    "status",
    "tables",
    "compare",
    "evaluate",
    "bake",
    "report",
    "import-checkpoint",
    "methods",
    "schema",
)


@pytest.fixture
def crossray(monkeypatch, capsys):
    """crossray(*words): what the command does in this process; exit status, standard output, standard error."""
    logger = logging.getLogger("crossray")
    before = logger.handlers[:], logger.level, logger.propagate
    monkeypatch.setenv("COLUMNS", "200")

    def run(*words: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["crossray", *map(str, words)])
        try:
            cli.main()
            status = 0
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else (0 if end.code is None else 1)
        out, err = capsys.readouterr()
        return status, plain(out), plain(err)

    yield run
    logger.handlers[:], logger.level, logger.propagate = before


def plain(text: str) -> str:
    """Without the colours of a terminal."""
    return re.sub(r"\x1b\[[0-9;]*m", "", text)


@pytest.fixture(scope="module")
def cut(tmp_path_factory):
    return cut_tiny(tmp_path_factory.mktemp("cli"))


@pytest.fixture(autouse=True)
def _cache(cut, monkeypatch):
    monkeypatch.setenv("CROSSRAY_CACHE", str(cut / "cache"))
    monkeypatch.delenv("RANK", raising=False)


@pytest.fixture
def job_file(cut, tmp_path):
    """job_file(**changes): a tiny job of two steps as a file."""

    def write(method="nerf", **over):
        mapping = tiny_mapping(
            cut, method, {"runs": str(tmp_path / "runs"), "train": {"epochs": 1, "steps_per_epoch": 2}}
        )
        path = tmp_path / "job.yaml"
        path.write_text(yaml.safe_dump(mapping | over))
        return path

    return write


def refused(result: tuple[int, str, str], *parts: object) -> str:
    status, out, err = result
    assert status == 2, (out, err)
    assert "Traceback" not in out + err
    for part in parts:
        assert str(part) in err, err
    return err


# Help


def test_help_lists_every_command(crossray):
    status, out, _ = crossray("--help")
    assert status == 0
    assert all(re.search(rf"\b{command}\b", out) for command in COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(crossray, command):
    status, out, _ = crossray(command, "--help")
    assert status == 0
    assert f"crossray {command}" in out
    options = {"run": ["--set", "--launcher", "JOB"], "shard": ["--out", "--downscale", "--list-patches", "--ranks"]}
    options |= {"evaluate": ["--protocol", "--step", "RUN"], "verify": ["FOLDER"], "quickstart": ["--out"]}
    for option in options.get(command, []):
        assert option.lower() in out.lower()


def test_help_is_quick_for_it_imports_no_stage():
    code = "import sys, pipeline.cli; print([m for m in ('torch', 'ray', 'pycolmap') if m in sys.modules])"
    found = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"


def test_an_unknown_command_is_exit_status_2(crossray):
    refused(crossray("trian"), "trian")


@pytest.mark.slow
def test_the_module_and_the_command_are_the_same():
    listed = [
        subprocess.run([*words, "methods"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
        for words in ([sys.executable, "-m", "pipeline"], [str(Path(sys.executable).with_name("crossray"))])
    ]
    assert listed[0] == listed[1]


# What is known


def test_schema_is_the_json_schema_of_a_job(crossray):
    status, out, _ = crossray("schema")
    assert status == 0
    schema = json.loads(out)
    assert schema == json.loads(json.dumps(Job.model_json_schema()))
    assert schema["type"] == "object"
    references = set(re.findall(r'"\$ref": "#/\$defs/(\w+)"', out))
    assert references <= schema["$defs"].keys()  # none dangles


@pytest.mark.parametrize("columns", ["200", "80"])
def test_methods_lists_every_row(crossray, monkeypatch, columns):
    monkeypatch.setenv("COLUMNS", columns)
    status, out, _ = crossray("methods")
    assert status == 0
    for name, method in METHODS.items():
        line, *_ = [line for line in out.splitlines() if re.match(rf"\W*{re.escape(name)} ", line)]
        assert all(word in line for word in method.axes().values())


# Shards


def test_verify_of_good_shards(crossray, cut):
    status, out, _ = crossray("verify", cut / "shards" / "tiny")
    assert status == 0
    assert re.search(r"6 shards, 6 photos", out)


@pytest.mark.parametrize("damage", ["flip", "truncate", "remove", "add"])
def test_verify_of_damaged_shards_names_the_file(crossray, tmp_path, damage):
    folder = cut_tiny(tmp_path) / "shards" / "tiny"
    path = folder / "shard-000002.tar"
    content = bytearray(path.read_bytes())
    if damage == "flip":
        content[len(content) // 2] ^= 1
        path.write_bytes(content)
    elif damage == "truncate":
        path.write_bytes(content[:-512])
    elif damage == "remove":
        path.unlink()
    else:
        path = folder / "shard-000099.tar"
        path.write_bytes(content)
    refused(crossray("verify", folder), path.name)


def test_verify_of_something_else(crossray, tmp_path):
    refused(crossray("verify", tmp_path), tmp_path)
    refused(crossray("verify", tmp_path / "absent"), "absent")


@pytest.mark.parametrize(
    ("setting", "part"), [("sise=4", "sise"), ("size=1", "size"), ("size", "size"), ("min_scale=0.9", None)]
)
def test_shard_refuses_wrong_settings(crossray, cut, tmp_path, setting, part):
    words = ["--set", "max_scale=0.5"] if part is None else []
    result = crossray("shard", cut / "scene", "--out", tmp_path / "s", "--set", setting, *words)
    refused(result, part or "max_scale")
    assert not (tmp_path / "s").exists()


# Jobs


def test_run_trains_says_where_and_goes_on(crossray, job_file, tmp_path):
    path = job_file()
    status, out, _ = crossray("run", path)
    assert status == 0
    run = tmp_path / "runs" / "tiny"
    assert f"{run}: trained, 2 steps" in out
    assert f"tensorboard --logdir {tmp_path / 'runs'}" in out
    assert (run / "checkpoints" / "step-00000002" / "meta.json").is_file()
    status, out, _ = crossray("run", path)
    assert status == 0
    assert "trained, 2 steps" in out
    refused(crossray("run", path, "--set", "train.epochs=3"), "train.epochs: 1 -> 3", "--set name=")


def test_run_evaluates_and_prints_the_scores(crossray, job_file, monkeypatch):
    from pipeline import judge

    monkeypatch.setattr(judge, "find_lpips", lambda: None)
    path = job_file("crossray")
    status, out, _ = crossray("run", path, "--set", "evaluate.protocols=[crnerf-full@R2]")
    assert status == 0
    assert re.search(r"crnerf-full@R2 \(step 2, 1 photos\): PSNR \d+\.\d+  SSIM 0\.\d+", out)


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["--set", "train.epoch=3"], "train.epoch: there is no such key; did you mean 'epochs'?"),
        (["--set", "ranks=none"], "ranks: "),
        (["--set", "ranks"], "--set ranks: write key=value"),
        (["--set", "method=crosray"], "did you mean 'crossray'?"),
        (["--launcher", "slurm"], "launcher: "),
        (["--set", "scene=null"], "scene: "),
    ],
)
def test_run_refuses_a_bad_job_and_names_the_key(crossray, job_file, tmp_path, words, part):
    refused(crossray("run", job_file(), *words), part)
    assert not (tmp_path / "runs").exists()


def test_run_refuses_a_bad_file(crossray, job_file, tmp_path):
    path = job_file(trian={"epochs": 3})
    refused(crossray("run", path), f"{path}: trian: there is no such key; did you mean 'train'?")
    refused(crossray("run", tmp_path / "absent.yaml"), "absent.yaml: cannot be read")
    refused(crossray("run", tmp_path), "cannot be read")
    path.write_text("- a\n")
    refused(crossray("run", path), "mapping")


@pytest.mark.slow  # Ray is started before the scene is looked at
def test_run_on_a_missing_scene(crossray, job_file, tmp_path):
    scene = {"path": str(tmp_path / "nowhere"), "downscale": 2, "shards": str(tmp_path / "none")}
    err = refused(crossray("run", job_file(scene=scene)), "nowhere")
    assert len(err.strip().splitlines()) <= 3


@pytest.mark.parametrize("text", ["[/x]", "[red]", "[bold]loud", "a[1]"])
def test_brackets_of_a_message_are_shown_as_they_are(crossray, job_file, text):
    """Rich reads brackets as markup: a closing tag without its opening one would even be an exception."""
    refused(crossray("run", job_file(), "--set", f"method='{text}'"), f"method: '{text}' is not known")
    refused(crossray("run", job_file(), "--set", text), f"--set {text}: write key=value")


# Evaluation


def test_evaluate_of_a_folder_that_is_no_run(crossray, tmp_path):
    refused(crossray("evaluate", tmp_path, "--protocol", "crnerf-full@R2"), tmp_path, "not a run", "job.yaml")


def test_evaluate_refuses_a_bare_protocol(crossray, tmp_path):
    refused(crossray("evaluate", tmp_path, "--protocol", "crnerf-full"), "crnerf-full@R4")
    refused(crossray("evaluate", tmp_path), "--protocol")


def test_evaluate_of_a_run_that_was_never_trained(crossray, cut, tmp_path):
    from pipeline.launch.run import claim_run

    job = tiny_job(cut, "nerf", {"runs": str(tmp_path / "runs")})
    claim_run(job)
    refused(crossray("evaluate", job.run, "--protocol", "crnerf-full@R2"), "no committed checkpoint")


# As a process


@pytest.mark.slow
def test_a_job_file_is_a_program(job_file, tmp_path):
    """Through its shebang, with the project's python on the path."""
    path = job_file()
    path.write_text("#!/usr/bin/env -S python -m pipeline run\n" + path.read_text())
    path.chmod(0o755)
    search = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = os.environ | {"PATH": search}
    found = subprocess.run([path], cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stderr
    assert "trained, 2 steps" in found.stdout
    assert (tmp_path / "runs" / "tiny" / "job.yaml").is_file()


@pytest.mark.slow
def test_a_bad_job_is_one_message_and_status_2(job_file):
    words = [sys.executable, "-m", "pipeline", "run", str(job_file()), "--set", "train.epoch=3"]
    found = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    assert found.returncode == 2
    assert found.stdout == ""
    assert found.stderr.startswith("crossray: ")
    assert "train.epoch: there is no such key; did you mean 'epochs'?" in found.stderr
