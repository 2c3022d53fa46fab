"""How fast a fire grows and advances, and whether a team of UAVs can keep up with it."""

import dataclasses
import math
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, distance_transform_edt, label

from emberlink.envs.config import WildfireConfig
from emberlink.envs.world.sensor import view_radius

_KNOWN = 3
"""cells from the first fire and the edge from which on a speed counts, if the fire is so large"""

_AROUND = 2
"""cells around the nearest one that are tried too: the nearest need not lie across the front"""

Arrival = NDArray[np.float32]
"""[X, Y], steps: 0 burns from the start, inf never burns"""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Growth:
    """A fire in numbers."""

    start: int
    """cells burning at step 0"""
    end: int
    """cells burning at the last step"""
    mean: float
    """new cells per step, over the episode"""
    window: int
    """steps over which `most` and `speed` are taken"""
    most: float
    """new cells per step, in the window with the most"""
    since: int
    """step at which that window begins"""
    speed: float
    """fastest advance of the front, cells per step; 0 where it stands still"""


def growth(arrival: Arrival, horizon: int) -> Growth:
    """Growth and speed of a fire.

    Args:
        arrival: [X, Y], steps.
        horizon: steps of the episode.
    """
    window = max(1, horizon // 20)
    times = np.sort(arrival, axis=None)
    burning = np.searchsorted(times, np.arange(horizon + 1), side="right")
    gained = burning[window:] - burning[:-window]
    since = int(gained.argmax())
    return Growth(
        start=int(burning[0]),
        end=int(burning[-1]),
        mean=float(burning[-1] - burning[0]) / horizon,
        window=window,
        most=float(gained[since]) / window,
        since=since,
        speed=front_speed(arrival, horizon, window),
    )


def front_speed(arrival: Arrival, horizon: int, window: int) -> float:
    """The fastest advance of a front, cells per step; at most a cell per window too fast.

    How fast the front came to a cell is the distance to a cell that it reached at least `window`
    steps before, divided by the time between; of several such cells the one with the smallest
    quotient lies across the front and counts. Where the front was at step 0 is known only to a
    cell, and what lies outside the map not at all: cells near the first fire or the edge count
    only if the fire has no others.

    Args:
        arrival: [X, Y], steps; cells that are reached after `horizon` do not count.
        horizon: steps of the episode.
        window: steps.

    Returns:
        The largest over all cells; 0 where no cell is reached after step 0.
    """
    times = np.where(arrival <= horizon, arrival, np.inf).astype(np.float64)
    begin = max(0.0, float(times.min()))
    later = np.isfinite(times) & (times > begin)
    if not later.any():
        return 0.0
    away: NDArray[np.float64] = np.asarray(distance_transform_edt(times > begin))
    passed = np.maximum(np.where(later, times - begin, np.inf), window)
    speeds = np.minimum(away / passed, _from_nearest_cells(times, begin, horizon, window))
    known = np.minimum(away, _to_edge(times.shape))
    least = next(d for d in (_KNOWN, _KNOWN - 1, 1, 0) if (later & (known > d)).any())
    return float(speeds[later & (known > least)].max())


def _to_edge(shape: tuple[int, ...]) -> NDArray[np.int_]:
    """Cells from each cell to the outside of the map, 1 at the edge, [X, Y]."""
    x, y = (np.minimum(np.arange(1, n + 1), np.arange(n, 0, -1)) for n in shape)
    return np.minimum.outer(x, y)


def _from_nearest_cells(
    times: NDArray[np.float64], begin: float, horizon: int, window: int
) -> NDArray[np.float64]:
    """Smallest quotient over cells reached a window before, the nearest and those around it."""
    best = np.full(times.shape, np.inf)
    steps = list(product(range(-_AROUND, _AROUND + 1), repeat=2))
    for now in np.arange(begin, horizon - window + 0.5, window / 2):
        come = (times >= now + window) & (times < now + 1.5 * window)
        if come.any():
            nearest: Any = distance_transform_edt(
                times > now, return_distances=False, return_indices=True
            )
            own, back = np.argwhere(come), nearest[:, come].T
            for step in steps:
                other = np.clip(back + step, 0, np.array(times.shape) - 1)
                passed = times[come] - times[tuple(other.T)]
                quotient = np.hypot(*(own - other).T) / np.maximum(passed, window)
                best[come] = np.where(
                    passed >= window, np.minimum(best[come], quotient), best[come]
                )
    return best


@dataclasses.dataclass(frozen=True, kw_only=True)
class Team:
    """What a team of UAVs can do at best."""

    uavs: int
    flight: float
    """cells that a UAV flies in a step, along an axis"""
    width: float
    """side of the square that a UAV sees from full altitude, cells"""

    @classmethod
    def of(cls, config: WildfireConfig) -> "Team":
        """The team of an environment."""
        wide = 2 * view_radius(config.altitude[1], config.view_angle)
        return cls(uavs=config.num_uavs, flight=config.displacement, width=wide)

    @property
    def sweep(self) -> float:
        """Cells that come into view in a step, if no UAV ever looks where another did."""
        return self.uavs * self.width * self.flight

    @property
    def seen(self) -> float:
        """Cells that all see at once."""
        return self.uavs * self.width**2


def comparisons(fire: Growth, team: Team, horizon: int) -> list[tuple[bool, str]]:
    """What the team can do beside what the fire does: whether it is enough, and the numbers."""
    steps = math.ceil(max(0.0, fire.end - team.seen) / team.sweep)
    return [
        (
            fire.speed <= team.flight,
            f"a UAV flies {short(team.flight)} cells/step, the front advances {short(fire.speed)}"
            f"{_ratio(team.flight, fire.speed)}",
        ),
        (
            fire.most <= team.sweep,
            f"the team sweeps {short(team.sweep)} cells/step, {short(fire.most)} are new"
            f"{_ratio(team.sweep, fire.most)}",
        ),
        (
            steps <= horizon,
            f"of {fire.end} cells at the end {short(min(fire.end, team.seen))} can be in view at "
            f"once; sweeping the others takes at least {steps} of {horizon} steps",
        ),
    ]


def _ratio(ours: float, theirs: float) -> str:
    return f": {short(ours / theirs)} times as much" if theirs > 0 else ""


def short(value: float) -> str:
    """Three digits, or all of a whole number that has more."""
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def burnt_out(arrival: Arrival) -> NDArray[np.bool_]:
    """Cells within the first fire that never burn: what burnt before step 0, [X, Y].

    Most cells around them burn at step 0, and they do not touch the edge of the map.
    """
    parts, count = label(np.isinf(arrival))  # pyright: ignore[reportGeneralTypeIssues]
    inside = np.zeros(arrival.shape, bool)
    for number in range(1, count + 1):
        part = parts == number
        around = binary_dilation(part, np.ones((3, 3))) & ~part
        edge = part[[0, -1]].any() or part[:, [0, -1]].any()
        inside |= part & (not edge and bool((arrival[around] <= 0).mean() > 0.5))
    return inside
