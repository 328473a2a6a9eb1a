"""What the ranks of a run do together: tell each other numbers, agree on time and on stopping, find a step with numbers
that are not finite, and save."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import torch
import torch.distributed as dist
from filelock import Timeout
from torch import Tensor

from model.scene_model import SceneModel
from pipeline.best import best_steps, lock_of_best
from pipeline.checkpoint import committed, prune, save_checkpoint
from pipeline.clock import Speed
from pipeline.record import GRADIENT, LossRecord
from pipeline.resume import TrainingError, check_run_folder, checkpoints
from pipeline.shared_memory import SharedMemory, share_memory
from pipeline.work import Context, Work

log = logging.getLogger("crossray")

ROOM = 4096  # bytes: enough for whatever numbers are told


class Together:
    """All ranks of a run, who tell each other tensors: through memory where they share a machine, else over gloo, also
    beside GPUs, which nobody waits for here.

    All ranks make this at once, and make the same calls in the same order.

    Args:
        room: bytes of the largest tensor.
    """

    def __init__(self, context: Context, room: int = 0) -> None:
        self.alone = context.world_size == 1
        self.group: dist.ProcessGroup | None = None  # the default one
        self.memory: SharedMemory | None = None
        if not self.alone:
            if context.device.type == "cuda":
                self.group = dist.new_group(backend="gloo")
            self.memory = share_memory(max(room, ROOM), self.group)

    def gather(self, mine: Tensor) -> list[Tensor]:
        """Every rank's tensor, by rank, of one shape and type; to be read before the next call."""
        if self.alone:
            return [mine]
        if self.memory is not None:
            return self.memory.exchange(mine)
        theirs = [torch.empty_like(mine) for _ in range(dist.get_world_size())]
        dist.all_gather(theirs, mine, group=self.group)
        return theirs

    def numbers(self, *mine: float) -> Tensor:
        """Every rank's numbers (ranks, n), float64."""
        return torch.stack(self.gather(torch.tensor(mine, dtype=torch.float64)))

    def agree(self, stop: bool, seconds: float) -> tuple[bool, float]:
        """All ranks take rank 0's clock, and stop if any of them was asked to."""
        said = self.numbers(stop, seconds)
        return bool(said[:, 0].any()), float(said[0, 1])

    def same_step(self, step: int) -> None:
        """RuntimeError where ranks go on from other steps, as when a disk shows one of them less than the others; an
        error of this kind is one after which a launcher may try again."""
        steps = self.numbers(step)
        if steps.min() != steps.max():
            raise RuntimeError(
                f"ranks go on from steps {int(steps.min())} to {int(steps.max())}: they see other checkpoints"
            )


def save(
    work: Work,
    together: Together,
    record: LossRecord,
    speed: Speed,
    model: SceneModel,
    optimiser: torch.optim.Optimizer,
    meta: dict[str, Any],
    last: bool,
) -> None:
    """Every rank's losses, then the checkpoint.

    Raises:
        TrainingError: the `last` one cannot be written. An earlier one that cannot be is only missed.
    """
    began, job, step = time.perf_counter(), work.job, speed.clock.step
    folder = checkpoints(job)
    problem = attempt(lambda: check_run_folder(job)) if work.context.rank == 0 else None
    problem = problem or attempt(record.save)
    if together.numbers(problem is not None).any() and problem is None:
        problem = OSError("the losses of another rank cannot be written")
    if work.context.rank == 0:
        state = model.state_dict(), optimiser.state_dict()
        problem = problem or attempt(lambda: save_checkpoint(folder, step, *state, meta))
    if problem and last:
        raise TrainingError(
            f"step {step} cannot be saved: {problem}. Earlier checkpoints in {folder} are whole: make room (or put the "
            "folder back), and run the same command again"
        )
    if problem:
        log.error("step %d cannot be saved: %s; training goes on and tries again at the next checkpoint", step, problem)
    elif work.context.rank == 0:
        with suppress(Timeout, OSError), lock_of_best(job.run).acquire(timeout=0):  # else the next save prunes
            prune(folder, job.train.keep_checkpoints, best_steps(job.run), newest=step)
    speed.wait(time.perf_counter() - began)


def attempt(action: Callable[[], object]) -> OSError | None:
    """Do it; the error where the disk does not let us."""
    try:
        action()
    except OSError as error:
        return error
    return None


def check_finite(work: Work, together: Together, record: LossRecord, model: SceneModel | None = None) -> None:
    """Stop before numbers that are not finite reach a checkpoint; all ranks stop with the same words.

    Args:
        model: its weights are looked at, too.
    """
    bad = record.look()
    wrong = sum(1 << record.names.index(name) for name in bad.names) if bad else 0
    found = together.numbers(bad.step if bad else torch.inf, wrong)  # a row a rank: step, which numbers as bits
    step = float(found[:, 0].min())
    if step < torch.inf:
        bits = [(rank, int(row[1])) for rank, row in enumerate(found) if row[0] == step]
        of_losses = (1 << record.names.index(GRADIENT)) - 1  # the gradient is the last, and that of all ranks
        ranks = [rank for rank, wrong in bits if wrong & of_losses] or [rank for rank, _ in bits]
        names = [n for i, n in enumerate(record.names[:-1]) if any(wrong >> i & 1 for _, wrong in bits)]
        what = f"the loss {', '.join(names)}" if names else "the gradient"
        raise broken_step(work, int(step), ranks, f"{what} is not finite")
    names = [name for name, value in model.named_parameters() if not bool(value.isfinite().all())] if model else []
    if names:
        raise broken_step(work, record.step - 1, [], f"the weights {', '.join(names[:3])} are not finite")


def broken_step(work: Work, step: int, ranks: list[int], problem: str) -> TrainingError:
    """The error that says what is wrong with a step, on which photos, and how to go on.

    Args:
        ranks: whose photos; none: nobody's in particular.
    """
    records = work.data.photos.records
    drawn = (p for rank in ranks for p in work.patches(step, rank))
    names = sorted({records[work.data.index[p.photo]].name for p in drawn})
    whose = f"rank {ranks[0]}" if len(ranks) == 1 else "all ranks"
    photos = f" (photos of {whose} in this step: {', '.join(names)})" if names else ""
    good = committed(checkpoints(work.job))
    last = f"the last good checkpoint is {good[-1]}" if good else "there is no checkpoint yet"
    skip = [*work.job.train.skip_steps, step]
    return TrainingError(
        f"step {step}: {problem}{photos}; {last}. A lower learning rate is the usual cure; "
        f"--set 'train.skip_steps={skip}' goes on without this step"
    )
