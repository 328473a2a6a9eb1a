"""Whatever a file holds, reading it gives its content or one of our own errors: damaged bytes, and forged values under
hashes that agree.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import torch
from forgery import read_all, repack, vouch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tiny_scene import write_tiny_scene

from pipeline.checkpoint import digest, latest_checkpoint, read_checkpoint, save_checkpoint
from pipeline.config import load_job
from pipeline.cutting import cut_shards
from pipeline.errors import CrossrayError
from pipeline.files import sha256_of
from pipeline.launch.tasks import in_process
from pipeline.manifest import MANIFEST
from pipeline.patches import PatchPlan
from pipeline.protocol import parse_protocol
from pipeline.scene import read_scene

# Each example works in a folder of the test's own and writes what it damages anew.
fuzzed = settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])

ODD = st.sampled_from(
    [None, True, -1, 0, 2**63, 2**70, 1e308, 0.5, "", "..", "../x", "/etc/passwd", "\0", "a\nb", "ü", [], {}, [[]]]
)
VALUES = ODD | st.integers() | st.floats() | st.text(max_size=8)


@st.composite
def damaged(draw: st.DrawFn, data: bytes) -> bytes:
    """`data` with bytes changed, cut off, doubled or put in."""
    content = bytearray(data)
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, max(0, len(content) - 1)))
        match draw(st.sampled_from(["change", "cut", "insert", "double"])):
            case "change" if content:
                content[at] = draw(st.integers(0, 255))
            case "cut":
                del content[at : at + draw(st.integers(1, 1000))]
            case "insert":
                content[at:at] = draw(st.binary(max_size=20))
            case _:
                content[at:at] = content[at : at + draw(st.integers(1, 600))]
    return bytes(content)


def places(value: Any, path: tuple = ()) -> list[tuple]:
    """Every place in JSON content."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path, *(place for key, child in inner for place in places(child, (*path, key)))]


@st.composite
def forged(draw: st.DrawFn, content: Any) -> Any:
    """JSON content with up to three values replaced, removed or put in."""
    content = json.loads(json.dumps(content))
    for _ in range(draw(st.integers(1, 3))):
        *path, key = draw(st.sampled_from([place for place in places(content) if place] or [("",)]))
        parent = content
        for step in path:
            parent = parent[step]
        match draw(st.sampled_from(["replace", "remove", "insert"])):
            case "replace":
                parent[key] = draw(VALUES)
            case "remove":
                del parent[key]
            case _ if isinstance(parent, dict):
                parent[draw(st.text(max_size=6))] = draw(VALUES)
            case _:
                parent.insert(key, draw(VALUES))
    return content


def only_ours(read: Callable[[], object]) -> None:
    """Call it: a value, or one of our errors."""
    with suppress(CrossrayError):
        read()


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    return write_tiny_scene(tmp_path_factory.mktemp("fuzz") / "scene", photos=4, size=(16, 12))


