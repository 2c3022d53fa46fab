"""Scripted policies that plan nothing: they stay, fly at random, or fly to a given target."""

from typing import ClassVar

import torch
from tensordict import TensorDictBase

from emberlink.envs import keys
from emberlink.envs.utils import counter_rng
from emberlink.envs.utils.counter_rng import Use
from emberlink.envs.wildfire import WildfireEnv
from emberlink.envs.world import motion
from emberlink.policies.scripted.base import Scripted


class Stationary(Scripted):
    """Stays at the start position."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set(keys.ACTION, torch.zeros_like(tensordict.get(keys.POSITION)))


class RandomActions(Scripted):
    """Draws every component of every action uniformly from [-1, 1]."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        shape = tensordict.get(keys.POSITION).shape
        unit = counter_rng.uniform(
            self.step_key(tensordict, Use.SCRIPTED_ACTION), shape[-2] * shape[-1]
        )
        return tensordict.set(keys.ACTION, (2 * unit - 1).view(shape))


class RandomWaypoints(Scripted):
    """Flies to random waypoints at the `search_altitude`.

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
        # At the first step the waypoint is the UAV's position, so a new one is drawn.
        old = self.carried(tensordict, self.WAYPOINT, position)
        near = motion.distance(position, old) < 1
        points = motion.random_points(key, position.shape[-2], self.low, self.high)
        waypoint = torch.where(near.unsqueeze(-1), points, old)
        tensordict.set(self.WAYPOINT, waypoint)
        return self.fly(tensordict, waypoint)


class FollowTarget(Scripted):
    """Flies straight to the target that the consensus module gives, altitude included.

    It is the policy that earns the most heading bonus, and so shows the best that method 4 could
    learn from the bonus alone.
    """

    recipe: ClassVar[str | None] = "consensus"
    hears: ClassVar[bool] = True

    def __init__(self, env: WildfireEnv):
        super().__init__(env)
        self.in_keys.append(keys.TARGET)

    def bytes_sent(self, tensordict: TensorDictBase) -> None:
        """Returns None: the consensus module sends the messages."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self.fly(tensordict, tensordict.get(keys.TARGET))
