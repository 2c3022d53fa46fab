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
    crossed_p,
    holm,
    iqm,
    iqm_difference,
    iqm_ratio_share,
    probability_of_improvement,
    ratio_to_best,
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
    share = iqm_ratio_share(*(np.asarray(x, float) for x in (sample, *others)), higher=higher)
    assert as_ratio(float(share)) == pytest.approx(ratio)


@pytest.mark.parametrize("values", [[1, 2, 4, 8], [0.1, 0.7, 0.2, 0.9, 0.4]])
def test_interval_equals_that_of_all_resamples(values):
    low, high = plain_interval(lambda chosen: plain_iqm(chosen), values)
    got = crossed_interval(iqm, np.array(values)[:, None])
    # 10,000 resamples are drawn, so that an end may be the neighbouring value.
    assert got is not None
    assert got == pytest.approx((low, high), abs=0.06 * (max(values) - min(values)))
    # With 4 seeds the ends are the worst and the best seed, with 5 they lie between them.
    assert (got == (min(values), max(values))) == (len(values) < statistics.FEW)


def test_interval_of_a_difference_is_over_the_seeds_of_both():
    first, second = np.array([[1.0], [3], [8]]), np.array([[2.0], [6]])
    got = crossed_interval(iqm_difference, first, second)
    # There are 27 means of the first and 4 of the second. Of the 108 differences, the least are -5,
    # once, and 5/3 - 6, three times. These 4 are 3.7 % of all, so the 2.5 % quantile is 5/3 - 6.
    assert got == pytest.approx((5 / 3 - 6, 19 / 3 - 2), abs=1e-9)
    assert crossed_interval(iqm_difference, first, second[:1]) is None


def mean_difference(first, second, axis=-1):
    return first.mean(axis) - second.mean(axis)


def test_the_interval_over_fires_draws_them_together():
    first = np.array([[1.0, 2.0, 3.0, 4.0]])
    assert crossed_interval(mean_difference, first, first + 1, seeds=False) == (-1.0, -1.0)
    assert crossed_interval(mean_difference, first[:, :1], first[:, :1], seeds=False) is None


def test_the_crossed_interval_draws_seeds_and_the_same_fires():
    fires, seeds = np.array([[0.0, 10, 20]]), np.array([[1.0], [2], [4]])
    # The trainings differ by 3 on each fire, whichever fires are drawn: only seeds count.
    low, high = crossed_interval(mean_difference, seeds + fires + 3, seeds + fires) or (0, 0)
    assert (low, high) == pytest.approx(crossed_interval(mean_difference, seeds + 3, seeds))
    # One of them gains on a fire: without spread over seeds, only fires count.
    first, second = np.repeat(fires, 2, axis=0), np.zeros((2, 3))
    assert crossed_interval(mean_difference, first, second) == (0, 20)
    assert ratio_to_best(first + 5, second + 10, higher=True)[1] == pytest.approx((0.5, 2.5))
    assert crossed_interval(mean_difference, first[:1], second) is None


@pytest.mark.parametrize("seeds", [5, 10])
def test_the_crossed_interval_contains_the_truth_in_about_95_of_100_simulations(seeds, monkeypatch):
    """Standard deviations, in points: 2 between seeds, 8 of an episode, 5 between fires.

    400 simulations with 1,000 resamples gave 98 % and 97 %. An interval over fires alone, drawn for
    both together, contains the truth in about half of them.
    """
    monkeypatch.setattr(statistics, "RESAMPLES", 500)
    generator, inside, alone = np.random.default_rng(1), 0, 0
    for _ in range(100):
        first, second = (
            generator.normal(0, 2, (seeds, 1)) + generator.normal(0, 5, 100)
            + generator.normal(0, 8, (seeds, 100)) for _ in range(2)
        )  # fmt: skip
        low, high = crossed_interval(iqm_difference, first, second) or (0, 0)
        inside += low <= 0 <= high
        fires = crossed_interval(iqm_difference, first, second, seeds=False) or (0, 0)
        alone += fires[0] <= 0 <= fires[1]
    assert 92 <= inside <= 100
    assert alone < 90


def test_the_p_value_belongs_to_the_interval():
    generator = np.random.default_rng(3)
    second = generator.normal(0, 1, (5, 8))
    for shift in (0.0, 0.6, 1.0, 1.4, 3.0):
        low, high = crossed_interval(iqm_difference, second + shift, second) or (0, 0)
        p = crossed_p(iqm_difference, second + shift, second)
        assert p is not None
        assert (p < 0.05) == (low > 0 or high < 0)
    assert p == pytest.approx(2 / 10_001)
    assert crossed_p(iqm_difference, second, second[:1]) is None


def test_holm_by_hand():
    # 0.01 * 4, 0.02 * 3, then 0.03 * 2 and 0.04 * 1, which must not fall below it
    assert holm([0.04, 0.01, 0.03, 0.02]) == pytest.approx([0.06, 0.04, 0.06, 0.06])
    assert holm([0.9, 0.7]) == [1.0, 1.0]
