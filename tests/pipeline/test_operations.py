"""The operations page says what is: its messages are in the code, its commands, options and keys exist."""

from __future__ import annotations

import ast
import os
import re
import shlex
import subprocess
from functools import cache
from itertools import pairwise
from pathlib import Path

import pytest
import typer.main

from pipeline.cli import app
from pipeline.config import load_job
from pipeline.launch.ray_train import METRICS
from pipeline.reeval import load_reeval
from pipeline.study import load_study, read_kind

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "operations.md").read_text()
FOREIGN = "(Ray)"  # after a message that is not ours
LOADERS = {"train": load_job, "study": load_study, "reeval": load_reeval}


def messages() -> list[str]:
    """The first column of the tables of messages, ours alone."""
    chapter = PAGE.partition("## What to do when it says")[2]
    rows = [line for line in chapter.splitlines() if line.startswith("| `")]
    assert len(rows) > 30
    return [row.split("`")[1] for row in rows if FOREIGN not in row.split("|")[1]]


@cache
def texts() -> tuple[str, ...]:
    """Every text in the code, what is put into it replaced by a mark; a text that goes on in another one is joined."""
    found = []
    for path in sorted((ROOT / "pipeline").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.JoinedStr | ast.Constant | ast.BinOp):
                found.append(text_of(node))
    return tuple(text for text in found if text)


def text_of(node: ast.expr) -> str:
    match node:
        case ast.Constant(value=str(value)):
            return re.sub(r"%[sd]|%\.\d+f", "\0", value)
        case ast.JoinedStr(values=values):
            return "".join(text_of(value) for value in values)
        case ast.FormattedValue():
            return "\0"
        case ast.BinOp(left=left, right=right):
            return text_of(left) + text_of(right)
    return ""


@pytest.mark.parametrize("message", messages())
def test_a_message_is_one_that_the_code_has(message):
    pieces = [re.escape(piece.strip(" ")) for piece in message.split("...")]
    pattern = re.compile(r".*".join(pieces), re.DOTALL)
    assert any(pattern.search(text) for text in texts())


def test_a_message_that_nobody_says_would_be_found():
    assert not any(re.search("ranks: the job dreams of", text) for text in texts())


def commands() -> list[str]:
    """Every line of the page's shell blocks, continuations joined, comments removed."""
    blocks = re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL)
    lines = re.sub(r"\\\n\s*", "", "\n".join(blocks)).splitlines()
    return [" ".join(shlex.split(line, comments=True, posix=False)) for line in lines if line.strip()]


def test_the_shell_understands_every_command():
    assert len(commands()) > 25
    for line in commands():
        subprocess.run(["bash", "-n", "-c", line], check=True)


def test_options_of_crossray_exist():
    ours = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    said = [line for line in commands() if line.startswith("crossray ")]
    said += re.findall(r"`(crossray [^`]*)`", PAGE)
    assert len(said) >= 6
    for line in said:
        _, name, *words = shlex.split(line)
        options = {name for option in ours[name].params for name in option.opts}
        assert {word.partition("=")[0] for word in words if word.startswith("--")} <= options


def test_job_files_take_what_is_set():
    seen = 0
    for line in commands():
        words = shlex.split(line)
        files = [word for word in words if re.fullmatch(r"jobs/\w+\.yaml", word)]
        for file in files:
            assert os.access(ROOT / file, os.X_OK)
            settings = [value for option, value in pairwise(words) if option == "--set"]
            LOADERS[read_kind(ROOT / file)](ROOT / file, settings)
            seen += 1
    assert seen >= 10


def test_options_of_ray_and_torchrun_exist():
    from ray.dashboard.modules.job.cli import job_cli_group
    from ray.scripts.scripts import cli
    from torch.distributed.run import get_args_parser

    torchrun = {name for action in get_args_parser()._actions for name in action.option_strings}
    for line in commands():
        words = shlex.split(line.partition(" && ")[0].partition(" > ")[0])
        if words[0] == "torchrun":
            given = words[1 : words.index("-m")]
            assert {word.partition("=")[0] for word in given} <= torchrun
        elif words[:2] == ["ray", "job"]:
            check_options(job_cli_group.commands[words[2]], words[3:])
        elif words[0] == "ray":
            check_options(cli.commands[words[1]], words[2:])


def check_options(command, words: list[str]) -> None:
    known = {name for option in command.params for name in option.opts}
    given = words[: words.index("--")] if "--" in words else words
    assert {word.partition("=")[0] for word in given if word.startswith("--")} <= known


def test_files_that_are_named_exist():
    for name in set(re.findall(r"\b(?:docker|jobs|docs)/[\w/.-]+\.(?:yaml|md)", PAGE)):
        assert (ROOT / name).is_file(), name


def test_every_variable_that_the_code_reads_is_on_the_page():
    code = "".join(path.read_text() for path in (ROOT / "pipeline").rglob("*.py"))
    assert set(re.findall(r"\bCROSSRAY_[A-Z_]+", code)) == set(re.findall(r"\bCROSSRAY_[A-Z_]+", PAGE))


def test_every_metric_is_on_the_page_as_it_is_called():
    rows = re.findall(r"^\| `(ray_\w+)` \| (\S+) \| (.+) \|$", PAGE, re.MULTILINE)
    assert rows == [(f"ray_{name}", metric.unit, metric.meaning) for name, metric in METRICS.items()]


def test_keys_of_a_job_that_the_page_names_exist():
    from pipeline.config import Job, flatten, make_job

    keys = set(flatten(make_job({"name": "x", "scene": {"path": "."}}).model_dump()))
    sections = {key.rpartition(".")[0] for key in keys}
    named = set(re.findall(r"`((?:ray|train|evaluate|scene|patch)\.\w+)(?:=[^`]*|: \w+)?`", PAGE))
    assert len(named) >= 8
    assert named <= keys | sections
    assert "train" in Job.model_fields
