"""One gradient for all ranks: DDP, and on processors an average that does not depend on who sums when.

DDP's own average over gloo goes around a ring, piece by piece: with more than two ranks the last bits of a sum depend
on where in which bucket a number lies, and on how the ranks are connected. Here every rank adds up what all have found,
in the order of the ranks, so that launcher, buckets and machines change nothing; of two ranks the sums are gloo's.
"""

# Not `from __future__ import annotations`: DDP compares the annotations of its hooks with classes.

import torch.distributed as dist
from torch import Tensor, nn
from torch.futures import Future
from torch.nn.parallel import DistributedDataParallel

from model.scene_model import SceneModel
from pipeline.together import Together
from pipeline.work import Context


def distribute(model: SceneModel, context: Context, together: Together) -> nn.Module:
    """The model, in DDP where there are several ranks.

    Buffers are each rank's own: no training step reads one that changes, and rank 0's go into checkpoints.
    """
    if context.world_size == 1:
        return model
    if context.device.type == "cuda":
        ddp = DistributedDataParallel(model, device_ids=[context.device.index])
    else:
        megabytes = room(model, context) / 2**20 + 1  # one bucket: at each, ranks wait for one another
        ddp = DistributedDataParallel(model, gradient_as_bucket_view=True, bucket_cap_mb=megabytes)
        ddp.register_comm_hook(together, average)
    ddp.broadcast_buffers = False  # the argument has another name in each version of torch
    return ddp


def room(model: SceneModel, context: Context) -> int:
    """Bytes of all gradients, where the ranks tell each other theirs."""
    if context.device.type == "cuda":
        return 0
    return sum(p.numel() * p.element_size() for p in model.parameters() if p.requires_grad)


def average(together: Together, bucket: dist.GradBucket) -> Future[Tensor]:
    """The mean of a bucket over the ranks, added up in their order: a communication hook of DDP."""
    mine = bucket.buffer()
    first, *others = together.gather(mine)
    mine.copy_(first)
    for other in others:
        mine += other
    mine /= 1 + len(others)
    done: Future[Tensor] = Future()
    done.set_result(mine)
    return done
