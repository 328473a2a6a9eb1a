"""Learning rates over a training, and the clock that drives them, against hand-computed values."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
import torch

from pipeline.config import TrainJob
from pipeline.train import Clock, learning_rate

COSINE = TrainJob()  # the paper's: 20 epochs, no warm-up


def at(job: TrainJob, base: float, step: int, total: int) -> float:
    return learning_rate(base, job, step, step / total)


@pytest.mark.parametrize("epoch_length", [1, 7, 17200])
def test_cosine_is_torchs_scheduler_stepped_once_an_epoch(epoch_length):
    parameter = torch.nn.Parameter(torch.zeros(1))
    optimiser = torch.optim.Adam([parameter], lr=5e-4)
    scheduler = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, T_max=20, eta_min=1e-8)
    total = 20 * epoch_length
    for epoch in range(20):
        expected = optimiser.param_groups[0]["lr"]
        steps = {epoch * epoch_length, epoch * epoch_length + epoch_length // 2, (epoch + 1) * epoch_length - 1}
        for step in steps:  # first, middle and last step of the epoch
            assert at(COSINE, 5e-4, step, total) == pytest.approx(expected, rel=1e-12)
        optimiser.step()
        scheduler.step()


def test_cosine_by_hand():
    assert at(COSINE, 5e-4, 0, 2000) == pytest.approx(5e-4, rel=1e-15)
    assert at(COSINE, 5e-4, 1000, 2000) == pytest.approx(1e-8 + (5e-4 - 1e-8) / 2, rel=1e-12)  # cos(pi / 2) = 0
    third = TrainJob(epochs=3)
    assert at(third, 1.0, 1, 3) == pytest.approx(1e-8 + (1 - 1e-8) * 0.75, rel=1e-12)  # cos(pi / 3) = 1/2
    assert at(third, 1.0, 2, 3) == pytest.approx(1e-8 + (1 - 1e-8) * 0.25, rel=1e-12)
    assert learning_rate(1.0, third, 3, 1.0) == pytest.approx(1e-8, rel=1e-9)


def test_cosine_is_constant_inside_every_epoch():
    job = TrainJob(epochs=7)
    length = 43  # 1 / 7 has no exact binary form: a slip of one ulp would move a step to its neighbour's epoch
    for epoch in range(7):
        rates = {at(job, 1.0, step, 7 * length) for step in range(epoch * length, (epoch + 1) * length)}
        assert len(rates) == 1


def test_warm_up_rises_linearly_to_the_base_and_then_stays():
    job = TrainJob(warmup_steps=4, decay="exponential", decay_from=0.5)
    rates = [at(job, 1.0, step, 1000) for step in range(7)]
    assert rates == pytest.approx([0.2, 0.4, 0.6, 0.8, 1.0, 1.0, 1.0], rel=1e-12)


def test_exponential_starts_late_and_ends_at_the_floor():
    job = TrainJob(decay="exponential", decay_from=0.5, decay_floor=0.04)
    assert [at(job, 2.0, step, 100) for step in (0, 25, 50)] == [2.0, 2.0, 2.0]
    assert at(job, 2.0, 75, 100) == pytest.approx(2.0 * 0.2, rel=1e-12)  # sqrt(0.04), half-way through the decay
    assert learning_rate(2.0, job, 100, 1.0) == pytest.approx(0.08, rel=1e-12)
    late = [at(job, 2.0, step, 100) for step in range(50, 100)]
    assert all(a > b for a, b in pairwise(late))
    ratios = [b / a for a, b in pairwise(late)]
    assert ratios == pytest.approx([math.pow(0.04, 1 / 50)] * 49, rel=1e-9)


def test_exponential_may_decay_from_the_start():
    job = TrainJob(decay="exponential", decay_from=0.0, decay_floor=0.25)
    assert at(job, 1.0, 50, 100) == pytest.approx(0.5, rel=1e-12)


def test_the_clock_by_steps():
    clock = Clock(total_steps=8, total_seconds=None)
    assert (clock.progress, clock.done) == (0.0, False)
    clock.step, clock.seconds = 6, 1e9  # seconds do not matter
    assert (clock.progress, clock.done) == (0.75, False)
    clock.step = 8
    assert (clock.progress, clock.done) == (1.0, True)


def test_the_clock_by_seconds():
    clock = Clock(total_steps=None, total_seconds=20.0)
    clock.step = 10**9  # steps do not matter
    assert (clock.progress, clock.done) == (0.0, False)
    clock.seconds = 5.0
    assert (clock.progress, clock.done) == (0.25, False)
    clock.seconds = 21.0
    assert (clock.progress, clock.done) == (1.0, True)
