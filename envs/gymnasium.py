"""The environment for Gymnasium: the team as one agent.

Importing this module registers "emberlink/WildfireTeam-v0", so that
`gymnasium.make("emberlink.envs.gymnasium:emberlink/WildfireTeam-v0")` finds it.
"""

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict, Space
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from tensordict import TensorDictBase

from emberlink.envs import keys
from emberlink.envs.pettingzoo import WildfireParallelEnv, to_action


class WildfireTeamEnv(gymnasium.Env[Any, NDArray[np.float32]]):
    """One agent that observes all UAVs, float32 [n * features], and moves all, float32 [n * 3].

    If the UAVs observe pictures, an observation is a dictionary of "observation" and the pictures,
    uint8 [n, ...]. The reward is the mean over UAVs. An episode is terminated if all UAVs have
    failed. `info` holds the numbers of cells `seen`, `burning` and `burnt`.

    Args:
        kwargs: as for `WildfireParallelEnv`.

    Raises:
        UserError: as `WildfireParallelEnv`.
    """

    metadata = WildfireParallelEnv.metadata

    def __init__(self, **kwargs: Any):
        self._team = WildfireParallelEnv(**kwargs)
        self.render_mode = self._team.render_mode
        uavs = len(self._team.possible_agents)
        self.observation_space: Space[Any] = self._team.state_space
        one = self._team.observation_space("uav_0")
        if isinstance(one, Dict):
            each: Any = batch_space(one, uavs)
            self.observation_space = Dict({**each, keys.OBSERVATION[1]: self._team.state_space})
        self.action_space = Box(-1.0, 1.0, (3 * uavs,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Starts an episode; see `WildfireParallelEnv.reset`."""
        super().reset(seed=seed)
        self._team.reset(seed=seed, options=options)
        return self._observed(), self._team.counts()

    def step(self, action: NDArray[np.float32]):
        """Moves all UAVs at once.

        Raises:
            UserError: the action is not an array of shape [n * 3] without NaN.
        """
        every = self._team.possible_agents
        rows = to_action(action, 3 * len(every)).reshape(-1, 3)
        _, rewards, _, truncations, _ = self._team.step(dict(zip(every, rows, strict=True)))
        truncated = any(truncations.values())
        terminated = not truncated and not self._team.agents
        reward = sum(rewards.values()) / len(every)
        return self._observed(), reward, terminated, truncated, self._team.counts()

    def act(self, policy: Callable[[TensorDictBase], TensorDictBase]) -> NDArray[np.float32]:
        """Returns the actions of a policy for `step`; see `WildfireParallelEnv.act`."""
        actions = self._team.act(policy)
        hover = np.zeros(3, np.float32)
        return np.concatenate([actions.get(uav, hover) for uav in self._team.possible_agents])

    def _observed(self) -> Any:
        vector, pictures = self._team.state(), self._team.pictures()
        return {keys.OBSERVATION[1]: vector, **pictures} if pictures else vector

    def render(self):
        """Draws the environment; see `WildfireParallelEnv.render`."""
        return self._team.render()

    def close(self) -> None:
        """Closes the window, if there is one."""
        self._team.close()


gymnasium.register(id="emberlink/WildfireTeam-v0", entry_point=f"{__name__}:WildfireTeamEnv")
