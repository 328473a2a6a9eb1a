"""The bootstrap over photos: by hand, against a slow one, and its promise."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pipeline.bootstrap import LEVEL, RESAMPLES, SEED, interval, paired_interval, tied

SCORES = [21.5, 18.25, 24.0, 22.75, 19.0, 23.5, 20.25, 25.0]


def test_two_photos_by_hand():
    """Means of two draws from {0, 1} are 0, 1/2 and 1, a quarter, a half and a quarter of them."""
    assert interval([0.0, 1.0]) == (0.0, 1.0)


def test_three_photos_by_hand():
    """Of the 27 equally likely draws from {0, 0, 3}, 8 have mean 0 and one, 3.7 %, has mean 3: both ends of 2.5 %."""
    assert interval([0.0, 0.0, 3.0]) == (0.0, 3.0)


def test_four_photos_by_hand():
    """Of {0, 0, 0, 4}, means k = 0..4 have chances (81, 108, 54, 12, 1) / 256: 243 / 256 = 94.9 % are at most 2, 99.6 %
    at most 3."""
    assert interval([0.0, 0.0, 0.0, 4.0]) == (0.0, 3.0)


def test_equal_scores_leave_no_doubt():
    assert interval([20.5] * 5) == (20.5, 20.5)


def slow_interval(values: list[float]) -> tuple[float, float]:
    """Resample by resample; sorted means, between whose ranks numpy's usual quantile interpolates."""
    generator, means = np.random.default_rng(SEED), []
    for row in generator.integers(len(values), size=(RESAMPLES, len(values))).tolist():
        means.append(math.fsum(values[i] for i in row) / len(values))
    means.sort()

    def quantile(share: float) -> float:
        place = share * (RESAMPLES - 1)
        below = math.floor(place)
        return means[below] + (place - below) * (means[below + 1] - means[below])

    return quantile((1 - LEVEL) / 2), quantile(1 - (1 - LEVEL) / 2)


def test_it_agrees_with_the_slow_one():
    assert interval(SCORES) == pytest.approx(slow_interval(SCORES), abs=1e-9)


def test_it_holds_the_mean_moves_with_the_scores_and_is_the_same_each_time():
    low, high = interval(SCORES)
    assert min(SCORES) < low < np.mean(SCORES) < high < max(SCORES)
    assert interval(SCORES) == (low, high)
    assert interval([2 * s + 1 for s in SCORES]) == pytest.approx((2 * low + 1, 2 * high + 1))
    many = interval(SCORES * 16)
    assert many[1] - many[0] < 0.3 * (high - low)  # a quarter as wide


def test_it_covers_the_truth_about_as_often_as_it_says():
    """A percentile interval of 30 photos is known to be a little too narrow, so somewhat less than 95 of 100."""
    generator = np.random.default_rng(7)
    sets = [generator.normal(20.0, 3.0, 30).tolist() for _ in range(100)]
    held = sum(low <= 20.0 <= high for low, high in map(interval, sets))
    assert 87 <= held <= 99


@pytest.mark.parametrize("values", [[], [20.0], [20.0, math.inf], [20.0, math.nan], [-math.inf, 20.0, 21.0]])
def test_none_where_there_is_no_interval(values):
    """One photo says nothing of others; and a mean that is not finite has no neighbourhood."""
    assert interval(values) is None


# Two methods on the same photos


def test_photos_cancel_where_methods_are_compared_photo_by_photo():
    better = [s + 0.5 + 0.01 * i for i, s in enumerate(SCORES)]
    low, high = paired_interval(better, SCORES)
    assert 0.5 < low < 0.535 < high < 0.57
    assert not tied(better, SCORES)
    assert not tied(SCORES, better)
    apart = interval(better)[0], interval(SCORES)[1]
    assert apart[0] < apart[1]  # each by itself could not tell them apart


def test_the_paired_interval_is_that_of_the_differences():
    other = [20.0, 19.0, 23.0, 23.0, 20.0, 22.0, 21.0, 25.5]
    assert paired_interval(SCORES, other) == interval([a - b for a, b in zip(SCORES, other, strict=True)])
    low, high = paired_interval(other, SCORES)
    assert paired_interval(SCORES, other) == pytest.approx((-high, -low), abs=0.02)  # other resamples


def test_what_photos_cannot_tell_apart_is_tied():
    assert tied(SCORES, SCORES)
    assert tied(SCORES, [s + (0.5 if i % 2 else -0.5) for i, s in enumerate(SCORES)])
    assert tied([20.0], [30.0])  # one photo


@pytest.mark.filterwarnings("error")
def test_perfect_pictures_cannot_be_compared_and_nobody_is_warned():
    """inf - inf is no number."""
    assert paired_interval([math.inf, 20.0], [math.inf, 21.0]) is None
    assert tied([math.inf, 20.0], [math.inf, 21.0])


def test_other_photos_are_refused():
    with pytest.raises(ValueError, match="8 and 7 photos"):
        paired_interval(SCORES, SCORES[1:])
