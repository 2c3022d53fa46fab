"""Computes the velocity of the medium that carries a front: a steady drift and a tide."""

import math
from collections.abc import Callable, Mapping

import torch
from torch import Tensor

_STEPS_PER_PERIOD = 32


def tide_speed(tide_reach: float, tide_period: float) -> float:
    """Returns the greatest speed of a tide, cells per step."""
    return math.pi * tide_reach / tide_period


def max_time_step(tide_period: float) -> float:
    """Returns the longest time step, in steps, that still resolves a tide."""
    return tide_period / _STEPS_PER_PERIOD


def current(
    draw: Mapping[str, Tensor], azimuth: Callable[[float], Tensor], scale: float
) -> Callable[[float], Tensor]:
    """Returns the velocity of the medium as a function of time.

    u(t) = `drift_rate` · w(t) + s · cos(2π t / `tide_period` + `tide_phase`) · v, with w the unit
    vector along the azimuth, v that along `tide_bearing` and s = π `tide_reach` / `tide_period`.

    Args:
        draw: the fields of a `FireConfig` named above, float [fires] each, in its units.
        azimuth: from the time in steps to radians [fires].
        scale: cells of the grid per cell of the scenario.

    Returns:
        From the time in steps to cells of the grid per step, [fires, 2].
    """
    steady = draw["drift_rate"] * scale
    strength = math.pi * draw["tide_reach"] / draw["tide_period"] * scale
    phase, bearing = draw["tide_phase"].deg2rad(), draw["tide_bearing"].deg2rad()

    def velocity(time: float) -> Tensor:
        along = azimuth(time)
        tide = strength * torch.cos(2 * math.pi * time / draw["tide_period"] + phase)
        x = steady * along.cos() + tide * bearing.cos()
        return torch.stack([x, steady * along.sin() + tide * bearing.sin()], 1)

    return velocity
