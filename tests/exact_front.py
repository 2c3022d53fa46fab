"""Computes the exact front of a drifting disc that grows by an elliptical wavelet.

The grown disc is convex, so it is an intersection of half planes. Relative to the drifting centre,
x·n <= h(n, t) = radius + integral of F(n, s) ds for every normal n, where F is the wavelet's own
support function. A point is reached at the first t at which all inequalities hold.
"""

import math

import numpy as np

STEPS, NORMALS = 320, 180


def support(normal, a, b, c, azimuth):
    """Returns the speed of a straight front along its normal: the wavelet's support function."""
    along = np.cos(normal - azimuth)
    return c * along + np.sqrt((a * along) ** 2 + (b * np.sin(normal - azimuth)) ** 2)


def running(values, times):
    """Integrates sampled values from the first time to each of the times."""
    steps = (values[1:] + values[:-1]) / 2 * np.diff(times)[:, None]
    return np.concatenate([np.zeros_like(values[:1]), np.cumsum(steps, 0)])


def exact_arrival(
    grid: tuple[int, int],
    centre,
    radius: float,
    rates,
    azimuth,
    velocity,
    horizon: float,
    steps: int = STEPS,
) -> np.ndarray:
    """Returns the arrival times at the centres of the cells, [X, Y], steps.

    Args:
        rates: (a, b, c) of the wavelet.
        azimuth: from times [T] to radians [T].
        velocity: from times [T] to the drift [T, 2].
    """
    times = np.linspace(0, horizon, steps + 1)
    normals = np.linspace(0, 2 * math.pi, NORMALS, endpoint=False)
    reach = radius + running(support(normals, *rates, azimuth(times)[:, None]), times)
    moved = np.asarray(centre) + running(velocity(times), times)
    points = np.stack(np.meshgrid(*(np.arange(side) for side in grid), indexing="ij"), -1)
    unit = np.stack([np.cos(normals), np.sin(normals)])
    along = points @ unit
    arrival, before = np.full(grid, math.inf), np.full(grid, math.inf)
    for k, time in enumerate(times):
        outside = (along - (moved[k] @ unit + reach[k])).max(-1)
        new = (outside <= 0) & np.isinf(arrival)
        # Cells inside the initial disc have no earlier sample. The others were reached in between.
        part = before[new] / (before[new] - outside[new]) if k else 0.0
        arrival[new] = time if k == 0 else times[k - 1] + part * (time - times[k - 1])
        before = outside
    return arrival
