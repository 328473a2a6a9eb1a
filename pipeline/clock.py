"""How far a training is, and how fast it goes."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

from torch import Tensor

from pipeline.metrics import psnr_of


@dataclass
class Clock:
    """How far training is: by steps, or by seconds where the job gives seconds."""

    total_steps: int | None
    total_seconds: float | None
    step: int = 0
    seconds: float = 0.0

    @property
    def progress(self) -> float:
        """Share of the training that is done, in [0, 1]."""
        if self.total_seconds is not None:
            return min(self.seconds / self.total_seconds, 1.0)
        assert self.total_steps is not None
        return self.step / self.total_steps

    @property
    def done(self) -> bool:
        """Whether no step is left."""
        return self.progress >= 1


@dataclass
class Speed:
    """What one start of a training takes; made when its first step begins."""

    clock: Clock
    rays_a_step: int
    checkpoint_seconds: float = 0.0
    """That the ranks waited for the last checkpoint."""
    all_checkpoint_seconds: float = 0.0
    """That they have waited for checkpoints since this start."""
    began: float = field(default_factory=time.perf_counter)

    def __post_init__(self) -> None:
        self.before = self.clock.seconds
        self.first = self.last_step = self.clock.step
        self.last = self.began

    def seconds(self) -> float:
        """Of training so far, with those of earlier starts."""
        return self.before + time.perf_counter() - self.began

    def wait(self, seconds: float) -> None:
        """The ranks waited for a checkpoint."""
        self.checkpoint_seconds = seconds
        self.all_checkpoint_seconds += seconds

    def numbers(self, terms: dict[str, Tensor], watched: dict[str, Tensor]) -> dict[str, float]:
        """Of the steps since the last call; loss and PSNR of the last one."""
        now, steps = time.perf_counter(), self.clock.step - self.last_step
        step_seconds = (now - self.last) / max(steps, 1)
        self.last, self.last_step = now, self.clock.step
        return {
            "step": float(self.clock.step),
            "loss": float(sum(terms.values())),
            "psnr": psnr_of(watched["mse"]),
            "step_seconds": step_seconds,
            "rays_per_second": self.rays_a_step / step_seconds,
            "checkpoint_seconds": self.checkpoint_seconds,
        }

    def facts(self) -> dict[str, float | int | None]:
        """How far and how long still, for those who watch."""
        here = time.perf_counter() - self.began
        steps = self.clock.step - self.first
        step_seconds = here / steps if steps else 0.0
        total = self.clock.total_steps
        if total is not None:
            left = (total - self.clock.step) * step_seconds if steps else None
        else:
            left = max((self.clock.total_seconds or 0.0) - self.clock.seconds, 0.0)
        return {
            "step": self.clock.step,
            "total": total,
            "progress": self.clock.progress,
            "seconds": self.clock.seconds,
            "seconds_left": left,
            "step_seconds": step_seconds,
        }
