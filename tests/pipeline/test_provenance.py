"""Where a number came from."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
import torch

from pipeline.provenance import command, commit, provenance

ROOT = Path(__file__).resolve().parents[2]


def test_it_is_plain_json_and_complete() -> None:
    found = json.loads(json.dumps(provenance()))
    assert set(found) == {"command", "commit", "date", "hardware", "versions", "python"}
    assert abs(datetime.fromisoformat(found["date"]) - datetime.now(UTC)) < timedelta(minutes=1)
    assert found["hardware"]["cores"] >= 1
    assert found["hardware"]["memory_GiB"] > 0
    assert found["hardware"]["processor"]
    assert len(found["hardware"]["gpus"]) == torch.cuda.device_count()
    assert found["versions"]["torch"].startswith("2.")


def test_the_command_can_be_given_to_a_shell_again(monkeypatch) -> None:
    monkeypatch.setattr(sys, "argv", ["/usr/bin/crossray", "run", "my job.yaml", "--set", "name=a;b"])
    assert command() == "crossray run 'my job.yaml' --set 'name=a;b'"
    monkeypatch.setattr(sys, "argv", ["/somewhere/pipeline/__main__.py", "tables"])
    assert command() == "python -m pipeline tables"
    monkeypatch.setattr(sys, "argv", ["/somewhere/benchmarks/race.py", "--minutes", "1"])
    assert command() == "python benchmarks/race.py --minutes 1"


def test_a_command_tells_nothing_of_where_its_folder_is(monkeypatch, tmp_path) -> None:
    monkeypatch.chdir(tmp_path)
    words = [f"{tmp_path}/runs/a/job.yaml", "--set", f"runs={tmp_path}/b", "/elsewhere/c"]
    monkeypatch.setattr(sys, "argv", ["/usr/bin/crossray", "run", *words])
    assert command() == "crossray run runs/a/job.yaml --set runs=b /elsewhere/c"


def test_the_commit_is_that_of_the_checkout() -> None:
    head = subprocess.run(["git", "-C", ROOT, "rev-parse", "HEAD"], capture_output=True, text=True, check=False)
    if head.returncode != 0:
        assert commit() is None
        return
    assert re.fullmatch(r"[0-9a-f]{40}(-changed)?", commit() or "")
    assert (commit() or "").startswith(head.stdout.strip())


@pytest.mark.slow
def test_outside_a_checkout_there_is_no_commit(tmp_path) -> None:
    package = tmp_path / "pipeline"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "provenance.py").write_text((ROOT / "pipeline" / "provenance.py").read_text())
    code = "from pipeline.provenance import commit; print(commit())"
    found = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "None"
