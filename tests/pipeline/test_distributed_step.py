"""Steps under DDP, which fails at the second one where a parameter that requires a gradient gets none."""

from __future__ import annotations

import pytest
import torch
import torch.distributed as dist
from tiny_run import cut_tiny, tiny_job, tiny_photos

from model.methods import METHODS
from pipeline.averaging import distribute, room
from pipeline.batches import TrainingPhotos
from pipeline.together import Together
from pipeline.train import build_model, forward
from pipeline.work import Context, Work

pytestmark = pytest.mark.slow

CONTEXT = Context(rank=0, world_size=2)  # so that the model is wrapped


@pytest.fixture(scope="module")
def cut(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CROSSRAY_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield cut_tiny(tmp_path_factory.mktemp("tiny"))


@pytest.fixture(scope="module")
def group(tmp_path_factory):
    """A process group of this process alone: gradients are averaged over one rank."""
    store = tmp_path_factory.mktemp("store") / "store"
    dist.init_process_group("gloo", init_method=f"file://{store}", rank=0, world_size=1)
    yield
    dist.destroy_process_group()


@pytest.mark.parametrize(
    "losses", [{}, {"appearance": 0.0, "content": 0.0}, {"embedding": 0.0}], ids=["recipe", "no-L_a", "no-size"]
)
@pytest.mark.parametrize("method", METHODS)
def test_every_method_takes_several_steps(cut, group, method, losses):
    """With the losses of its recipe, and without the appearance losses (as the fast field's recipe has it)."""
    job = tiny_job(cut, method, {"losses": losses})
    photos = tiny_photos(cut)
    masks = job.model.transient == "fixed"
    data = TrainingPhotos(photos, CONTEXT.device, job.model.pixel_center, masks)
    model = build_model(job, photos, CONTEXT.device)
    ddp = distribute(model, CONTEXT, Together(CONTEXT, room(model, CONTEXT)))
    work = Work(job, CONTEXT, data, steps_per_epoch=6)
    for step in range(3):
        terms, _ = forward(work, ddp, step)
        total = torch.stack(list(terms.values())).sum()
        total.backward()
        assert total.isfinite()
        ddp.zero_grad(set_to_none=True)
