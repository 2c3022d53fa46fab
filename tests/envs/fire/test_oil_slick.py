"""Tests fronts in a moving medium: exact solution, symmetry, the edge of the grid."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
import torch
from exact_front import exact_arrival
from torch import Tensor

from emberlink.envs.fire.generator import FireConfig, fire_seeds, load_scenario, make_fires
from emberlink.envs.fire.level_set import arrival_times, disc, ellipse_rates

GRID, HORIZON = (30, 30), 1000
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


# Number of burning cells and sum of their arrival times, computed before drift was introduced.
UNCHANGED = [
    ("paper", fire_seeds("train", 1), 141, 33533.2004),
    ("huygens", fire_seeds("test", 20), 3161, 840003.0796),
]


@pytest.mark.parametrize(("name", "seeds", "count", "total"), UNCHANGED)
def test_wildfires_do_not_change(name, seeds, count, total):
    fires = make_fires(load_scenario(name), seeds, GRID, HORIZON)
    burning = fires[fires.isfinite()].double()
    assert len(burning) == count
    assert float(burning.sum()) == pytest.approx(total, abs=0.05)


def test_two_sided_is_symmetric():
    calm = {"drift_rate": 0.0, "tide_reach": 0.0, "wind_shift": 0.0, "centre_y": 0.5}
    both, one_sided = (computed(slick(side, **calm), (31, 31)) for side in (True, False))
    torch.testing.assert_close(both.rot90(2), both, atol=0.05, rtol=0)
    assert (one_sided.rot90(2).isfinite() != one_sided.isfinite()).sum() > 10


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
