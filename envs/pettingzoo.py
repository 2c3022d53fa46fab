"""The environment for PettingZoo: a `ParallelEnv` over the same core."""

from typing import Any, ClassVar

import numpy as np
import torch
from gymnasium.spaces import Box
from numpy.typing import NDArray
from pettingzoo import ParallelEnv
from tensordict import TensorDictBase
from torchrl.envs import EnvBase, TransformedEnv, step_mdp

from emberlink.envs.config import WildfireConfig
from emberlink.envs.rendering.frame import Window
from emberlink.envs.utils.errors import UserError
from emberlink.envs.wildfire import WildfireEnv

from . import keys

Array = NDArray[np.float32]

_NOT_INFO = (keys.OBSERVATION[1], keys.ACTION[1], keys.REWARD[1])


def parallel_env(
    env: EnvBase | None = None, *, render_mode: str | None = None, **kwargs: Any
) -> "WildfireParallelEnv":
    """The wildfire environment with PettingZoo's parallel API.

    Args:
        env: a TorchRL environment of batch size [1] over a `WildfireEnv`, such as
            `emberlink.trainers.make_env` returns; without it, a `WildfireEnv` is made.
        render_mode: "rgb_array", "human" (a window) or None.
        kwargs: for `WildfireEnv`, if there is no `env`.

    Raises:
        ValueError: another render mode, more than one environment, `env` beside `kwargs`, or
            what `WildfireEnv` does not take.
    """
    if env is not None and kwargs:
        raise UserError(f"a ready environment takes no further settings, got {sorted(kwargs)}")
    if env is None:
        env = WildfireEnv(**{"num_envs": 1, **kwargs})
    return WildfireParallelEnv(env, render_mode)


class WildfireParallelEnv(ParallelEnv[str, Any, Any]):
    """One environment's UAVs as PettingZoo's agents "uav_0", "uav_1", ...; see `parallel_env`.

    All agents are truncated together at the horizon, and never terminated. `infos` hold, for each
    agent, what the TorchRL environment has under ("agents", ...), and the cells seen and burning.
    """

    metadata: ClassVar[dict[str, Any]] = {  # pyright: ignore[reportIncompatibleVariableOverride]
        "name": "emberlink_wildfire_v0",
        "render_modes": ["rgb_array", "human"],
        "render_fps": 20,
        "is_parallelizable": True,
    }

    def __init__(self, env: EnvBase, render_mode: str | None = None):
        known = self.metadata["render_modes"]
        if render_mode is not None and render_mode not in known:
            raise UserError(f"render_mode {render_mode!r} is not known; known: {known}")
        core = env.base_env if isinstance(env, TransformedEnv) else env
        if not isinstance(core, WildfireEnv):
            raise UserError(f"env: a WildfireEnv is needed, got {type(core).__name__}")
        if env.batch_size != (1,):
            raise UserError(f"env: a batch size of [1] is needed, got {list(env.batch_size)}")
        self.render_mode = render_mode
        self._env, self._core, self._window = env, core, None
        self._moment: TensorDictBase | None = None
        self.possible_agents = [f"uav_{i}" for i in range(core.config.num_uavs)]
        self.agents: list[str] = []
        features = env.observation_spec[keys.OBSERVATION].shape[-1]
        low, high = _bounds(core.config, features)
        # One space object per agent, kept: PettingZoo seeds and compares them by identity.
        self._observation_spaces = {
            a: Box(low, high, dtype=np.float32) for a in self.possible_agents
        }
        self._action_spaces = {a: Box(-1.0, 1.0, (3,), np.float32) for a in self.possible_agents}

    def observation_space(self, agent: str) -> Box:
        return self._observation_spaces[agent]

    def action_space(self, agent: str) -> Box:
        return self._action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Array], dict[str, dict[str, Any]]]:
        """A new episode: the first one of `seed` if there is one, else the next one."""
        if seed is not None:
            self._env.set_seed(seed)
        self._moment = self._env.reset()
        self.agents = list(self.possible_agents)
        self._show()
        return self._observations(self._moment), self._infos(self._moment)

    def step(
        self, actions: dict[str, Array]
    ) -> tuple[
        dict[str, Array],
        dict[str, float],
        dict[str, bool],
        dict[str, bool],
        dict[str, dict[str, Any]],
    ]:
        """All UAVs act at once.

        Raises:
            ValueError: not one action of three numbers for each live agent, or no episode runs.
        """
        if self._moment is None or not self.agents:
            raise UserError("no episode is running: call reset() before step()")
        if set(actions) != set(self.agents):
            raise UserError(f"actions for {sorted(actions)}; the agents are {self.agents}")
        action = np.stack(
            [np.asarray(actions[agent], np.float32) for agent in self.possible_agents]
        )
        if action.shape != (len(self.possible_agents), 3):
            raise UserError(f"an action is an array of shape (3,), got {action.shape[1:]}")
        self._moment.set(keys.ACTION, torch.from_numpy(action[None]).to(self._core.device))
        moment = self._env.step(self._moment)
        self._moment = step_mdp(moment, keep_other=True)
        following = moment.get("next")
        rewards = following.get(keys.REWARD)[0, :, 0].tolist()
        terminated, truncated = bool(following["terminated"]), bool(following["truncated"])
        self.agents = [] if terminated or truncated else list(self.possible_agents)
        self._show()
        return (
            self._observations(following),
            dict(zip(self.possible_agents, rewards, strict=True)),
            dict.fromkeys(self.possible_agents, terminated),
            dict.fromkeys(self.possible_agents, truncated),
            self._infos(following),
        )

    def render(self) -> NDArray[np.uint8] | None:
        """The picture, uint8 [height, width, 3], or None when it is shown in a window.

        Raises:
            ValueError: the environment was made without a render mode.
        """
        if self.render_mode is None:
            known = self.metadata["render_modes"]
            raise UserError(f"render() needs a render_mode; known: {known}")
        if self.render_mode == "rgb_array":
            return self._core.render()
        self._window = self._window or Window(self.metadata["name"])
        return self._window.show(self._core.render())

    def close(self) -> None:
        """Closes the window, if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None

    def _show(self) -> None:
        if self.render_mode == "human":
            self.render()

    def _observations(self, moment: TensorDictBase) -> dict[str, Array]:
        rows = moment.get(keys.OBSERVATION)[0].cpu().numpy()
        return {agent: row.copy() for agent, row in zip(self.possible_agents, rows, strict=True)}

    def _infos(self, moment: TensorDictBase) -> dict[str, dict[str, Any]]:
        per_uav = moment.get(keys.AGENTS)[0].exclude(*_NOT_INFO).cpu().numpy()
        shared = {key: int(moment.get(key)) for key in (keys.SEEN, keys.BURNING)}
        return {
            agent: {key: value[i].copy() for key, value in per_uav.items()} | shared
            for i, agent in enumerate(self.possible_agents)
        }


def _bounds(config: WildfireConfig, features: int) -> tuple[Array, Array]:
    """The smallest and largest observation; infinite where communication wrote more numbers."""
    if features != len(keys.FEATURES):
        limit = np.full(features, np.inf, np.float32)
        return -limit, limit
    if config.observation_scale == "box":
        low, high = [-1, -1, -1, 0, 0, 0], [1, 1, 1, 1, 1, 1]
    else:
        low, high = [*config.low, 0, 0, 0], [*config.high, 1, 1, config.horizon]
    return np.array(low, np.float32), np.array(high, np.float32)
