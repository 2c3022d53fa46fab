"""Scripted policies: what a learned one has to beat."""

from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from emberlink.envs import keys, streams, uav
from emberlink.envs.config import WildfireConfig

_POINTS, _ACTIONS = range(200, 202)  # what a moment's random stream is split into


class Scripted(TensorDictModuleBase):
    """A policy that learns nothing.

    Args:
        world: the environment's constants.
    """

    low: torch.Tensor
    high: torch.Tensor

    def __init__(self, world: WildfireConfig):
        super().__init__()
        self.world = world
        reads: list[Any] = [keys.POSITION, keys.STREAM, keys.STEP]
        writes: list[Any] = [keys.ACTION]
        self.in_keys, self.out_keys = reads, writes
        low, high = uav.corners(world.low, world.high)
        self.register_buffer("low", low)
        self.register_buffer("high", high)

    @staticmethod
    def moment(tensordict: TensorDictBase, use: int) -> torch.Tensor:
        """A random stream for this step and this use, int64 [num_envs]."""
        return streams.at(tensordict.get(keys.STREAM), tensordict.get(keys.STEP), use)


class RandomActions(Scripted):
    """Every component of every action uniform in [-1, 1]."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        shape = tensordict.get(keys.POSITION).shape
        unit = streams.uniform(self.moment(tensordict, _ACTIONS), shape[-2] * shape[-1])
        return tensordict.set(keys.ACTION, (2 * unit - 1).view(shape))


class RandomWaypoints(Scripted):
    """Flies to random points of the box at full altitude, to the next once closer than 1.

    The waypoints are carried in the TensorDict, under "_scripted_waypoint".
    """

    WAYPOINT: ClassVar = "_scripted_waypoint"

    def __init__(self, world: WildfireConfig):
        super().__init__(world)
        self.out_keys.append(self.WAYPOINT)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        position = tensordict.get(keys.POSITION)
        stream = self.moment(tensordict, _POINTS)
        low = torch.cat((self.low[:2], self.high[2:]))
        old = tensordict.get(self.WAYPOINT, None)
        if old is None:
            old = position
        # At the first step the waypoint is where the UAV is, so that it draws one.
        fresh = (tensordict.get(keys.STEP) == 0)[:, None, None]
        old = torch.where(fresh, position, old)
        waypoint = uav.next_waypoint(old, position, stream, low, self.high)
        tensordict.set(self.WAYPOINT, waypoint)
        step = (waypoint - position) / self.world.displacement
        return tensordict.set(keys.ACTION, step / step.abs().amax(-1, keepdim=True).clamp(min=1))


SCRIPTED = {"random_waypoints": RandomWaypoints, "random_actions": RandomActions}
"""The scripted policies that every evaluation reports, by name."""
