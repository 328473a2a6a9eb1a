"""What a rank does in each step: a pure function of job, step and rank, so that any step can be run again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from model.scene_model import Batch, as_read, needs_other, needs_references
from pipeline.batches import TrainingPhotos, jitter_colours
from pipeline.config import Job
from pipeline.patches import Patch, patches, step_generator

JITTER = 4  # keeps these draws apart from those of the patches


@dataclass(frozen=True)
class Context:
    """What a launcher tells a rank; the process group, if there are several ranks, is already there."""

    rank: int = 0
    world_size: int = 1
    device: torch.device = torch.device("cpu")
    should_stop: Callable[[], bool] = lambda: False
    watch: Callable[[dict[str, float]], None] = lambda numbers: None
    """Takes speed and loss every `log_every` steps, on rank 0 alone."""
    report: Callable[[dict[str, float]], None] = lambda numbers: None
    """Takes the same after a checkpoint, on all ranks in the same step; it may cost seconds, so it is called rarely."""


@dataclass(frozen=True)
class Work:
    """What a rank does in each step: fixed for the whole run, and a pure function of the step."""

    job: Job
    context: Context
    data: TrainingPhotos
    steps_per_epoch: int

    def patches(self, step: int, rank: int) -> list[Patch]:
        """Which patches a rank sees in a step."""
        return patches(
            self.job.patch,
            self.data.sizes,
            step=step,
            rank=rank,
            world_size=self.context.world_size,
            steps_per_epoch=self.steps_per_epoch,
        )

    def batch(self, step: int) -> Batch:
        """The pixels, rays and references of these patches."""
        model, size = self.job.model, self.job.patch.size
        others, references = needs_other(model, self.job.losses), needs_references(model)
        batch = self.data.batch(self.patches(step, self.context.rank), size, others, references)
        batch = batch._replace(references=as_read(model, batch.references), others=as_read(model, batch.others))
        strength = self.job.train.colour_jitter
        if strength == 0:
            return batch
        return jitter_colours(batch, strength, np.random.default_rng((JITTER, self.seed, step, self.context.rank)))

    def generator(self, step: int) -> torch.Generator:
        """The source of everything else that is drawn in a step."""
        return step_generator(self.seed, step, self.context.rank, self.context.device)

    @property
    def seed(self) -> int:
        """Of everything that is drawn."""
        return self.job.patch.seed

    @property
    def rays_a_step(self) -> int:
        """Over all ranks."""
        return self.job.patch.photos * self.job.patch.size**2 * self.context.world_size
