"""A scripted policy that searches the whole map in strips."""

import math
from itertools import pairwise

import torch
from tensordict import TensorDictBase
from torch import Tensor

from emberlink.envs import keys
from emberlink.envs.wildfire import WildfireEnv
from emberlink.envs.world import motion
from emberlink.policies.scripted.base import Scripted

_REACHED = 1e-3  # cells; distance to a waypoint that counts as 0, above the float32 rounding error
_SLACK = 0.01  # cells; margin of the view, above the distance by which a waypoint may be missed


class Lawnmower(Scripted):
    """Flies back and forth over strips of the map that are as wide as the view.

    All UAVs fly at the `search_altitude`. The map is divided into strips, and each strip into
    waypoints from which all of it is seen, however long a step is. The waypoints of all strips form
    one path, in boustrophedon order, and each UAV gets an equal part of it. A UAV flies to the
    first waypoint of its part, along the part to the last, and back. If there are more UAVs than
    waypoints, some share a part.

    The number of flights between waypoints that a UAV has completed is carried in the TensorDict
    under "_lawnmower_flight".
    """

    FLIGHT = "_lawnmower_flight"
    path: Tensor
    """float32 [waypoints, 2], cells"""
    first: Tensor
    """int64 [n]: the first waypoint of each UAV's part"""
    period: Tensor
    """int64 [n]: flights from the first waypoint to the last and back"""

    def __init__(self, env: WildfireEnv):
        super().__init__(env)
        self.out_keys.append(self.FLIGHT)
        path = search_path(self.world.grid, self.radius)
        length, uavs = len(path), self.world.num_uavs
        first = torch.arange(uavs) * length // uavs
        last = (torch.arange(1, uavs + 1) * length // uavs - 1).maximum(first)
        self.register_buffer("path", path.to(env.device))
        self.register_buffer("first", first.to(env.device))
        self.register_buffer("period", (2 * (last - first)).clamp(min=1).to(env.device))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        position = tensordict.get(keys.POSITION)
        zero = torch.zeros_like(tensordict.get(keys.NEW_FIRE))
        flight = self.carried(tensordict, self.FLIGHT, zero)
        flight = flight + (motion.distance(position, self._waypoint(flight)) < _REACHED)
        tensordict.set(self.FLIGHT, flight)
        return self.fly(tensordict, self._waypoint(flight))

    def _waypoint(self, flight: Tensor) -> Tensor:
        """Returns the waypoint at the end of each UAV's flight, float32 [num_envs, n, 3], cells."""
        phase = flight % self.period
        return self.above(self.path[self.first + torch.minimum(phase, self.period - phase)])


def search_path(grid: tuple[int, int], radius: float) -> Tensor:
    """Returns waypoints from which all cells within `radius` are seen, float32 [waypoints, 2]."""
    width = max(1, math.floor(2 * (radius - _SLACK)) + 1)
    across, along = _centres(grid[0], width), _centres(grid[1], width)
    strips = [
        [(x, y) for y in (along if strip % 2 == 0 else along[::-1])]
        for strip, x in enumerate(across)
    ]
    return torch.tensor(strips).flatten(0, 1)


def _centres(side: int, width: int) -> list[float]:
    """Divides `side` cells into equal pieces of at most `width` cells and returns their centres."""
    pieces = math.ceil(side / width)
    edges = [piece * side // pieces for piece in range(pieces + 1)]
    return [(low + high - 1) / 2 for low, high in pairwise(edges)]
