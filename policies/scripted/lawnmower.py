"""A scripted search of the whole map, strip by strip."""

import math
from itertools import pairwise

import torch
from tensordict import TensorDictBase
from torch import Tensor

from emberlink.envs import keys
from emberlink.envs.wildfire import WildfireEnv
from emberlink.envs.world import motion
from emberlink.policies.scripted.base import Scripted

_REACHED = 1e-3  # cells; what float32 leaves of a flight that ends at a stop
_SLACK = 0.01  # cells; more than a UAV that is nearly at its stop can fail to see at the edge


class Lawnmower(Scripted):
    """Flies strips as wide as the view at full altitude, back and forth, forever.

    The strips are cut into stops from which they are seen without a gap, however long a step is.
    Strip by strip, every other one backwards, the stops make one path, of which the UAVs get equal
    parts: with as many UAVs as strips one strip each. Each flies to the first stop of its part,
    along it to the last and back. Where UAVs outnumber the stops, some fly the same part.

    Which flight from stop to stop a UAV is on is carried in the TensorDict, under
    "_lawnmower_flight".
    """

    FLIGHT = "_lawnmower_flight"
    stops: Tensor
    first: Tensor
    period: Tensor

    def __init__(self, env: WildfireEnv):
        super().__init__(env)
        self.out_keys.append(self.FLIGHT)
        path = stops(self.world.grid, self.radius)
        places, uavs = len(path), self.world.num_uavs
        first = torch.arange(uavs) * places // uavs
        last = (torch.arange(1, uavs + 1) * places // uavs - 1).maximum(first)
        self.register_buffer("stops", path.to(env.device))
        self.register_buffer("first", first.to(env.device))
        self.register_buffer("period", (2 * (last - first)).clamp(min=1).to(env.device))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        position = tensordict.get(keys.POSITION)
        nothing = torch.zeros_like(tensordict.get(keys.NEW_FIRE))
        flight = self.remembered(tensordict, self.FLIGHT, nothing)
        flight = flight + (motion.distance(position, self._ends(flight)) < _REACHED)
        tensordict.set(self.FLIGHT, flight)
        return self.fly(tensordict, self._ends(flight))

    def _ends(self, flight: Tensor) -> Tensor:
        """Where a flight ends, float32 [num_envs, n, 3], cells."""
        phase = flight % self.period
        ground = self.stops[self.first + torch.minimum(phase, self.period - phase)]
        ceiling = self.high[2:].float().expand_as(ground[..., :1])
        return torch.cat((ground, ceiling), -1)


def stops(grid: tuple[int, int], radius: float) -> Tensor:
    """The path of stops from which every cell is seen, float32 [stops, 2], cells.

    Args:
        grid: cells along x and y.
        radius: half the side of the square that is seen from a stop, cells.
    """
    most = max(1, math.floor(2 * (radius - _SLACK)) + 1)
    across, along = _middles(grid[0], most), _middles(grid[1], most)
    strips = [
        [(x, y) for y in (along if strip % 2 == 0 else along[::-1])]
        for strip, x in enumerate(across)
    ]
    return torch.tensor(strips).flatten(0, 1)


def _middles(side: int, most: int) -> list[float]:
    """The middles of nearly equal pieces of `side` cells, `most` each at most."""
    pieces = math.ceil(side / most)
    edges = [piece * side // pieces for piece in range(pieces + 1)]
    return [(low + high - 1) / 2 for low, high in pairwise(edges)]
