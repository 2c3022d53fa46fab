"""The environment for Gymnasium: the team as one agent.

Importing this module registers "emberlink/WildfireTeam-v0", so that
`gymnasium.make("emberlink.envs.gymnasium:emberlink/WildfireTeam-v0")` finds it.
"""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from emberlink.envs.pettingzoo import WildfireParallelEnv, parallel_env, to_action
from emberlink.envs.utils.errors import UserError

ID = "emberlink/WildfireTeam-v0"


class WildfireTeamEnv(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """One agent that observes all UAVs, float32 [n * features], and moves all, float32 [n * 3].

    The reward is the mean over UAVs. An episode is terminated if all UAVs have failed. `info` holds
    the numbers of cells `seen`, `burning` and `burnt`.

    Args:
        kwargs: as for `parallel_env`.

    Raises:
        UserError: as `parallel_env`, or `observation` is not `vector`.
    """

    metadata = WildfireParallelEnv.metadata

    def __init__(self, **kwargs: Any):
        self._team = parallel_env(**kwargs)
        observation = self._team._core.config.observation
        if observation != "vector":
            raise UserError(f"observation={observation}: the joint view of a team is a vector")
        self.render_mode = self._team.render_mode
        self.observation_space = self._team.state_space
        self.action_space = Box(-1.0, 1.0, (3 * len(self._team.possible_agents),), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Starts an episode; see `WildfireParallelEnv.reset`."""
        super().reset(seed=seed)
        _, infos = self._team.reset(seed=seed, options=options)
        return self._team.state(), _shared(infos)

    def step(self, action: NDArray[np.float32]):
        """Moves all UAVs at once.

        Raises:
            UserError: the action is not an array of shape [n * 3].
        """
        every = self._team.possible_agents
        rows = to_action(action, 3 * len(every)).reshape(-1, 3)
        actions = dict(zip(every, rows, strict=True))
        flying = {agent: actions[agent] for agent in self._team.agents}
        _, rewards, _, truncations, infos = self._team.step(flying)
        reward, truncated = sum(rewards.values()) / len(every), any(truncations.values())
        terminated = not truncated and not self._team.agents
        return self._team.state(), reward, terminated, truncated, _shared(infos)

    def render(self):
        """Draws the environment; see `WildfireParallelEnv.render`."""
        return self._team.render()

    def close(self) -> None:
        """Closes the window, if there is one."""
        self._team.close()


def _shared(infos: dict[str, dict[str, Any]]) -> dict[str, int]:
    first = next(iter(infos.values()))
    return {key: first[key] for key in ("seen", "burning", "burnt")}


gymnasium.register(id=ID, entry_point=f"{__name__}:WildfireTeamEnv")
