"""Compares the fronts of the heat equation with independently computed waves."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from combustion_wave import profile, wave

from emberlink.envs.fire.generator import load_scenario
from emberlink.envs.fire.reaction import (
    ReactionConfig,
    advance,
    arrhenius,
    reaction_fires,
    time_step,
)

CONFIG = load_scenario("reaction")
assert isinstance(CONFIG, ReactionConfig)


def plane_speed(wind: float, spacing: float) -> float:
    """Returns the speed of a plane front of the scenario, wind along its normal, m/s."""
    x = torch.arange(int(120 / spacing), dtype=torch.float64)[None, :, None] * spacing
    x = x.expand(1, -1, 3)
    rise, fuel = 900.0 * ((x > 15) & (x < 25)), (x > 16).double()
    step = time_step(dataclasses.replace(CONFIG, wind_speed=(0.0, abs(wind))), spacing)
    air = torch.tensor([[wind, 0.0]], dtype=torch.float64)
    heat, diffusivity = arrhenius(CONFIG), CONFIG.diffusivity
    places = [25.0]
    while places[-1] < 100:
        rise, fuel = advance(rise, fuel, heat, (air, air), diffusivity, spacing, step)
        line = rise[0, :, 1]
        last = int((line > 300).nonzero()[-1])
        above, below = line[last].item(), line[last + 1].item()
        places.append((last + (above - 300) / (above - below)) * spacing)
    steady = [place for place in places if place > 70]
    return float(np.polyfit(step * np.arange(len(steady)), steady, 1)[0])


@pytest.mark.parametrize(("wind", "low", "high"), [(-0.03, 0.05, 0.3), (0.05, 0.15, 0.35)])
def test_a_plane_front_moves_at_the_speed_of_the_travelling_wave(wind, low, high):
    """On the nodes of 30 x 30 cells; the error is of second order."""
    speed, _ = wave(CONFIG, wind, low, high)
    coarse, fine = (plane_speed(wind, spacing) / speed - 1 for spacing in (1.5, 0.75))
    assert abs(fine) < 0.01
    assert 3 < coarse / fine < 5.5


def point(**changes: float) -> ReactionConfig:
    """Returns the scenario with single values instead of ranges."""
    names = ("azimuth", "wind_shift", "centre_x", "centre_y", "core_radius", "ring_width")
    values = {"wind_speed": 0.0, **dict.fromkeys(names, 0.0), **changes}
    ranges = {k: (v, v) for k, v in values.items() if k in (*names, "wind_speed")}
    return dataclasses.replace(
        CONFIG, **{k: v for k, v in changes.items() if k not in ranges}, **ranges
    )


SEED = torch.tensor([0])


@pytest.mark.parametrize("wind", [0.0, 0.1])
def test_a_fire_arrives_and_burns_out_like_the_travelling_wave(wind: float):
    """The front is part of a circle of 120 to 180 m, so it is nearly plane."""
    config = point(
        cell_size=7.0,
        step_duration=1.0,
        wind_speed=wind,
        centre_y=0.5,
        core_radius=12.0,
        ring_width=2.0,
    )
    speed, duration = wave(CONFIG, wind, 0.1 + wind, 0.4 + wind)
    arrival, gone = reaction_fires(config, SEED, (30, 30), 600)[0, :, 17:25, 14]
    assert (7 * 7.0) / float(arrival[-1] - arrival[0]) == pytest.approx(speed, rel=0.03)
    assert (gone - arrival).mean().item() == pytest.approx(duration, rel=0.03)


def test_a_fire_is_as_fast_along_a_diagonal_as_along_an_axis():
    config = point(centre_x=0.5, centre_y=0.5, core_radius=3.0, ring_width=2.0)
    arrival = reaction_fires(config, SEED, (31, 31), 5000)[0, 0]
    axis, diagonal = arrival[18:30, 15].numpy(), arrival.diagonal()[19:24].numpy()
    at = np.interp(np.arange(4, 9) * math.sqrt(2), np.arange(3, 15), axis)
    assert np.abs((diagonal - at) / at).max() < 0.01
    for turned in (arrival.flip(0), arrival.flip(1), arrival.T):
        assert torch.allclose(turned, arrival, rtol=1e-4)


@pytest.mark.parametrize(("wind", "known"), [(0.05, True), (0.06, False)])
def test_a_fire_goes_out_against_the_same_wind_as_the_wave(wind: float, known: bool):
    speeds = np.linspace(0.03, 0.13, 21)
    assert any(profile(CONFIG, -wind, speed)[1] < 0 for speed in speeds) == known
    config = point(
        wind_speed=wind, azimuth=180.0, centre_x=0.2, centre_y=0.5, core_radius=6.0, ring_width=3.0
    )
    arrival, gone = reaction_fires(config, SEED, (30, 30), 6000)[0, :, :, 14]
    assert bool(arrival[17:].isfinite().any()) == known
    if not known:
        assert torch.equal(gone.isfinite(), arrival.isfinite())
