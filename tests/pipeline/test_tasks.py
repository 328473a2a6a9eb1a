"""Mappers: in this process, and as real Ray tasks whose processes die."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest
from tiny_scene import write_tiny_scene

from pipeline.launch.tasks import in_process, ray_tasks
from pipeline.patches import PatchPlan
from pipeline.shards import ShardError, cut_shards, write_shard


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


@pytest.mark.slow
def test_ray_tasks_survive_a_killed_process_and_give_the_same_bytes(tmp_path, monkeypatch):
    import ray

    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))  # workers import this module by name
    root = write_tiny_scene(tmp_path / "tiny", photos=10)
    plan = PatchPlan(size=4)
    expected = cut_shards(root, tmp_path / "here", downscale=2, plan=plan, mapper=in_process)
    token_before = (Path.home() / ".ray").exists()
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
    assert (Path.home() / ".ray").exists() == token_before
