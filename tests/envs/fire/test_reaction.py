"""Tests the fires of the heat equation: step 0, seeds, a scalar time step, limits."""

import dataclasses
import math

import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from emberlink.envs.fire.generator import fire_seeds, load_scenario
from emberlink.envs.fire.reaction import (
    ReactionConfig,
    advance,
    arrhenius,
    reaction_fires,
    time_step,
)

GRID, HORIZON = (30, 30), 1000
CONFIG = load_scenario("reaction")
assert isinstance(CONFIG, ReactionConfig)


def test_step_zero_is_a_ring_by_hand():
    config = dataclasses.replace(
        CONFIG,
        centre_x=(0.5, 0.5),
        centre_y=(0.4, 0.4),
        core_radius=(5.2, 5.2),
        ring_width=(2.5, 2.5),
    )
    arrival, gone = reaction_fires(config, torch.tensor([7]), (31, 31), 300)[0]
    x, y = torch.meshgrid(torch.arange(31.0), torch.arange(31.0), indexing="ij")
    away = torch.hypot(x - 15, y - 12)
    scale = 31 / 30
    ring = (away <= 5.2 * scale) & (away >= 2.7 * scale)
    assert torch.equal(arrival == 0, ring)
    assert arrival[away < 2.7 * scale].isinf().all()  # burnt out, although it gets hot
    assert gone[away < 2.7 * scale].isinf().all()


def test_times():
    fires = reaction_fires(CONFIG, fire_seeds("test", 12), GRID, HORIZON)
    arrival, gone = fires.unbind(1)
    assert fires.dtype == torch.float32
    assert fires.shape == (12, 2, *GRID)
    assert not fires.isnan().any()
    assert arrival.min() == 0
    assert fires[fires.isfinite()].max() <= HORIZON
    assert (gone > arrival)[arrival.isfinite()].all()
    assert gone[arrival.isinf()].isinf().all()
    start, end = ((arrival <= step).sum((1, 2)) for step in (0, HORIZON))
    assert start.min() >= 60
    assert start.max() <= 90
    assert (end - start).min() > 60
    burning = ((arrival <= HORIZON) & (gone > HORIZON)).sum((1, 2))
    assert (burning < end).all()
    assert burning.min() > 40


@pytest.mark.parametrize(("azimuth", "axis", "sign"), [(0, 0, 1), (90, 1, 1), (180, 0, -1)])
def test_the_head_runs_with_the_wind(azimuth: float, axis: int, sign: int):
    still = {"wind_shift": (0.0, 0.0), "centre_x": (0.5, 0.5), "centre_y": (0.5, 0.5)}
    config = dataclasses.replace(CONFIG, azimuth=(float(azimuth),) * 2, **still)
    arrival = reaction_fires(config, torch.tensor([1]), GRID, HORIZON)[0, 0]
    at_start, at_end = ((arrival <= step).nonzero().float().mean(0) for step in (0, HORIZON))
    moved = at_end - at_start
    assert sign * float(moved[axis]) > 1
    assert abs(float(moved[1 - axis])) < 0.1


def scalar_step(
    rise: list, fuel: list, wind: tuple[float, float], spacing: float, step: float
) -> tuple[list, list]:
    """Returns temperature rise and fuel after a time step of Heun's method, node by node."""
    wide, high = len(rise), len(rise[0])

    def rates(u: list, s: list) -> tuple[list, list]:
        du, ds = ([[0.0] * high for _ in range(wide)] for _ in range(2))
        for i in range(wide):
            for j in range(high):
                west, east = u[max(i - 1, 0)][j], u[min(i + 1, wide - 1)][j]
                south, north = u[i][max(j - 1, 0)], u[i][min(j + 1, high - 1)]
                across = [(wind[0], west, east), (wind[1], south, north)]
                for speed, before, after in across:
                    k = max(CONFIG.diffusivity, abs(speed) * spacing / 2)
                    du[i][j] += k * (before - 2 * u[i][j] + after) / spacing**2
                    du[i][j] -= speed * (after - before) / (2 * spacing)
                burnt = s[i][j] * math.exp(-CONFIG.activation / u[i][j]) if u[i][j] > 0 else 0.0
                du[i][j] += CONFIG.heating * (burnt - CONFIG.cooling * u[i][j])
                ds[i][j] = -CONFIG.fuel_loss * burnt
        return du, ds

    def moved(a: list, da: list) -> list:
        return [
            [x + step * d for x, d in zip(*row, strict=True)] for row in zip(a, da, strict=True)
        ]

    def mean(a: list, b: list) -> list:
        return [[(x + y) / 2 for x, y in zip(*row, strict=True)] for row in zip(a, b, strict=True)]

    first = rates(rise, fuel)
    middle = moved(rise, first[0]), moved(fuel, first[1])
    second = rates(*middle)
    return mean(rise, moved(middle[0], second[0])), mean(fuel, moved(middle[1], second[1]))


