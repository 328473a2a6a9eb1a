"""Where relative paths are meant from: on this machine, in a submitted job, and on the nodes of a cluster."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from tiny_run import tiny_mapping
from typer.testing import CliRunner

from pipeline.cli import app
from pipeline.errors import CrossrayError
from pipeline.launch.home import follow, go_home

RELATIVE = {"runs": Path("runs"), "scene.path": Path("data/gate")}


@pytest.fixture
def copy(tmp_path, monkeypatch):
    """As if Ray had unpacked the working_dir of a submitted job, and run the job there."""
    folder = tmp_path / "session" / "runtime_resources" / "working_dir_files" / "_ray_pkg_0123456789abcdef"
    folder.mkdir(parents=True)
    monkeypatch.delenv("CROSSRAY_HOME", raising=False)
    monkeypatch.chdir(folder)
    return folder


def test_without_crossray_home_it_is_the_working_directory(tmp_path, monkeypatch):
    monkeypatch.delenv("CROSSRAY_HOME", raising=False)
    monkeypatch.chdir(tmp_path)
    go_home(RELATIVE)
    assert Path.cwd() == tmp_path


def test_relative_paths_are_refused_in_a_copy_that_ray_removes(copy):
    with pytest.raises(CrossrayError, match=r"runs: runs would lie in .* removed .*CROSSRAY_HOME") as error:
        go_home(RELATIVE)
    assert "--set runs=/shared/runs --set scene.path=/shared/data/gate" in str(error.value)
    with pytest.raises(CrossrayError, match=r"^scene\.path: data/gate would"):
        go_home({"runs": Path("/shared/runs"), "scene.path": Path("data/gate")})
    go_home({"runs": Path("/shared/runs"), "scene.path": Path("/shared/gate")})
    assert Path.cwd() == copy


def test_crossray_home_is_where_a_submitted_job_goes(copy, tmp_path, monkeypatch):
    monkeypatch.setenv("CROSSRAY_HOME", str(tmp_path))
    go_home(RELATIVE)
    assert Path.cwd() == tmp_path


@pytest.mark.parametrize("home", ["shared", "/no/such/folder", "~"])
def test_a_home_that_is_no_folder_is_refused(copy, monkeypatch, home):
    (copy / "shared").mkdir()  # a relative home would mean another folder in each process
    monkeypatch.setenv("CROSSRAY_HOME", home)
    with pytest.raises(CrossrayError, match=rf"CROSSRAY_HOME: {home} is not the absolute path"):
        go_home(RELATIVE)
    assert Path.cwd() == copy


def test_a_node_without_the_drivers_folder_says_so(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(CrossrayError, match=r"^node \S+ has no folder .*/elsewhere .*mount it there.*CROSSRAY_HOME"):
        follow(tmp_path / "elsewhere")
    (tmp_path / "elsewhere").mkdir()
    follow(tmp_path / "elsewhere")
    assert Path.cwd() == tmp_path / "elsewhere"


def test_crossray_run_reads_its_job_file_and_then_goes_home(tmp_path, monkeypatch):
    here, home = tmp_path / "here", tmp_path / "home"
    here.mkdir()
    home.mkdir()
    mapping = tiny_mapping(Path())
    del mapping["scene"]["shards"]
    (here / "job.yaml").write_text(yaml.safe_dump(mapping))
    monkeypatch.chdir(here)
    monkeypatch.setenv("CROSSRAY_HOME", str(home))
    result = CliRunner().invoke(app, ["run", "job.yaml"])
    assert isinstance(result.exception, CrossrayError)
    assert "scene.path: scene is not a folder, and there are no shards in shards/" in str(result.exception)
    assert Path.cwd() == home
    assert (home / "shards").is_dir()
    assert [path.name for path in here.iterdir()] == ["job.yaml"]


def test_a_study_goes_home_as_well(copy, tmp_path, monkeypatch):
    (copy / "study.yaml").write_text(
        yaml.safe_dump(
            {
                "kind": "study",
                "name": "tiny",
                "runs": "/shared/runs",
                "variants": {"ours": {"method": "nerf"}},
                "scenes": {"gate": {"scene": {"path": "data/gate"}, "evaluate": {"protocols": ["crnerf-full@R2"]}}},
            }
        )
    )
    result = CliRunner().invoke(app, ["run", "study.yaml"])
    assert isinstance(result.exception, CrossrayError)
    assert str(result.exception).startswith("scenes.gate.scene.path: data/gate would lie in Ray's copy")
