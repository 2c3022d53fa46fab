"""Scripted policies that look at nothing but where they are."""

import torch
from tensordict import TensorDictBase

from emberlink.envs import keys
from emberlink.envs.utils import counter_rng
from emberlink.envs.utils.counter_rng import Use
from emberlink.envs.wildfire import WildfireEnv
from emberlink.envs.world import motion

from .base import Scripted


class Stationary(Scripted):
    """Stays where it was put."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set(keys.ACTION, torch.zeros_like(tensordict.get(keys.POSITION)))


class RandomActions(Scripted):
    """Every component of every action uniform in [-1, 1]."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        shape = tensordict.get(keys.POSITION).shape
        unit = counter_rng.uniform(
            self.step_key(tensordict, Use.SCRIPTED_ACTION), shape[-2] * shape[-1]
        )
        return tensordict.set(keys.ACTION, (2 * unit - 1).view(shape))


class RandomWaypoints(Scripted):
    """Flies to random points of the box at full altitude, to the next once closer than 1.

    The waypoints are carried in the TensorDict, under "_scripted_waypoint".
    """

    WAYPOINT = "_scripted_waypoint"

    def __init__(self, env: WildfireEnv):
        super().__init__(env)
        self.out_keys.append(self.WAYPOINT)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        position = tensordict.get(keys.POSITION)
        key = self.step_key(tensordict, Use.SCRIPTED_WAYPOINT)
        low = torch.cat((self.low[:2], self.high[2:]))
        # At the first step the waypoint is where the UAV is, so that it draws one.
        old = self.remembered(tensordict, self.WAYPOINT, position)
        waypoint = motion.next_waypoint(old, position, key, low, self.high)
        tensordict.set(self.WAYPOINT, waypoint)
        return self.fly(tensordict, waypoint)