@pytest.mark.parametrize("wind", [(0.1, -0.05), (-3.0, 1.0)])
def test_a_time_step_is_that_of_a_scalar_computation(wind: tuple[float, float]):
    """With 3 m/s the wind carries heat too far for central differences."""
    generator = torch.Generator().manual_seed(1)
    rise, fuel = torch.rand(2, 5, 4, dtype=torch.float64, generator=generator)
    rise = 1000 * rise
    rise[2, 2] = 0
    air = torch.tensor([wind], dtype=torch.float64)
    made = advance(
        rise[None], fuel[None], arrhenius(CONFIG), (air, air), CONFIG.diffusivity, 0.5, 0.05
    )
    by_hand = scalar_step(rise.tolist(), fuel.tolist(), wind, 0.5, 0.05)
    for field, expected in zip(made, by_hand, strict=True):
        assert torch.allclose(field[0], torch.tensor(expected, dtype=torch.float64), rtol=1e-12)


def spread_out(low: float, high: float) -> st.SearchStrategy[float]:
    """Returns numbers whose logarithms are spread evenly."""
    return st.floats(math.log(low), math.log(high)).map(lambda x: min(max(math.exp(x), low), high))


@st.composite
def valid_configs(draw: st.DrawFn) -> ReactionConfig:
    """Returns configurations with any valid coefficients."""
    heating, activation = draw(spread_out(1e-2, 1e5)), draw(spread_out(1, 1e5))
    fuel_loss, k = draw(spread_out(1e-5, 100)), draw(spread_out(1e-4, 1e4))
    cooling = draw(st.one_of(st.just(0.0), spread_out(1e-8, 1)))
    inertia = math.exp(min(activation * fuel_loss / heating, 20)) / fuel_loss
    cell_size = draw(st.floats(0.101, 4.99)) * math.sqrt(k * inertia)
    assume(cell_size <= 1000)
    rates = fuel_loss, 4 * math.exp(-2) * heating / activation, heating * cooling
    wind = draw(st.one_of(st.just(0.0), spread_out(1e-3, 10)))
    ambient = draw(st.floats(200, 2990))
    ignition = draw(st.floats(ambient + 1, 2999))
    return dataclasses.replace(
        CONFIG,
        cell_size=cell_size,
        step_duration=min(draw(st.floats(0.01, 0.999)) / max(*rates, wind / cell_size), 3600),
        diffusivity=k,
        heating=heating,
        activation=activation,
        cooling=cooling,
        fuel_loss=fuel_loss,
        ambient=ambient,
        ignition=ignition,
        initial=draw(st.floats(ignition, 3000)),
        residual_fuel=draw(st.floats(0.01, 0.99)),
        wind_speed=(0.0, wind),
    )


@settings(max_examples=40, deadline=None, derandomize=True, database=None)
@given(valid_configs(), st.floats(0.05, 5), st.integers(0, 2**31))
def test_temperature_and_fuel_stay_positive_and_bounded(
    config: ReactionConfig, part: float, seed: int
):
    """Neighbours heat a node to at most their temperature, and its fuel heats it at rate A."""
    generator = torch.Generator().manual_seed(seed)
    rise, fuel = torch.rand(2, 1, 9, 8, generator=generator)
    rise, spacing = rise.round() * (config.initial - config.ambient), part * config.cell_size
    step = time_step(config, spacing)
    wind = config.wind_speed[1] * torch.tensor([[0.6, -0.8]])
    limit = rise.max() * 1.001
    for _ in range(20):
        rise, fuel = advance(
            rise, fuel, arrhenius(config), (wind, wind), config.diffusivity, spacing, step
        )
        limit = limit + config.heating * step
        assert (rise >= -1e-6 * limit).all()  # by rounding
        assert (rise <= limit).all()
        assert (fuel >= 0).all()
        assert (fuel <= 1).all()
