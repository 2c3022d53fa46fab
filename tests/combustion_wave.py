"""Computes the travelling waves of the heat equation with fuel, by shooting.

In the frame of a wave of speed c, T - Ta = u(x - c t) and S = s(x - c t) satisfy

    k u'' + (c - v) u' + A (s exp(-B/u) - C u) = 0,  c s' = C_S s exp(-B/u).

Far ahead u tends to 0 and s to 1. From there the equations are integrated backwards. If c is not
the speed of a wave, u behind the fire grows without limit or becomes negative; the speed lies
between one of each.
"""

import math

import numpy as np
from scipy.integrate import solve_ivp

AHEAD, BEHIND, LENGTH = 1e-3, 5000.0, 2000.0


def profile(config, wind: float, speed: float):
    """Returns the solution behind a point far ahead, and whether it ends above or below 0."""
    k, loss = config.diffusivity, config.heating * config.cooling
    relative = speed - wind
    decay = (-relative - math.sqrt(relative**2 + 4 * k * loss)) / (2 * k)

    def slope(_, y):
        u, du, s = y
        burnt = s * math.exp(-config.activation / u) if u > 1e-2 else 0.0
        heat = config.heating * burnt - loss * u
        return -du, (relative * du + heat) / k, -config.fuel_loss * burnt / speed

    def below(_, y):
        return y[0]

    def above(_, y):
        return y[0] - BEHIND

    below.terminal = above.terminal = True
    start = (AHEAD, decay * AHEAD, 1.0)
    solution = solve_ivp(
        slope, (0, LENGTH), start, events=(below, above), rtol=1e-8, atol=1e-9, method="LSODA"
    )
    return solution, 1 if len(solution.t_events[1]) else -1


def wave(config, wind: float, low: float, high: float) -> tuple[float, float]:
    """Returns the speed of a wave in m/s, and how long a point in it burns, s.

    Args:
        config: a `ReactionConfig`.
        wind: towards the unburnt side, m/s.
        low, high: speeds below and above the fast wave's.
    """
    assert (profile(config, wind, low)[1], profile(config, wind, high)[1]) == (-1, 1)
    for _ in range(30):
        middle = (low + high) / 2
        if profile(config, wind, middle)[1] < 0:
            low = middle
        else:
            high = middle
    solution, _ = profile(config, wind, high)
    place, (u, _, s) = solution.t, solution.y
    hot = config.ignition - config.ambient
    begins = np.interp(hot, u[: u.argmax() + 1], place[: u.argmax() + 1])
    ends = np.interp(-config.residual_fuel, -s, place)
    assert np.interp(ends, place, u) > hot  # the fuel ends first
    return high, float(ends - begins) / high
