"""What no machine can hold is refused before anything is started, and what fits is not."""

from __future__ import annotations

import pytest
import torch
from tiny_run import tiny_mapping

from pipeline import least_memory
from pipeline.config import make_job
from pipeline.errors import CrossrayError
from pipeline.launch.run import run_job
from pipeline.least_memory import check_memory, memory_of, step_bytes, table_bytes

CPU = torch.device("cpu")


def job_of(tmp_path, *settings: str, method: str = "crossray"):
    return make_job(tiny_mapping(tmp_path, method), settings)


def test_bytes_by_hand(tmp_path):
    """2 patches of 8 x 8 rays; 4 levels of 2^8 entries of 2 features; 8 + 4 samples, 16 wide, 32 channels."""
    job = job_of(tmp_path)
    assert step_bytes(job) == 4 * 128 * (8 + 4 * (2 * 4 + 16 + job.model.channels))
    assert table_bytes(job) == 4 * 4 * (4 * 256 * 2)
    faithful = job_of(tmp_path, method="crnerf-b")
    assert step_bytes(faithful) == 2 * (2 * 64) * (6 + 6 + 6) * 9 * 16
    assert table_bytes(faithful) == 0


def test_the_estimate_is_a_lower_bound(tmp_path):
    """The saved tensors of a real forward pass of the field are at least as many bytes."""
    from model.fields.base import Rays
    from model.scene_model import SceneModel

    job = job_of(tmp_path)
    model = SceneModel(job.model, torch.tensor([[-1.0] * 3, [1.0] * 3]))
    count = job.patch.photos * job.patch.size**2
    directions = torch.nn.functional.normalize(torch.ones(count, 3), dim=-1)
    rays = Rays(torch.zeros(count, 3), directions, torch.full((count,), 0.1), torch.ones(count))
    held: dict[int, int] = {}

    def keep(x):
        held[x.untyped_storage().data_ptr()] = x.untyped_storage().nbytes()
        return x

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda x: x):
        model.field.march(rays, torch.Generator().manual_seed(0))
    assert sum(held.values()) >= step_bytes(job)


@pytest.mark.parametrize(
    "setting",
    ["model.hash.samples=100000000", "patch.photos=4096", "model.hash.levels=32"],
)
def test_a_job_that_fits_nowhere_says_what_to_make_smaller(tmp_path, monkeypatch, setting):
    monkeypatch.setattr(least_memory, "memory_of", lambda device: 2**21)
    job = job_of(tmp_path, setting, "model.hash.log2_entries=12")
    with pytest.raises(CrossrayError, match=r"holds at least .* GiB.*make patch\.size, patch\.photos or the sizes"):
        check_memory(job, CPU)


def test_it_is_said_before_shards_are_cut(tmp_path):
    job = job_of(tmp_path, "model.hash.samples=1000000000000")
    with pytest.raises(CrossrayError, match=r"sizes in model\.hash"):
        run_job(job)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("method", ["crossray", "crnerf", "nerfw"])
def test_the_papers_sizes_fit_into_a_small_machine(tmp_path, monkeypatch, method):
    monkeypatch.setattr(least_memory, "memory_of", lambda device: 8 * 2**30)
    check_memory(make_job({"method": method, "name": "x", "scene": {"path": str(tmp_path)}}), CPU)


def test_a_processors_memory_is_the_machines():
    assert memory_of(CPU) > 2**28
