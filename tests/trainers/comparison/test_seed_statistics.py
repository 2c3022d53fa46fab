"""Tests statistics over seeds against hand-computed numbers and plain Python."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emberlink.trainers.comparison import bootstrap as statistics
from emberlink.trainers.comparison.bootstrap import (
    as_ratio,
    crossed_interval,
    interval,
    iqm,
    iqm_difference,
    iqm_ratio_share,
    probability_of_improvement,
)

numbers = st.lists(st.integers(0, 40).map(float), min_size=1, max_size=9)


def plain_iqm(values) -> float:
    """Computes the interquartile mean in plain Python."""
    ordered = sorted(values)
    cut = len(ordered) // 4
    kept = ordered[cut : len(ordered) - cut]
    return sum(kept) / len(kept)


def plain_improvement(sample, reference) -> float:
    """Computes the probability of improvement, pair by pair."""
    pairs = list(itertools.product(sample, reference))
    return sum(1.0 if a > b else 0.5 if a == b else 0.0 for a, b in pairs) / len(pairs)


def plain_interval(statistic, *samples) -> tuple[float, float]:
    """Computes the percentile interval over all possible resamples with equal weights."""
    drawn = [list(itertools.product(sample, repeat=len(sample))) for sample in samples]
    values = [statistic(*chosen) for chosen in itertools.product(*drawn)]
    return float(np.quantile(values, 0.025)), float(np.quantile(values, 0.975))


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([7], 7),
        ([1, 3], 2),
        ([1, 2, 9], 4),
        ([0, 1, 3, 100], 2),
        ([0, 1, 3, 5, 100], 3),
        ([8, 7, 6, 5, 4, 3, 2, 1], 4.5),
    ],
)
def test_iqm_of_few_seeds(values, expected):
    assert iqm(np.asarray(values, float)) == expected


@settings(deadline=None)
@given(numbers, numbers)
def test_statistics_equal_plain_python(sample, reference):
    a, b = np.asarray(sample), np.asarray(reference)
    assert iqm(a) == pytest.approx(plain_iqm(sample))
    assert probability_of_improvement(a, b) == pytest.approx(plain_improvement(sample, reference))
    assert probability_of_improvement(a, b) + probability_of_improvement(b, a) == pytest.approx(1)


@pytest.mark.parametrize(
    ("sample", "others", "higher", "ratio"),
    [
        ([6, 6], ([3, 3], [4, 4]), True, 1.5),
        ([20], ([30], [26]), False, 1.3),
        ([2], ([0],), True, float("inf")),
        ([0], ([5],), False, float("inf")),
        ([0], ([5],), True, 0),
        ([0], ([0], [0]), False, 1),
    ],
)
def test_ratio_to_the_best_other(sample, others, higher, ratio):
    share = iqm_ratio_share(
        np.asarray(sample, float), *(np.asarray(o, float) for o in others), higher=higher
    )
    assert as_ratio(float(share)) == pytest.approx(ratio)


@pytest.mark.parametrize("values", [[1, 2, 4, 8], [0.1, 0.7, 0.2, 0.9, 0.4]])
def test_interval_equals_that_of_all_resamples(values):
    low, high = plain_interval(lambda chosen: plain_iqm(chosen), values)
    got = interval(iqm, values)
    # 10,000 resamples are drawn, so that an end may be the neighbouring value.
    assert got is not None
    assert got == pytest.approx((low, high), abs=0.06 * (max(values) - min(values)))
    # With 4 seeds the ends are the worst and the best seed, with 5 they lie between them.
    assert (got == (min(values), max(values))) == (len(values) < statistics.FEW)


def test_interval_of_a_difference_is_over_the_seeds_of_both():
    first, second = [1.0, 3.0, 8.0], [2.0, 6.0]
    got = interval(iqm_difference, first, second)
    # There are 27 means of the first and 4 of the second. Of the 108 differences, the least are -5,
    # once, and 5/3 - 6, three times. These 4 are 3.7 % of all, so that the 2.5 % end at the latter.
    assert got == pytest.approx((5 / 3 - 6, 19 / 3 - 2), abs=1e-9)
    expected = plain_interval(lambda a, b: plain_iqm(a) - plain_iqm(b), first, second)
    assert got == pytest.approx(expected, abs=1e-9)
    assert interval(iqm_difference, first, second) == got
    assert interval(iqm_difference, first, [2.0]) is None


def mean_difference(first, second, axis=-1):
    return first.mean(axis) - second.mean(axis)


def test_the_paired_interval_draws_fires_together():
    first = np.array([1.0, 2.0, 3.0, 4.0])
    assert interval(mean_difference, first, first + 1, paired=True) == (-1.0, -1.0)
    assert interval(mean_difference, first[:1], first[:1], paired=True) is None


def test_the_crossed_interval_draws_seeds_and_the_same_fires():
    fires, seeds = np.array([[0.0, 10, 20]]), np.array([[1.0], [2], [4]])
    # The trainings differ by 3 on each fire, whichever fires are drawn: only seeds count.
    low, high = crossed_interval(mean_difference, seeds + fires + 3, seeds + fires) or (0, 0)
    alone = interval(mean_difference, (seeds[:, 0] + 3).tolist(), seeds[:, 0].tolist())
    assert (low, high) == pytest.approx(alone, abs=0.4)
    # One of them gains on a fire: without spread over seeds, only fires count.
    first, second = np.repeat(fires, 2, axis=0), np.zeros((2, 3))
    assert crossed_interval(mean_difference, first, second) == (0, 20)
    assert crossed_interval(mean_difference, first[:1], second) is None
