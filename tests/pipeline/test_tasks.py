"""Mappers: in this process, and as real Ray tasks whose processes die."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from tiny_scene import write_tiny_scene

from pipeline.cutting import cut_shards, write_shard
from pipeline.errors import CrossrayError
from pipeline.launch.tasks import (
    PRIVATE_RAY,
    TaskError,
    _fitting,
    _map_tasks,
    in_process,
    one_cpu,
    ray_session,
    ray_tasks,
)
from pipeline.manifest import ShardError
from pipeline.patches import PatchPlan


def double(x):
    return 2 * x


def refuse(x):
    raise ShardError(f"photo {x}.jpg is damaged")


def die_once_then_write(spec):
    marker = spec.folder.parent / f"died-{spec.index}"
    if spec.index == 2 and not marker.exists():
        marker.touch()
        (spec.folder / ".shard-000002.tar.1.tmp").write_bytes(b"half")
        os.kill(os.getpid(), signal.SIGKILL)
    return write_shard(spec)


def contents(folder):
    return {p.name: p.read_bytes() for p in Path(folder).iterdir() if not p.name.startswith(".")}


def test_in_process_yields_each_result_as_it_is_made():
    seen = []
    results = in_process(lambda x: seen.append(x) or 2 * x, [1, 2, 3])
    assert next(results) == 2
    assert seen == [1]
    assert list(results) == [4, 6]
    with pytest.raises(ShardError, match=r"photo 7\.jpg"):
        list(in_process(refuse, [7]))


def where(x):
    return Path.cwd()


def test_a_share_of_a_gpu_is_a_need_like_any_other():
    nodes = [{"CPU": 4.0, "GPU": 1.0}, {"CPU": 8.0}]
    assert _fitting({"num_cpus": 1, "num_gpus": 0.25}, nodes) == {"num_cpus": 1, "num_gpus": 0.25}
    assert _fitting({"num_cpus": 16}, nodes) == {"num_cpus": 8}
    with pytest.raises(TaskError, match=r"needs 2 GPUs, and Ray's largest node has 1"):
        _fitting({"num_cpus": 0, "num_gpus": 2}, nodes)
    with pytest.raises(TaskError, match=r"needs 0\.25 GPUs, and Ray's largest node has 0"):
        _fitting({"num_cpus": 0, "num_gpus": 0.25}, nodes[1:])


def join(address: str, **environment: str) -> str:
    """What a process gets that connects to a Ray with these variables."""
    code = f"import ray; ray.init(address={address!r}, log_to_driver=False); print('joined')"
    clean = {k: v for k, v in os.environ.items() if k not in ("RAY_AUTH_TOKEN", "RAY_AUTH_MODE")}
    clean["RAY_NUM_REDIS_GET_RETRIES"] = "1"  # Ray asks twenty times, a second each
    done = subprocess.run(
        [sys.executable, "-c", code], env=clean | environment, capture_output=True, text=True, timeout=60, check=False
    )
    return done.stdout + done.stderr


def test_a_cluster_that_does_not_answer_is_named_at_once(monkeypatch):
    with socket.socket() as nobody:  # bound, so that nobody else gets the port, and not listening
        nobody.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{nobody.getsockname()[1]}"
        monkeypatch.setenv("RAY_ADDRESS", address)
        message = rf"RAY_ADDRESS: no Ray cluster at {address} .*refused.*RAY_AUTH_TOKEN"
        with pytest.raises(CrossrayError, match=message), ray_session():
            pass


def test_tasks_that_were_sent_before_their_specs_break_off_are_cancelled(monkeypatch):
    """A lock, or a signal, may end the making of specs half-way."""
    sent, cancelled = [], []

    class Task:
        def options(self, **words):
            return self

        def remote(self, folder, fn, spec):
            sent.append(spec)
            return spec

    ray = SimpleNamespace(
        remote=lambda **words: lambda fn: Task(),
        nodes=lambda: [{"Alive": True, "Resources": {"CPU": 1.0}}],
        cancel=cancelled.append,
        wait=lambda references, **words: (references, []),
    )
    monkeypatch.setitem(sys.modules, "ray", ray)

    def specs():
        yield from (1, 2)
        raise OSError("the disk is away")

    with pytest.raises(OSError, match="the disk is away"):
        list(_map_tasks(double, specs(), needs=one_cpu, died=None, stop=lambda: False))
    assert sent == cancelled == [1, 2]


@pytest.mark.slow
def test_a_private_ray_works_where_the_driver_is_and_for_nobody_without_its_token(tmp_path, monkeypatch):
    import ray

    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    for name in ("home", "here"):
        (tmp_path / name).mkdir()
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))  # workers import this module by name
    names = (*PRIVATE_RAY, "RAY_AUTH_MODE", "RAY_AUTH_TOKEN")
    before = {name: os.environ.get(name) for name in names}
    with ray_session(num_cpus=1):
        address, token = ray.get_runtime_context().gcs_address, os.environ["RAY_AUTH_TOKEN"]
        assert len(token) == 64
        assert "joined" in join(address, RAY_AUTH_MODE="token", RAY_AUTH_TOKEN=token)
        for stranger in ({"RAY_AUTH_MODE": "disabled"}, {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": "0" * 64}):
            answer = join(address, **stranger)
            assert "joined" not in answer
            assert "InvalidAuthToken" in answer
        monkeypatch.chdir(tmp_path / "here")
        with ray_tasks() as mapper:
            assert list(mapper(where, [1])) == [tmp_path / "here"]
            (tmp_path / "here").rename(tmp_path / "gone")
            monkeypatch.setattr(Path, "cwd", lambda: tmp_path / "here")  # a driver whose folder other nodes lack
            with pytest.raises(CrossrayError, match=r"^node \S+ has no folder \S+/here .*CROSSRAY_HOME"):
                list(mapper(double, [1]))
        session = Path(ray._private.worker._global_node.get_temp_dir_path())
        files = [p for folder in (session, tmp_path) for p in folder.rglob("*") if p.is_file()]
        assert len(files) > 10
        assert [path for path in files if token.encode() in path.read_bytes()] == []
    assert {name: os.environ.get(name) for name in names} == before
    assert list((tmp_path / "home").iterdir()) == []


@pytest.mark.slow
def test_ray_tasks_survive_a_killed_process_and_give_the_same_bytes(tmp_path, monkeypatch):
    import ray

    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))  # workers import this module by name
    root = write_tiny_scene(tmp_path / "tiny", photos=10)
    plan = PatchPlan(size=4)
    expected = cut_shards(root, tmp_path / "here", downscale=2, plan=plan, mapper=in_process)
    handler = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        with ray_tasks(num_cpus=2) as mapper:
            assert signal.getsignal(signal.SIGTERM) is signal.SIG_IGN
            folder = Path(ray._private.worker._global_node.get_temp_dir_path())
            assert folder.is_dir()
            assert sorted(mapper(double, [1, 2, 3])) == [2, 4, 6]
            with pytest.raises(ShardError, match=r"^photo 7\.jpg is damaged$") as error:
                list(mapper(refuse, [7]))
            assert type(error.value) is ShardError
            with ray_tasks() as inner:  # the Ray that is there is used, and left alone
                assert list(inner(double, [4])) == [8]
            assert ray.is_initialized()
            dying = cut_shards(
                root,
                tmp_path / "ray",
                downscale=2,
                plan=plan,
                mapper=lambda _, specs: mapper(die_once_then_write, specs),
            )
        assert not ray.is_initialized()
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGTERM, handler)
    assert (tmp_path / "died-2").exists()
    assert dying == expected
    assert contents(tmp_path / "ray") == contents(tmp_path / "here")
    assert not folder.exists()
