"""Tests fronts in a moving medium: exact solution, tide, and the scenario `oil_slick`."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
import torch
from burning import burning_cells
from exact_front import exact_arrival
from pydantic import ValidationError
from torch import Tensor

from emberlink.envs.fire import generator
from emberlink.envs.fire.generator import (
    FireConfig,
    fire_seeds,
    load_scenario,
    make_fires,
)
from emberlink.envs.fire.level_set import arrival_times, disc, ellipse_rates

GRID, HORIZON = (30, 30), 1000
NEW = ("drift_rate", "tide_reach", "tide_period", "tide_phase", "tide_bearing", "two_sided")
PLAIN: dict[str, Any] = {
    "head_ros": 0.003,
    "length_to_breadth": 2.0,
    "azimuth": 25.0,
    "wind_shift": 40.0,
    "centre_x": 0.5,
    "centre_y": 0.45,
    "core_radius": 4.7,
    "ring_width": 9.0,
    "drift_rate": 0.005,
    "tide_reach": 4.0,
    "tide_period": 2000.0,
    "tide_phase": 60.0,
    "tide_bearing": 115.0,
}


def slick(two_sided: bool = True, **changes: Any) -> FireConfig:
    """Returns a scenario that gives the same slick for every seed."""
    points = {key: (value, value) for key, value in {**PLAIN, **changes}.items()}
    return dataclasses.replace(load_scenario("oil_slick"), **points, two_sided=two_sided)


def computed(config: FireConfig, grid: tuple[int, int] = GRID, horizon: int = HORIZON) -> Tensor:
    return make_fires(config, fire_seeds("train", 1), grid, horizon)[0]


def expected(config: FireConfig, grid: tuple[int, int] = GRID, horizon: int = HORIZON) -> Tensor:
    """Returns the exact result of `computed`, from the support function."""
    value = {
        key: getattr(config, key)[0] * (math.pi / 180 if key in DEGREES else 1) for key in PLAIN
    }
    scale = min(grid) / 30

    def azimuth(times):
        return value["azimuth"] + value["wind_shift"] * times / 1000

    def velocity(times):
        waves = np.cos(2 * math.pi * times / value["tide_period"] + value["tide_phase"])
        strongest = math.pi * value["tide_reach"] / value["tide_period"]
        steady, tide = value["drift_rate"] * scale, strongest * scale * waves
        along, axis = azimuth(times), value["tide_bearing"]
        x = steady * np.cos(along) + tide * np.cos(axis)
        return np.stack([x, steady * np.sin(along) + tide * np.sin(axis)], -1)

    head, ratio = value["head_ros"] * scale, value["length_to_breadth"]
    rates = [float(rate) for rate in ellipse_rates(head, ratio, config.two_sided)]
    centre = [value[f"centre_{axis}"] * (side - 1) for axis, side in zip("xy", grid, strict=True)]
    radius = value["core_radius"] * scale
    return torch.from_numpy(exact_arrival(grid, centre, radius, rates, azimuth, velocity, horizon))


DEGREES = ("azimuth", "wind_shift", "tide_phase", "tide_bearing")
CASES = {
    "slick": {},
    "tide alone": {"drift_rate": 0.0, "tide_reach": 6.0, "tide_period": 1000.0},
    "steady drift": {"tide_reach": 0.0, "drift_rate": 0.01, "length_to_breadth": 3.0},
    "fire on a moving ground": {"two_sided": False, "drift_rate": 0.008},
    # Steps derived from the rates alone would equal a period and miss the tide.
    "a tide much faster than the front": {
        "tide_period": 100.0,
        "tide_reach": 0.0318,
        "head_ros": 0.001,
        "drift_rate": 0.0,
    },
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_agrees_with_the_exact_solution(case: str):
    """The grid has sixty nodes a side, sampled at 30 x 30 and at 60 x 60 cells."""
    config = slick(**CASES[case])
    for grid, overlap in ((GRID, 0.975), ((60, 60), 0.988)):
        got, want = computed(config, grid), expected(config, grid)
        a, b = got.isfinite(), want.isfinite()
        assert float((a & b).sum() / (a | b).sum()) >= overlap
        assert torch.equal(got == 0, want == 0)
        assert float((got - want)[a & b & (want > 0)].abs().mean()) / HORIZON < 0.006


def test_a_steady_drift_as_a_tensor_and_its_step():
    """The drift is ten times as fast as the front, so it limits the step."""
    start = disc(torch.tensor([[7.0, 10.0]]), torch.tensor([4.0]))
    rates = torch.tensor([0.001]), torch.tensor([1.0]), torch.tensor([0.0])
    got = arrival_times(start, (30, 21), *rates, horizon=900, drift=torch.tensor([[0.01, 0.0]]))
    front = got[0, 11:, 10]  # the head moves at 0.011 from x = 11
    want = (torch.arange(11.0, 30.0) - 11) / 0.011
    torch.testing.assert_close(front, want.masked_fill(want > 900, math.inf), atol=6, rtol=0)
    assert got[0, :3].isinf().all()  # its rear recedes at 0.009
    assert (got[0, 3:11, 10] == 0).all()


def test_a_drift_that_is_a_function_needs_a_bound():
    start = disc(torch.tensor([[7.0, 7.0]]), torch.tensor([3.0]))
    rates = torch.tensor([0.001]), torch.tensor([1.0]), torch.tensor([0.0])
    with pytest.raises(ValueError, match="max_rate is needed when drift is a function"):
        arrival_times(start, (15, 15), *rates, horizon=9, drift=lambda _: torch.zeros(1, 2))


def test_no_drift_equals_a_drift_of_zero():
    """Compares bit for bit, with fuel and turning wind."""
    start = disc(torch.tensor([[11.3, 10.0]]), torch.tensor([4.0]))
    rates = torch.tensor([0.006]), torch.tensor([2.5])
    field = torch.rand(1, 24, 24, generator=torch.Generator().manual_seed(2))
    options = {"horizon": 1000, "rate_field": field, "max_rate": 0.006}
    wind = lambda time: torch.tensor([time / 900])  # noqa: E731
    still = arrival_times(start, (24, 24), *rates, wind, **options)
    zero = arrival_times(start, (24, 24), *rates, wind, **options, drift=torch.zeros(1, 2))
    assert torch.equal(still, zero)
    assert still.isfinite().sum() > 60


def test_a_tide_of_strength_zero_equals_no_tide():
    config, seeds = load_scenario("huygens"), fire_seeds("test", 5)
    other = {"tide_period": (300, 900), "tide_phase": (-9, 9), "tide_bearing": (0, 90)}
    same = make_fires(dataclasses.replace(config, **other), seeds, GRID, 300)
    assert torch.equal(same, make_fires(config, seeds, GRID, 300))


# Number of burning cells and sum of their arrival times, computed before drift was introduced.
UNCHANGED = [
    ("paper", fire_seeds("train", 1), (30, 30), 1000, 141, 33533.2004),
    ("huygens", fire_seeds("test", 20), (30, 30), 1000, 3161, 840003.0796),
    ("huygens", fire_seeds("train", 20), (45, 30), 600, 2390, 265218.5284),
]


@pytest.mark.parametrize(("name", "seeds", "grid", "horizon", "count", "total"), UNCHANGED)
def test_wildfires_do_not_change(name, seeds, grid, horizon, count, total):
    fires = make_fires(load_scenario(name), seeds, grid, horizon)
    burning = fires[fires.isfinite()].double()
    assert len(burning) == count
    assert float(burning.sum()) == pytest.approx(total, abs=0.05)


def test_old_configurations_have_no_drift():
    for name in ("paper", "huygens"):
        values = dataclasses.asdict(load_scenario(name))
        old = {key: value for key, value in values.items() if key not in NEW}
        assert FireConfig(**old) == load_scenario(name)


def test_two_sided_by_hand():
    assert [float(rate) for rate in ellipse_rates(0.5, 4.0, two_sided=True)] == [0.5, 0.125, 0.0]


def test_two_sided_is_symmetric():
    calm = {"drift_rate": 0.0, "tide_reach": 0.0, "wind_shift": 0.0, "centre_y": 0.5}
    both, one_sided = (computed(slick(side, **calm), (31, 31)) for side in (True, False))
    torch.testing.assert_close(both.rot90(2), both, atol=0.05, rtol=0)
    assert (one_sided.rot90(2).isfinite() != one_sided.isfinite()).sum() > 10


def test_mirror():
    there = computed(slick(centre_y=0.5))
    mirrored = {key: -PLAIN[key] for key in ("azimuth", "wind_shift", "tide_bearing")}
    back = computed(slick(centre_y=0.5, **mirrored))
    torch.testing.assert_close(back.flip(1), there, atol=0.05, rtol=0)


def test_the_tide_reverses_after_half_a_period():
    there = computed(slick(tide_phase=-120.0))
    torch.testing.assert_close(computed(slick(tide_bearing=-65.0)), there, atol=0.01, rtol=0)
    assert not torch.allclose(there, computed(slick()))


def swept(period: float) -> Tensor:
    """Computes a disc of radius 3 that barely grows and moves along x by 4 cells to both sides."""
    tide = {"tide_reach": 8.0, "tide_period": period, "tide_phase": 0.0}
    still = {"head_ros": 1e-6, "length_to_breadth": 1.0, "drift_rate": 0.0, "tide_bearing": 0.0}
    middle = {"centre_x": 0.5, "centre_y": 0.5, "core_radius": 3.0}
    return computed(slick(**tide, **still, **middle), (31, 31), 2 * int(period))


@pytest.mark.parametrize("period", [400.0, 1000.0])
def test_the_area_that_a_tide_sweeps(period: float):
    """The centre is at 4 sin(2π t / period): it moves to the right first, then to the left."""
    arrival, scale = swept(period), 31 / 30
    reach, radius = 4 * scale, 3 * scale
    right, left = arrival[16:, 15], arrival[:15, 15].flip(0)
    far = ((torch.arange(1.0, 16.0) - radius) / reach).clamp_min(0)
    there = torch.asin(far.clamp_max(1)) / (2 * math.pi)
    inside = far < 0.95  # at the turn a cell is grazed at any time
    first = torch.where(far == 0, 0.0, there)[inside] * period
    torch.testing.assert_close(right[inside], first, atol=0.01 * period, rtol=0)
    second = torch.where(far == 0, 0.0, 0.5 + there)[inside] * period
    torch.testing.assert_close(left[inside], second, atol=0.01 * period, rtol=0)
    assert right[far > 1.05].isinf().all()
    assert left[far > 1.05].isinf().all()
    # No cell is added after three quarters of the first period, and none is removed.
    assert float(arrival[arrival.isfinite()].max()) < 0.78 * period
    x, y = torch.meshgrid(torch.arange(31.0) - 15, torch.arange(31.0) - 15, indexing="ij")
    away = torch.hypot((x.abs() - reach).clamp_min(0), y) - radius
    clear = away.abs() > 0.05
    assert torch.equal(arrival.isfinite()[clear], (away < 0)[clear])


def test_oil_that_leaves_the_grid_returns():
    """A slick leaves over the right edge and returns a little higher, as on a larger grid."""
    start = lambda x: disc(torch.tensor([[x, 6.0]]), torch.tensor([2.5]))  # noqa: E731
    rates = torch.tensor([1e-4]), torch.tensor([1.0]), torch.tensor([0.0])

    def drift(time: float) -> Tensor:
        return torch.tensor([[0.05 * math.cos(2 * math.pi * time / 600), 0.015]])

    options = {"horizon": 600, "drift": drift, "max_rate": 0.06}
    wide = arrival_times(start(11.0), (40, 24), *rates, **options)[0, :15]
    got = arrival_times(start(11.0), (15, 24), *rates, **options, margin=10)[0]
    torch.testing.assert_close(got, wide, atol=1, rtol=0)
    late = (wide > 300) & wide.isfinite()
    assert late[8:].sum() > 10
    without = arrival_times(start(11.0), (15, 24), *rates, **options)[0]
    assert (without.isfinite() != wide.isfinite()).sum() > 5


def test_the_margin_is_the_reach_of_the_tide():
    assert generator._margin(load_scenario("huygens"), GRID) == 0
    tide = slick(tide_reach=6.37)
    assert generator._margin(tide, GRID) == 7
    assert generator._margin(tide, (60, 90)) == 13


def lehr(minutes: float, knots: float) -> tuple[float, float]:
    """Returns length and breadth of 79,000 barrels, in cells of 500 m (Lehr et al. 1984).

    The area in m² is 2270 (Δ V)^(2/3) t^(1/2) + 40 (Δ V)^(1/3) W^(4/3) t, with V in barrels, t in
    minutes, W in knots; its first part is a circle, whose diameter is the breadth.
    """
    size = (79_000 * (1025 - 870) / 870) ** (1 / 3)
    calm = 2270 * size**2 * math.sqrt(minutes)
    wind = 40 * size * knots ** (4 / 3) * minutes
    breadth = math.sqrt(calm * 4 / math.pi)
    return (calm + wind) * 4 / math.pi / breadth / 500, breadth / 500


def test_values_equal_those_of_the_sources():
    config, episode = load_scenario("oil_slick"), 12.42 * 60 / 2
    rounded = {"core_radius": [], "head_ros": [], "length_to_breadth": [], "drift_rate": []}
    for age in (120, 180):
        for knots in (4, 8):
            start, end = lehr(age, knots), lehr(age + episode, knots)
            radius = math.sqrt(math.prod(start)) / 2
            along, across = (side / 2 - radius for side in end)
            rounded["core_radius"].append(round(radius, 1))
            rounded["head_ros"].append(round(along / 1000, 4))
            rounded["length_to_breadth"].append(round(along / across, 1))
            metres = 0.03 * knots * 1852 / 3600 * episode * 60 / 1000
            rounded["drift_rate"].append(round(metres / 500, 4))
    for key, values in rounded.items():
        assert getattr(config, key) == (min(values), max(values)), key
    # Between two turns of the tide, u cos(2π t / T) moves the oil by u T / π.
    metres = [speed * 2 * episode * 60 / math.pi for speed in (0.05, 0.15)]
    assert config.tide_reach == tuple(round(value / 500, 1) for value in metres)
    assert config.tide_period == (2000, 2000)


@pytest.fixture(scope="module")
def test_fires() -> Tensor:
    return make_fires(load_scenario("oil_slick"), fire_seeds("test", 100), GRID, HORIZON)


@pytest.mark.heavy
def test_slicks_are_of_the_size_of_the_fires(test_fires: Tensor):
    count = burning_cells(test_fires, HORIZON)
    assert ((count[:, 0] >= 55) & (count[:, 0] <= 90)).all()
    assert ((count[:, -1] >= 110) & (count[:, -1] <= 230)).all()
    assert (count.diff() >= 0).all()
    assert len(test_fires.flatten(1).unique(dim=0)) == 100
    edge = torch.cat([test_fires[:, [0, -1]].flatten(1), test_fires[:, :, [0, -1]].flatten(1)], 1)
    assert (edge > 0).all()


@pytest.mark.slow
def test_all_of_the_disc_is_oil(test_fires: Tensor):
    """A ring as wide as its radius has no hole."""
    x, y = torch.meshgrid(torch.arange(30.0), torch.arange(30.0), indexing="ij")
    for arrival in test_fires[:10]:
        oil = (arrival == 0).nonzero().float()
        cx, cy = (oil.amax(0) + oil.amin(0)) / 2
        assert (arrival[torch.hypot(x - cx, y - cy) < 3.5] == 0).all()


@pytest.mark.slow
def test_a_slick_depends_on_its_seed_only(test_fires: Tensor):
    config, seeds = load_scenario("oil_slick"), fire_seeds("test", 100)
    assert torch.equal(make_fires(config, seeds[37:39], GRID, HORIZON), test_fires[37:39])
    short = make_fires(config, seeds[:3], GRID, 350)
    assert torch.equal(short, test_fires[:3].masked_fill(test_fires[:3] > 350, math.inf))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"tide_reach": (0, 30.1)}, "tide_reach"),
        ({"tide_period": (50, 200)}, "tide_period"),
        ({"drift_rate": (-0.1, 0)}, "drift_rate"),
        ({"two_sided": 1}, "two_sided"),
    ],
)
def test_invalid_values(changes: dict, message: str):
    with pytest.raises(ValidationError, match=message):
        dataclasses.replace(load_scenario("oil_slick"), **changes)
