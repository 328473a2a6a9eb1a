"""The patch plan: pure, fair to every photo, inside every photo, and different in every epoch."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from pipeline.patches import Patch, PatchPlan, list_patches, patches, step_generator, steps_per_epoch

plans = st.builds(
    PatchPlan,
    size=st.sampled_from([2, 4, 32]),
    photos=st.integers(1, 3),
    min_scale=st.sampled_from([0.1, 0.5, 1.0]),
    max_scale=st.just(1.0),
    seed=st.integers(0, 2**63 - 1),
)
sizes_of_photos = st.lists(st.tuples(st.integers(3, 400), st.integers(3, 400)), min_size=1, max_size=12).map(np.array)


def epoch_of(plan, sizes, epoch, world_size, steps):
    return [
        p
        for step in range(epoch * steps, (epoch + 1) * steps)
        for rank in range(world_size)
        for p in patches(plan, sizes, step=step, rank=rank, world_size=world_size, steps_per_epoch=steps)
    ]


@settings(deadline=None, max_examples=25)
@given(plans, sizes_of_photos, st.integers(1, 4), st.integers(1, 12), st.integers(0, 3))
def test_visits_differ_by_at_most_one_over_all_ranks_of_an_epoch(plan, sizes, world_size, steps, epoch):
    visits = Counter(dict.fromkeys(range(len(sizes)), 0))
    visits.update(p.photo for p in epoch_of(plan, sizes, epoch, world_size, steps))
    assert sum(visits.values()) == steps * world_size * plan.photos
    assert max(visits.values()) - min(visits.values()) <= 1


@settings(deadline=None, max_examples=25)
@given(plans, sizes_of_photos, st.integers(0, 10**9), st.integers(0, 7))
def test_the_grid_stays_inside_the_photo_in_float32(plan, sizes, step, rank):
    for p in patches(plan, sizes, step=step, rank=rank, world_size=8, steps_per_epoch=1000):
        assert np.float32(plan.min_scale) <= p.scale <= np.float32(plan.max_scale)
        assert 0 <= p.other < len(sizes)
        for offset, side in zip((p.offset_h, p.offset_w), sizes[p.photo], strict=True):
            assert offset >= 0
            side32, k = np.float32(side), plan.size
            places = np.linspace(0, 1 - 1 / side32, k, dtype=np.float32) * np.float32(p.scale) + np.float32(offset)
            assert np.floor(places * side32).max() <= side - 1


@settings(deadline=None, max_examples=25)
@given(plans, sizes_of_photos, st.integers(0, 10**6))
def test_a_step_is_a_pure_function_of_its_arguments(plan, sizes, step):
    def draw(s=step, r=0):
        return patches(plan, sizes, step=s, rank=r, world_size=2, steps_per_epoch=50)

    first = draw()
    draw(step + 1)
    assert draw() == first
    assert len(first) == plan.photos
    assert all(isinstance(p, Patch) for p in first)
    if plan.min_scale < 1:  # at scale 1 nothing is left to draw but `other`
        assert [p.scale for p in draw(step + 1)] != [p.scale for p in first] != [p.scale for p in draw(r=1)]


def test_each_epoch_and_each_pass_has_its_own_order():
    plan, sizes = PatchPlan(size=2), np.full((20, 2), 10)
    order = [p.photo for p in epoch_of(plan, sizes, 0, 1, 40)]
    later = [p.photo for p in epoch_of(plan, sizes, 1, 1, 40)]
    assert sorted(order[:20]) == sorted(order[20:]) == list(range(20))
    assert order[:20] != order[20:]
    assert order != later
    other_seed = [p.photo for p in epoch_of(plan.model_copy(update={"seed": 1}), sizes, 0, 1, 40)]
    assert other_seed != order


def test_ranks_of_one_step_visit_consecutive_places_of_the_order():
    plan, sizes = PatchPlan(photos=2), np.full((12, 2), 10)
    alone = [p.photo for p in epoch_of(plan, sizes, 3, 1, 6)]
    together = [p.photo for p in epoch_of(plan, sizes, 3, 3, 2)]
    assert together == alone


def test_draws_are_spread_over_their_ranges():
    plan, sizes = PatchPlan(photos=4000, min_scale=0.25), np.full((5, 2), [50, 100])
    found = patches(plan, sizes, step=0, rank=0, world_size=1, steps_per_epoch=1)
    scale = np.array([p.scale for p in found])
    h = np.array([p.offset_h for p in found]) / ((1 - scale) * (1 - 1 / 50))
    w = np.array([p.offset_w for p in found]) / ((1 - scale) * (1 - 1 / 100))
    for values, low, high in ((scale, 0.25, 1), (h, 0, 1), (w, 0, 1)):
        counts, _ = np.histogram(values, bins=10, range=(low, high))
        assert counts.sum() >= 3999  # h and w may pass 1 by one float32 rounding
        assert abs(counts - 400).max() < 100  # 5 standard deviations
    assert abs(np.corrcoef([scale, h, w]) - np.eye(3)).max() < 0.08
    others = Counter(p.other for p in found)
    assert min(others.values()) > 650  # 800 expected


def test_steps_an_epoch_by_hand():
    plan = PatchPlan(size=32)
    sizes = np.array([[100, 200], [50, 60]])  # 23,000 pixels, 1,024 rays
    assert steps_per_epoch(plan, sizes, 1) == 22
    assert steps_per_epoch(plan, sizes, 8) == 2
    assert steps_per_epoch(plan, sizes, 64) == 1
    assert steps_per_epoch(plan.model_copy(update={"photos": 2}), sizes, 1) == 11
    assert steps_per_epoch(plan, np.full((3000, 2), 4000, np.int32), 1) == 3000 * 4000 * 4000 // 1024  # past 2^31


def test_the_generator_of_a_step_is_its_own():
    def draw(*key):
        return torch.rand(4, generator=step_generator(*key, "cpu")).tolist()

    assert draw(1, 2, 3) == draw(1, 2, 3)
    keys = [(1, 2, 3), (1, 3, 2), (2, 1, 3), (1, 2, 4), (0, 0, 0), (0, 1, 0), (0, 0, 1), (2**62, 0, 0)]
    assert len({tuple(draw(*k)) for k in keys}) == len(keys)


def test_the_listed_plan_is_the_plan_that_trains():
    plan, sizes, keys = PatchPlan(size=4, photos=2, seed=5), np.array([[8, 9], [10, 11], [6, 6]]), ["a", "b", "c"]
    rows = list(list_patches(plan, keys, sizes, epoch=1, world_size=2))
    steps = steps_per_epoch(plan, sizes, 2)
    assert steps == 218 // 64
    expected = epoch_of(plan, sizes, 1, 2, steps)
    assert [(r.photo, r.scale, r.offset_h, r.offset_w, r.other) for r in rows] == [
        (keys[p.photo], p.scale, p.offset_h, p.offset_w, keys[p.other]) for p in expected
    ]
    assert [(r.step, r.rank) for r in rows] == [(s, r) for s in range(3, 6) for r in (0, 0, 1, 1)]


def test_plans_and_arguments_that_make_no_sense_are_refused():
    for wrong in ({"min_scale": 0.9, "max_scale": 0.8}, {"size": 1}, {"min_scale": 0}, {"photo": 2}, {"seed": -1}):
        with pytest.raises(ValidationError):
            PatchPlan.model_validate(wrong)
    with pytest.raises(ValueError, match="rank 2 of 2"):
        patches(PatchPlan(), np.full((1, 2), 9), step=0, rank=2, world_size=2, steps_per_epoch=1)
    with pytest.raises(ValueError, match="0 photos"):
        patches(PatchPlan(), np.empty((0, 2)), step=0, rank=0, world_size=1, steps_per_epoch=1)
