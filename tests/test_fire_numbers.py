"""What `emberlink fire preview` says of a fire, against numbers worked out by hand."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from emberlink.envs.config import WildfireConfig
from emberlink.envs.fire.level_set import arrival_times, disc
from emberlink.trainers.fires.stats import (
    Growth,
    Team,
    burnt_out,
    comparisons,
    front_speed,
    growth,
    short,
)

INF = np.inf


def fire(rows: list[list[float]]) -> np.ndarray:
    """Arrival times from rows as they are seen, the uppermost first."""
    return np.array(rows[::-1], dtype=np.float32).T


def test_growth_by_hand():
    arrival = fire([[INF, 0, 0, 10], [INF, 1.5, 90, 11], [INF, 61, 14, 101]])
    found = growth(arrival, 100)
    assert (found.start, found.end, found.window) == (2, 8, 5)
    assert found.mean == 0.06
    # 10, 11 and 14 burn at 14 and none of them at 9.
    assert (found.most, found.since) == (0.6, 9)


def test_a_fire_that_stands_still_has_no_speed():
    arrival = fire([[INF, 0, 0], [INF, 0, 200], [INF, INF, INF]])
    found = growth(arrival, 100)
    assert (found.start, found.end, found.mean, found.most, found.speed) == (3, 3, 0, 0, 0)
    assert growth(np.full((8, 8), INF, np.float32), 100).speed == 0


@pytest.mark.parametrize("angle", range(0, 360, 25))
@pytest.mark.parametrize("speed", [0.003, 0.02, 0.06, 0.3])
@pytest.mark.parametrize("whole", [False, True])
def test_the_speed_of_a_straight_front(speed, angle, whole):
    x, y = np.meshgrid(np.arange(60.0), np.arange(50.0), indexing="ij")
    way = (x - 30) * math.cos(math.radians(angle)) + (y - 25) * math.sin(math.radians(angle))
    # It starts in the middle and runs both ways, so that none of it comes from outside the map.
    times = np.maximum(np.abs(way) - 3, 0) / speed
    times = np.ceil(times) if whole else times
    # A front that goes some cells in a window is measured from step 0, where it is known to a cell.
    cell = 1 / 50 if speed * 50 > 2 else 0
    assert 0.95 * speed <= front_speed(times, 1000, 50) <= 1.05 * speed + cell


@pytest.mark.parametrize("ratio", [1.0, 2.0, 4.0])
@pytest.mark.parametrize("rate", [0.005, 0.02])
def test_the_speed_of_a_fire_is_that_of_its_head(rate, ratio):
    (arrival,) = arrival_times(
        disc(torch.tensor([[14.0, 20.0]]), torch.tensor([3.0])),
        (40, 40),
        torch.tensor([rate]),
        torch.tensor([ratio]),
        torch.tensor([0.4]),
        horizon=1000,
    )
    assert front_speed(arrival.numpy(), 1000, 50) == pytest.approx(rate, rel=0.08)


def test_a_front_that_jumps_has_the_speed_of_the_jump():
    """As where perimeters are known every 200 steps only: 6 cells in 200 steps."""
    x = np.arange(40)[:, None] + np.zeros((1, 20))
    times = np.ceil(np.maximum(x - 4, 0) / 6) * 200
    assert front_speed(times, 1000, 50) == pytest.approx(6 / 200)
    # All within less than a window of the start: 7 cells in a window.
    times = np.where(x <= 4, 0, np.where(x <= 11, 3.0, INF))
    assert front_speed(times, 1000, 50) == pytest.approx(7 / 50)


@settings(max_examples=60, deadline=None)
@given(
    arrays(
        np.float32,
        st.tuples(st.integers(8, 12), st.integers(8, 12)),
        elements=st.sampled_from([0.0, 0.5, 3.0, 40.0, 99.0, 100.0, 150.0, INF]),
    ),
    st.integers(1, 120),
)
def test_of_any_map_the_numbers_are_finite_and_the_same_when_it_is_turned(arrival, horizon):
    found = growth(arrival, horizon)
    assert 0 <= found.start <= found.end == int((arrival <= horizon).sum())
    assert found.mean <= found.most + 1e-9
    # Within a window of a step or more, nothing goes farther than the map is long.
    assert 0 <= found.speed <= math.hypot(*arrival.shape) / found.window
    assert (found.speed == 0) == (found.start == found.end or not (arrival <= 0).any()) or (
        found.speed > 0
    )
    for turned in (arrival[::-1], arrival.T, arrival[:, ::-1].T):
        other = growth(turned, horizon)
        assert (other.start, other.end, other.most) == (found.start, found.end, found.most)
    assert not (burnt_out(arrival) & np.isfinite(arrival)).any()


def test_what_is_burnt_out_lies_within_the_first_fire():
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
    team = Team.of(WildfireConfig(num_uavs=3, altitude=(1.0, 5.0), view_angle=45.0, displacement=2))
    assert (team.uavs, team.flight) == (3, 2)
    assert team.width == pytest.approx(10)
    assert team.sweep == pytest.approx(60)
    assert team.seen == pytest.approx(300)


@pytest.mark.parametrize(
    ("changes", "enough"),
    [
        ({}, [True, True, True]),
        ({"speed": 2.1}, [False, True, True]),
        ({"most": 61.0}, [True, False, True]),
        ({"end": 901}, [True, True, False]),  # 300 at once and 60 in each of 10 steps
        ({"speed": 2.0, "most": 60.0, "end": 900}, [True, True, True]),
    ],
)
def test_what_is_compared(changes, enough):
    team = Team(uavs=3, flight=2.0, width=10.0)
    about = {
        "start": 5,
        "end": 400,
        "mean": 1.0,
        "window": 1,
        "most": 3.0,
        "since": 0,
        "speed": 0.5,
    }
    checks = comparisons(Growth(**{**about, **changes}), team, 10)
    assert [good for good, _ in checks] == enough
    if not changes:
        assert "0.5: 4 times" in checks[0][1]
        assert "3 are new: 20 times" in checks[1][1]
        assert (
            "300 can be in view at once; sweeping the others takes at least 2 of 10" in checks[2][1]
        )


@pytest.mark.parametrize(
    ("value", "text"), [(0, "0"), (0.00512, "0.00512"), (99.96, "100"), (12345.6, "12346")]
)
def test_numbers_are_short(value, text):
    assert short(value) == text
