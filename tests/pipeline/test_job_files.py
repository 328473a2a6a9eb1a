"""The job files as programs on a cluster: what their headers promise, and that a checkout fits through the Jobs API.

That they are executable, and that their keys are right, is in test_config.py and test_study.py.
"""

from __future__ import annotations

import logging
import shutil
import stat
import subprocess
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
JOBS = sorted((ROOT / "jobs").glob("*.yaml"))
SMALL = 2 * 2**20  # bytes: the code takes half a megabyte


@pytest.mark.parametrize("path", JOBS, ids=lambda p: p.name)
class TestJobFile:
    def test_its_header_says_how_it_is_submitted(self, path):
        header = path.read_text().partition("\nkind:")[0]
        for command in ("crossray submit", "ray job submit", "ray job submit --working-dir . --"):
            assert f"#   {command} jobs/{path.name}" in header
        assert all(line.startswith("#") for line in header.splitlines() if line)

    def test_everybody_may_run_it(self, path):
        mode = path.stat().st_mode
        assert mode & stat.S_IXUSR
        assert mode & stat.S_IXGRP
        assert mode & stat.S_IXOTH  # in a container nobody owns it


@pytest.fixture(scope="module")
def checkout(tmp_path_factory) -> Path:
    """What git keeps of this project, and beside it what its use leaves: 1,200 MB."""
    folder = tmp_path_factory.mktemp("checkout")
    try:
        listed = subprocess.run(
            ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"],
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=True,
        ).stdout
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("not a git checkout")
    for name in filter(None, listed.split("\0")):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, folder / name)
    for name in (
        "runs/a/checkpoints/step-00000010/model.safetensors",
        "data/scene/dense/images/photo.jpg",
        "shards/scene-R2/shard-000000.tar",
        "quickstart/overview.png",
        ".venv/lib/libtorch.so",
        "pipeline/__pycache__/train.pyc",
        "released.ckpt",
        "film.mp4",
    ):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        with (folder / name).open("wb") as file:
            file.truncate(150 * 2**20)
    return folder


@pytest.mark.parametrize("gitignore", [True, False], ids=["with .gitignore", "without"])
def test_ray_sends_the_code_and_little_else(checkout, tmp_path, gitignore):
    """What `--working-dir .` makes of a checkout, by Ray's own packaging; its limit is 100 MiB."""
    from ray._private.runtime_env.packaging import create_package

    package = tmp_path / "package.zip"
    quiet = logging.getLogger("quiet")
    create_package(str(checkout), package, include_gitignore=gitignore, excludes=[".git", ".venv"], logger=quiet)
    assert package.stat().st_size < SMALL
    with zipfile.ZipFile(package) as archive:
        found = {entry.filename: entry.external_attr >> 16 for entry in archive.infolist() if not entry.is_dir()}
    assert {name.split("/")[0] for name in found if "/" in name} == {"jobs", "model", "pipeline"}
    for path in [*(ROOT / "model").rglob("*"), *(ROOT / "pipeline").rglob("*"), *JOBS]:
        if path.is_file() and "__pycache__" not in path.parts:
            assert str(path.relative_to(ROOT)) in found
    assert all(found[f"jobs/{path.name}"] & stat.S_IXUSR for path in JOBS)
