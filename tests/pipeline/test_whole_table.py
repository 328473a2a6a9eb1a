"""The whole table of methods, so that a new row is tested by being a row: each trains, is stopped and resumed to the
bit, is evaluated and rendered, on one rank in this process and on two ranks in one launch for all rows together.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from datetime import timedelta
from functools import cache
from itertools import count
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
import torch.distributed as dist
from PIL import Image
from tiny_run import assert_same_bits, cut_tiny, final_state, tiny_job, tiny_photos, train_until

from model.methods import METHODS
from model.scene_model import SceneModel, part_of
from pipeline import evaluate as evaluate_module
from pipeline import judge as judge_module
from pipeline import train as train_module
from pipeline import work as work_module
from pipeline.checkpoint import committed
from pipeline.config import Job
from pipeline.evaluate import evaluate_run
from pipeline.fit import FitRecipe
from pipeline.launch.run import claim_run
from pipeline.protocol import parse_protocol
from pipeline.render import predicted_mask, render_picture, training_appearance
from pipeline.resume import checkpoints
from pipeline.runs import load_run
from pipeline.train import train
from pipeline.work import Context

pytestmark = pytest.mark.slow

STEPS, STOP = 3, 1
TABLE = [(method, field) for method, row in METHODS.items() for field in dict.fromkeys((row.field, "hash"))]
EVERY_ROW = pytest.mark.parametrize(("method", "field"), TABLE)


def job_of(folder: Path, method: str, field: str, name: str, ranks: int = 1) -> Job:
    """A job of a few steps of a row, as the table has it or on the fast field."""
    over = {
        "name": f"{method}-{field}-{name}",
        "ranks": ranks,
        "model": {"field": field},
        "patch": {"photos": 1},
        "train": {"epochs": STEPS, "steps_per_epoch": 1},
    }
    return tiny_job(folder, method, over)


@pytest.fixture(scope="module")
def cut(tmp_path_factory):
    return cut_tiny(tmp_path_factory.mktemp("table"), size=(48, 36))


@pytest.fixture(scope="module", autouse=True)
def _environment(cut):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CROSSRAY_CACHE", str(cut / "cache"))
        patch.setattr(judge_module, "find_lpips", lambda: None)
        patch.setattr(evaluate_module, "parse_protocol", quick_protocol)
        yield


def quick_protocol(name: str):
    """A protocol with few samples, and codes that are fitted in a few steps."""
    protocol, downscale = parse_protocol(name)
    quick = dict.fromkeys(protocol.fit, FitRecipe(steps=5, rays=64))
    return protocol.model_copy(update={"mlp_samples": (8, 8), "fit": quick, "fit_read": quick}), downscale


# One rank


@pytest.fixture(scope="module")
def straight(cut):
    """straight(method, field): the run of a row that nobody disturbed, trained once."""

    @cache
    def of(method: str, field: str) -> Job:
        job = job_of(cut, method, field, "straight")
        claim_run(job)
        assert train(job, Context())["finished"]
        return job

    return of


@EVERY_ROW
def test_a_row_is_stopped_and_resumed_to_the_bit(cut, straight, method, field):
    job = job_of(cut, method, field, "stopped")
    assert train_until(job, STOP)["finished"] is False
    assert [p.name for p in committed(checkpoints(job))] == [f"step-{STOP:08d}"]
    assert train(job, Context())["steps"] == STEPS
    expected = straight(method, field)
    for ours, theirs, what in zip(final_state(job), final_state(expected), ("model", "optimiser"), strict=True):
        assert_same_bits(dict(ours), dict(theirs), what)


@EVERY_ROW
def test_every_part_of_a_row_learns(straight, method, field):
    """Field, appearance, codes, masks: whatever a row has."""
    job = straight(method, field)
    start = train_module.build_model(job, tiny_photos(job.runs.parent), torch.device("cpu"))
    after, _ = final_state(job)
    before = {name: p for name, p in start.named_parameters() if p.requires_grad}
    moved = {part_of(name) for name, p in before.items() if not torch.equal(after[name], p)}
    assert moved == {part_of(name) for name in before}


@EVERY_ROW
def test_a_row_is_evaluated(straight, method, field):
    job = straight(method, field)
    result = evaluate_run(job.run, "crnerf-full@R2")
    assert result["method"] == method
    assert result["step"] == STEPS
    assert 3 < result["mean"]["psnr"] < 60
    (row,) = result["images"]
    picture = Image.open(job.run / "eval" / "crnerf-full@R2" / f"step-{STEPS:08d}" / f"{row['key']}.png")
    assert picture.size == (24, 18)


@pytest.mark.parametrize(
    ("method", "field"), [row for row in TABLE if METHODS[row[0]].appearance in ("code", "crossray")]
)
def test_what_a_row_reads_can_be_fitted_further(straight, method, field):
    result = evaluate_run(straight(method, field).run, "nerfw-half@R2+fit")
    assert (result["definition"]["suffix"], result["appearance_from"]) == ("fit", "left")
    assert 3 < result["mean"]["psnr"] < 60


@EVERY_ROW
def test_a_row_renders_a_training_photo_and_its_mask_where_it_has_one(straight, method, field):
    job = straight(method, field)
    _, model, _ = load_run(job.run)
    photos = tiny_photos(job.runs.parent)
    index = photos.indices("train")[1]
    _, picture = render_picture(model, photos.records[index], training_appearance(model, photos, index))
    assert picture.shape == photos.image(index).shape
    assert np.isfinite(picture).all()
    assert picture.min() >= 0
    assert picture.max() <= 1
    mask = predicted_mask(model, photos, index)
    assert (mask is None) == (job.model.transient == "none")
    if mask is not None:
        assert mask.shape == picture.shape[:2]
        assert mask.dtype == np.float32
        assert mask.min() >= 0
        assert mask.max() <= 1


# Two ranks: one launch walks the table, each row straight, stopped, and resumed


def walk(folder: str) -> dict[str, str]:
    """Entry point of a rank. Returns, of rank 0, what is wrong with each row: "" where all is well."""
    torch.set_num_threads(1)
    made = {"build_model": keep(train_module, "build_model"), "patches": keep(work_module, "patches")}
    dist.init_process_group("gloo", timeout=timedelta(seconds=60))  # ranks that wait for each other end it
    rank, wrong = dist.get_rank(), {}
    try:
        for method, field in TABLE:
            try:
                straight, stopped = (job_of(Path(folder), method, field, name, 2) for name in ("two", "two-stopped"))
                assert train(straight, Context(rank, 2))["finished"]
                ranks: list = [None, None]
                dist.all_gather_object(ranks, (made["patches"][-1], digest(made["build_model"][-1])))
                asked = asked_in(STOP) if rank == 1 else (lambda: False)  # one rank is asked, both stop
                assert not train(stopped, Context(rank, 2, should_stop=asked))["finished"]
                dist.barrier()  # a checkpoint is rank 0's to write, and everybody's to read
                assert train(stopped, Context(rank, 2))["steps"] == STEPS
                dist.barrier()
                wrong[f"{method}-{field}"] = differences(straight, stopped, *ranks) if rank == 0 else ""
            except Exception as error:
                error.add_note(f"{method} with model.field: {field}")
                raise
    finally:
        dist.destroy_process_group()
    return wrong


def asked_in(step: int) -> Callable[[], bool]:
    """A launcher that asks to stop in the step number `step`."""
    calls = count(1)
    return lambda: next(calls) >= step


def keep(module: ModuleType, name: str) -> list:
    """Everything that a function of a module returns from now on."""
    kept: list = []
    original = getattr(module, name)

    def spy(*args, **kwargs):
        kept.append(original(*args, **kwargs))
        return kept[-1]

    setattr(module, name, spy)
    return kept


def digest(model: SceneModel) -> str:
    """Of all parameters. Buffers may differ between ranks after a step: they follow rank 0 in the next one."""
    return hashlib.sha256(b"".join(p.detach().numpy().tobytes() for p in model.parameters())).hexdigest()


def differences(straight: Job, stopped: Job, first: tuple, second: tuple) -> str:
    """What is wrong with two finished runs of two ranks, of which `first` and `second` are the last patches and the
    weights of the undisturbed one; "" if nothing."""
    try:
        assert first[0] != second[0], "both ranks saw the same patches"
        assert first[1] == second[1], "the ranks ended with different weights"
        assert len(committed(checkpoints(stopped))) == 2, "it was not stopped on the way"
        for a, b, what in zip(final_state(stopped), final_state(straight), ("model", "optimiser"), strict=True):
            assert_same_bits(dict(a), dict(b), what)
    except AssertionError as error:
        return str(error) or "differs"
    return ""


@pytest.fixture(scope="module")
def two_ranks(cut):
    """What is wrong with each row at two ranks."""
    from torch.distributed.launcher.api import LaunchConfig, elastic_launch

    config = LaunchConfig(
        min_nodes=1,
        max_nodes=1,
        nproc_per_node=2,
        run_id="table",
        rdzv_backend="c10d",
        rdzv_endpoint="127.0.0.1:0",
        local_addr="127.0.0.1",
        max_restarts=0,
        monitor_interval=0.1,
        start_method="spawn",
    )
    with pytest.MonkeyPatch.context() as patch:
        for name, value in {"GLOO_SOCKET_IFNAME": "lo", "OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE"}.items():
            patch.setenv(name, value)
        patch.delenv("RANK", raising=False)
        return elastic_launch(config, walk)(str(cut))[0]


@EVERY_ROW
def test_at_two_ranks_a_row_is_stopped_and_resumed_to_the_bit(two_ranks, cut, method, field):
    assert two_ranks[f"{method}-{field}"] == ""
    job = job_of(cut, method, field, "two", 2)
    meta = json.loads((committed(checkpoints(job))[-1] / "meta.json").read_text())
    assert (meta["world_size"], meta["finished"]) == (2, True)
