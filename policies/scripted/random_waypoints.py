"""A scripted policy that flies to random points."""

import torch
from tensordict import TensorDictBase

from emberlink.envs import keys
from emberlink.envs.utils.counter_rng import Use
from emberlink.envs.wildfire import WildfireEnv
from emberlink.envs.world import motion
from emberlink.policies.scripted.base import Scripted


class RandomWaypoints(Scripted):
    """Flies to random waypoints at the maximum altitude.

    A UAV that is closer than 1 cell to its waypoint gets a new one. The waypoints are carried in
    the TensorDict under "_scripted_waypoint".
    """

    WAYPOINT = "_scripted_waypoint"

    def __init__(self, env: WildfireEnv):
        super().__init__(env)
        self.out_keys.append(self.WAYPOINT)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        position = tensordict.get(keys.POSITION)
        key = self.step_key(tensordict, Use.SCRIPTED_WAYPOINT)
        low = torch.cat((self.low[:2], self.high[2:]))
        # At the first step the waypoint is the UAV's position, so a new one is drawn.
        old = self.carried(tensordict, self.WAYPOINT, position)
        waypoint = motion.next_waypoint(old, position, key, low, self.high)
        tensordict.set(self.WAYPOINT, waypoint)
        return self.fly(tensordict, waypoint)
