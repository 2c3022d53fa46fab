"""Tests the numbers of `emberlink fire preview` against hand-computed values."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from emberlink.envs.config import WildfireConfig
from emberlink.trainers.fires.stats import (
    Growth,
    TeamCapability,
    burnt_out,
    comparisons,
    growth,
    short,
)

INF = np.inf


def fire(rows: list[list[float]]) -> np.ndarray:
    """Returns arrival times from rows, the uppermost first."""
    return np.array(rows[::-1], dtype=np.float32).T


def test_growth_by_hand():
    arrival = fire([[INF, 0, 0, 10], [INF, 1.5, 90, 11], [INF, 61, 14, 101]])
    result = growth(arrival, 100)
    assert (result.start, result.end, result.window) == (2, 8, 5)
    assert result.mean == 0.06
    # 10, 11 and 14 burn at 14 and none of them at 9.
    assert (result.maximum, result.since) == (0.6, 9)


def test_a_static_fire_does_not_grow():
    arrival = fire([[INF, 0, 0], [INF, 0, 200], [INF, INF, INF]])
    result = growth(arrival, 100)
    assert (result.start, result.end, result.mean, result.maximum) == (3, 3, 0, 0)
    assert growth(np.full((8, 8), INF, np.float32), 100).maximum == 0


@settings(max_examples=60, deadline=None)
@given(
    arrays(
        np.float32,
        st.tuples(st.integers(8, 12), st.integers(8, 12)),
        elements=st.sampled_from([0.0, 0.5, 3.0, 40.0, 99.0, 100.0, 150.0, INF]),
    ),
    st.integers(1, 120),
)
def test_numbers_are_finite_and_independent_of_rotation(arrival, horizon):
    result = growth(arrival, horizon)
    assert 0 <= result.start <= result.end == int((arrival <= horizon).sum())
    assert result.mean <= result.maximum + 1e-9
    for turned in (arrival[::-1], arrival.T, arrival[:, ::-1].T):
        other = growth(turned, horizon)
        assert (other.start, other.end, other.maximum) == (result.start, result.end, result.maximum)
    assert not (burnt_out(arrival) & np.isfinite(arrival)).any()


def test_burnt_out_cells_lie_within_the_first_fire():
    ring = fire(
        [
            [9, 9, 9, 9, 9, 9],
            [0, 0, 0, 0, 9, 9],
            [0, INF, INF, 0, 9, INF],
            [0, 0, INF, 0, 9, 9],
            [9, 0, 0, 0, INF, 9],
            [9, 9, 9, 9, 9, 9],
        ]
    )
    expected = fire([[0] * 6, [0] * 6, [0, 1, 1, 0, 0, 0], [0, 0, 1, 0, 0, 0], [0] * 6, [0] * 6])
    assert np.array_equal(burnt_out(ring), expected.astype(bool))
    assert not burnt_out(np.where(ring == 9, INF, np.where(np.isinf(ring), 9, ring))).any()


def test_the_team_by_hand():
    team = TeamCapability.of(
        WildfireConfig(num_uavs=3, altitude=(1.0, 5.0), view_angle=45.0, displacement=2)
    )
    assert (team.num_uavs, team.flight) == (3, 2)
    assert team.width == pytest.approx(10)
    assert team.uncovered == pytest.approx(60)
    assert team.seen == pytest.approx(300)


@pytest.mark.parametrize(
    ("changes", "enough"),
    [
        ({}, [True, True]),
        ({"maximum": 61.0}, [False, True]),
        ({"end": 901}, [True, False]),  # 300 at once and 60 in each of 10 steps
        ({"maximum": 60.0, "end": 900}, [True, True]),
    ],
)
def test_growth_is_compared_with_the_team(changes, enough):
    team = TeamCapability(num_uavs=3, flight=2.0, width=10.0)
    about = {"start": 5, "end": 400, "mean": 1.0, "window": 1, "maximum": 3.0, "since": 0}
    checks = comparisons(Growth(**{**about, **changes}), team, 10)
    assert [good for good, _ in checks] == enough
    if not changes:
        assert "3 start to burn: 20 times" in checks[0][1]
        assert "300 can be in view at once; uncovering the others takes at least 2" in checks[1][1]


@pytest.mark.parametrize(
    ("value", "text"), [(0, "0"), (0.00512, "0.00512"), (99.96, "100"), (12345.6, "12346")]
)
def test_numbers_are_printed_with_few_digits(value, text):
    assert short(value) == text
