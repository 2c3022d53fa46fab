"""Measures the growth of a fire, and compares it with the capability of a team of UAVs."""

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, label

from emberlink.envs.config import WildfireConfig
from emberlink.envs.world.sensor import view_radius

Arrival = NDArray[np.float32]
"""[X, Y], steps: 0 burns from the start, inf never burns"""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Growth:
    """The number of burning cells over an episode."""

    start: int
    """cells burning at step 0"""
    end: int
    """cells burning at the last step"""
    mean: float
    """new cells per step, over the episode"""
    window: int
    """steps over which `maximum` is taken"""
    maximum: float
    """new cells per step, in the window of fastest growth"""
    since: int
    """step at which that window begins"""


def growth(arrival: Arrival, horizon: int) -> Growth:
    """Returns the growth of a fire.

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
        maximum=float(gained[since]) / window,
        since=since,
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class TeamCapability:
    """Upper bounds of the view of a team of UAVs."""

    num_uavs: int
    flight: float
    """maximum displacement of a UAV in a step along an axis, cells"""
    width: float
    """side of the square that a UAV sees from full altitude, cells"""

    @classmethod
    def of(cls, config: WildfireConfig) -> "TeamCapability":
        """Returns the bounds of an environment's team."""
        width = 2 * view_radius(config.altitude[1], config.view_angle)
        return cls(num_uavs=config.num_uavs, flight=config.displacement, width=width)

    @property
    def uncovered(self) -> float:
        """Cells that come into view in a step, if no two UAVs see the same cells."""
        return self.num_uavs * self.width * self.flight

    @property
    def seen(self) -> float:
        """Cells that all UAVs see at once."""
        return self.num_uavs * self.width**2


def comparisons(fire: Growth, team: TeamCapability, horizon: int) -> list[tuple[bool, str]]:
    """Returns whether each bound of the team suffices for the fire, and a text with numbers."""
    steps = math.ceil(max(0.0, fire.end - team.seen) / team.uncovered)
    ratio = f": {short(team.uncovered / fire.maximum)} times as many" if fire.maximum > 0 else ""
    return [
        (
            fire.maximum <= team.uncovered,
            f"the team can uncover {short(team.uncovered)} cells/step, "
            f"{short(fire.maximum)} start to burn{ratio}",
        ),
        (
            steps <= horizon,
            f"of {fire.end} cells at the end {short(min(fire.end, team.seen))} can be in view at "
            f"once; uncovering the others takes at least {steps} of {horizon} steps",
        ),
    ]


def short(value: float) -> str:
    """Returns a number with three digits, or all digits of a larger whole number."""
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def burnt_out(arrival: Arrival) -> NDArray[np.bool_]:
    """Returns the mask of cells that burnt before step 0, [X, Y].

    These never burn, most cells around them burn at step 0, and they do not touch the map's edge.
    """
    parts, count = label(np.isinf(arrival))  # pyright: ignore[reportGeneralTypeIssues]
    inside = np.zeros(arrival.shape, bool)
    for number in range(1, count + 1):
        part = parts == number
        around = binary_dilation(part, np.ones((3, 3))) & ~part
        edge = part[[0, -1]].any() or part[:, [0, -1]].any()
        inside |= part & (not edge and bool((arrival[around] <= 0).mean() > 0.5))
    return inside