@pytest.fixture(scope="module")
def cut(scene, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("fuzz") / "shards"
    cut_shards(scene, out, downscale=1, reference_downscale=1, plan=PatchPlan(size=4), mapper=in_process)
    return out


@pytest.fixture
def shards(cut, tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("CROSSRAY_CACHE", str(tmp_path / "cache"))
    return Path(shutil.copytree(cut, tmp_path / "shards"))


class TestScenes:
    @pytest.mark.parametrize("name", ["cameras.txt", "images.txt", "points3D.txt"])
    @fuzzed
    @given(data=st.data())
    def test_a_model_in_text(self, scene, tmp_path, name, data):
        root = self.copy(scene, tmp_path)
        whole = (scene / "dense" / "sparse" / name).read_bytes()
        (root / "dense" / "sparse" / name).write_bytes(data.draw(damaged(whole)))
        only_ours(lambda: read_scene(root))

    @fuzzed
    @given(data=st.data())
    def test_a_split_table(self, scene, tmp_path, data):
        root = self.copy(scene, tmp_path)
        (root / "tiny.tsv").write_bytes(data.draw(damaged((scene / "tiny.tsv").read_bytes())))
        only_ours(lambda: read_scene(root))

    @fuzzed
    @given(data=st.data())
    @pytest.mark.slow
    def test_a_photo(self, scene, tmp_path, data):
        root = self.copy(scene, tmp_path)
        photo = Path("dense/images/photo_001.jpg")
        (root / photo).write_bytes(data.draw(damaged((scene / photo).read_bytes())))
        for bad in ("refuse", "drop"):
            shutil.rmtree(tmp_path / "out", ignore_errors=True)
            only_ours(
                lambda bad=bad: cut_shards(
                    root, tmp_path / "out", downscale=1, plan=PatchPlan(size=4), mapper=in_process, on_bad_photo=bad
                )
            )
            assert not list((tmp_path / "out").glob(".*.tmp"))

    def copy(self, scene: Path, tmp_path: Path) -> Path:
        return Path(shutil.copytree(scene, tmp_path / "scene", dirs_exist_ok=True))


class TestShards:
    @fuzzed
    @given(data=st.data())
    def test_a_manifest(self, cut, shards, data):
        content = data.draw(forged(json.loads((cut / MANIFEST).read_text())))
        (shards / MANIFEST).write_text(json.dumps(content))
        only_ours(lambda: read_all(shards))

    @fuzzed
    @given(data=st.data())
    def test_a_tar_that_the_manifest_vouches_for(self, cut, shards, data):
        path = shards / "shard-000000.tar"
        path.write_bytes(data.draw(damaged((cut / path.name).read_bytes())))
        shutil.copy(cut / MANIFEST, shards / MANIFEST)
        vouch(shards, path)
        only_ours(lambda: read_all(shards))

    @fuzzed
    @given(data=st.data())
    def test_a_camera_that_the_manifest_vouches_for(self, cut, shards, data):
        def forge(camera: bytes) -> bytes:
            return json.dumps(data.draw(forged(json.loads(camera)))).encode()

        shutil.copytree(cut, shards, dirs_exist_ok=True)
        repack(shards, lambda m, d: (m, forge(d) if m.name.endswith("camera.json") else d))
        only_ours(lambda: read_all(shards))


class TestCheckpoints:
    @pytest.fixture
    def checkpoint(self, tmp_path) -> Path:
        meta = {"seconds": 0.0, "finished": False, "world_size": 1, "photos": 1, "shards": "0" * 64, "job": "0" * 64}
        model = {"w": torch.zeros(3)}
        return save_checkpoint(tmp_path / "checkpoints", 10, model, {"state": {}, "param_groups": []}, meta)

    @fuzzed
    @given(data=st.data())
    def test_a_meta_whose_digest_agrees(self, checkpoint, data):
        path = checkpoint / "meta.json"
        whole = path.read_text()
        meta = data.draw(forged(json.loads(whole)))
        if isinstance(meta, dict):
            meta["digest"] = digest(meta)
        path.write_text(json.dumps(meta))
        only_ours(lambda: read_checkpoint(checkpoint))
        only_ours(lambda: latest_checkpoint(checkpoint.parent))
        path.write_text(whole)

    @pytest.mark.parametrize("name", ["model.safetensors", "training.pt", "meta.json"])
    @fuzzed
    @given(data=st.data())
    def test_any_of_its_files(self, checkpoint, name, data):
        path = checkpoint / name
        whole = path.read_bytes()
        path.write_bytes(data.draw(damaged(whole)))
        if name != "meta.json":
            meta = json.loads((checkpoint / "meta.json").read_text())
            meta["sha256"][name] = sha256_of(path)
            meta["digest"] = digest(meta)
            (checkpoint / "meta.json").write_text(json.dumps(meta))
        only_ours(lambda: read_checkpoint(checkpoint).optimiser())
        path.write_bytes(whole)


class TestJobs:
    @pytest.mark.parametrize("name", ["train_scene.yaml", "train_scene_cpu.yaml"])
    @fuzzed
    @given(data=st.data())
    def test_a_job_file(self, tmp_path, name, data):
        whole = (Path(__file__).parents[2] / "jobs" / name).read_bytes()
        (tmp_path / name).write_bytes(data.draw(damaged(whole)))
        only_ours(lambda: load_job(tmp_path / name))

    @fuzzed
    @given(st.text(alphabet="crnerf-fullwab@Rx+it0123456789./\0ü ", max_size=20))
    def test_a_name_of_a_protocol(self, name):
        only_ours(lambda: parse_protocol(name))
