"""The environment for PettingZoo: a `ParallelEnv` over `WildfireEnv`."""

import dataclasses
from collections.abc import Callable, Iterable
from copy import deepcopy
from typing import Any, ClassVar

import numpy as np
import torch
from gymnasium.spaces import Box, Dict, Space
from numpy.typing import NDArray
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils.conversions import parallel_to_aec
from tensordict import TensorDictBase
from torchrl.envs import EnvBase, step_mdp

from emberlink.envs import keys
from emberlink.envs.config import WildfireConfig
from emberlink.envs.scenarios import default_config
from emberlink.envs.utils.errors import UserError, shown
from emberlink.envs.wildfire import WildfireEnv

Array = NDArray[np.float32]
Observation = Array | dict[str, NDArray[Any]]

_NOT_INFO = {k for _, k in (*keys.NETWORKS_READ, keys.ACTION, keys.REWARD)}


class WildfireParallelEnv(ParallelEnv[str, Any, Any]):
    """The wildfire environment with PettingZoo's parallel API: agents "uav_0", "uav_1", ...

    All agents are truncated together at the horizon. One that fails (`env.failures`) is terminated
    and leaves `agents`. `infos` hold, for each agent, the other tensors under ("agents", ...) of
    the TorchRL environment, and the numbers of cells `seen`, `burning` and `burnt`. With
    `observation: window` an observation is a dictionary of "observation", float32 [6], and
    "window", uint8 [3, W, W]; with `observation: map` it has "crops" instead of the window. Before
    the first reset, methods that need an episode raise a UserError.

    Args:
        env: a TorchRL environment of batch size [1] over a `WildfireEnv`, such as
            `emberlink.trainers.make_env` returns; without it, a `WildfireEnv` is made.
        render_mode: "rgb_array", "human" (a window) or None.
        max_cycles: steps of an episode, instead of the config's horizon.
        kwargs: for `WildfireEnv`, if there is no `env`. Without a `config`, observations are scaled
            (`observation_scale="box"`), and the reward is that of the scenario's configuration.

    Raises:
        UserError: another render mode, more than one environment, or `env` beside other settings.
    """

    metadata: ClassVar[dict[str, Any]] = {  # pyright: ignore[reportIncompatibleVariableOverride]
        "name": "emberlink_wildfire_v0",
        "render_modes": ["rgb_array", "human"],
        "render_fps": 20,
        "is_parallelizable": True,
    }

    def __init__(
        self,
        env: EnvBase | None = None,
        *,
        render_mode: str | None = None,
        max_cycles: int | None = None,
        **kwargs: Any,
    ):
        if env is not None and (kwargs or max_cycles is not None):
            raise UserError(f"settings beside an existing environment: {kwargs or max_cycles}")
        if env is None:
            scaled = dataclasses.replace(
                default_config(kwargs.get("fire")), observation_scale="box"
            )
            config = kwargs.pop("config", None) or scaled
            config = dataclasses.replace(config, horizon=max_cycles or config.horizon)
            env = WildfireEnv(**{"num_envs": 1, "config": config, **kwargs})
        known = self.metadata["render_modes"]
        if render_mode is not None and render_mode not in known:
            raise UserError(f"render_mode {render_mode!r} is not known; known: {known}")
        if env.batch_size != (1,):
            raise UserError(f"env: a batch size of [1] is needed, got {list(env.batch_size)}")
        self.render_mode = render_mode
        core: Any = getattr(env, "base_env", env)
        self._env, self._core = env, core
        self._now: TensorDictBase | None = None
        self._unplayed: int | None = None
        self.possible_agents = self._core.group_map[keys.AGENTS]
        self.agents: list[str] = []
        vector, space = observation_space(env, self._core.config)
        # One space object per agent, kept: PettingZoo seeds and compares them by identity.
        self.observation_spaces = {agent: deepcopy(space) for agent in self.possible_agents}
        self.action_spaces = {a: Box(-1.0, 1.0, (3,), np.float32) for a in self.possible_agents}
        team = len(self.possible_agents)
        self.state_space = Box(np.tile(vector.low, team), np.tile(vector.high, team))

    def observation_space(self, agent: str) -> Space:
        """Returns the space of an agent's observations, the same object at each call."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Space:
        """Returns the space of an agent's actions, the same object at each call."""
        return self.action_spaces[agent]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None):
        """Starts an episode: the first of `seed` if it is given, else the next.

        The first episode of a seed is the next one until a step is made, since wrappers such as
        TorchRL's reset an environment when they are made, and again before the first step.

        Args:
            seed: of all random numbers from here on.
            options: "position", start positions in cells, [num_uavs, 3].

        Raises:
            UserError: positions outside of the box.
        """
        options = dict(options or {})
        options.pop("options", None)  # PettingZoo's own tests pass {"options": 1}
        self._unplayed = self._unplayed if seed is None else seed
        if self._unplayed is not None:
            self._env.set_seed(self._unplayed)
        self._now = self._env.reset(**options)
        self.agents = list(self.possible_agents)
        self._show()
        infos = self._of(self.agents, self._infos(self._now))
        return self._of(self.agents, self._observations()), infos

    def step(self, actions: dict[str, Array]):
        """Moves all UAVs at once; after the end of an episode, returns empty dictionaries.

        Args:
            actions: of the live agents; actions of agents that have left are ignored.

        Raises:
            UserError: an action of a live agent does not have three numbers or holds NaN.
        """
        now, flew = self._begun(), self.agents
        if not flew:
            return {}, {}, {}, {}, {}
        action, self._unplayed = self._stacked(actions), None
        now.set(keys.ACTION, torch.from_numpy(action[None]).to(self._core.device))
        stepped = self._env.step(now)
        self._now = step_mdp(stepped, keep_other=True)
        after = stepped.get("next")
        rewards = self._of(flew, after.get(keys.REWARD)[0, :, 0].tolist())
        failed = self._of(flew, (~after.get(keys.ALIVE)[0]).tolist())
        truncated = bool(after.get("truncated"))
        self.agents = [] if truncated else [agent for agent in flew if not failed[agent]]
        self._show()
        observations = self._of(flew, self._observations())
        infos = self._of(flew, self._infos(after))
        return observations, rewards, failed, dict.fromkeys(flew, truncated), infos

    def act(self, policy: Callable[[TensorDictBase], TensorDictBase]) -> dict[str, Array]:
        """Returns the actions of a policy for `step`; each call moves its memory one step on.

        After the end of an episode there are none.

        Args:
            policy: writes ("agents", "action"), such as `emberlink.trainers.load` returns.
        """
        if not self.agents:
            return {}
        with torch.no_grad():
            self._now = policy(self._begun())
        return self._of(self.agents, self._now.get(keys.ACTION)[0].cpu().numpy().copy())

    def state(self) -> Array:
        """Returns the vectors of all UAVs one after another, float32 [n * features]."""
        return self._begun().get(keys.OBSERVATION)[0].flatten().cpu().numpy().copy()

    def pictures(self) -> dict[str, NDArray[np.uint8]]:
        """Returns the other tensors of the observations of all UAVs, uint8 [n, ...], by name."""
        now = self._begun()
        _, *others = keys.observation_keys(self._env.observation_spec)
        return {k[1]: now.get(k)[0].to(torch.uint8).cpu().numpy().copy() for k in others}

    def counts(self) -> dict[str, int]:
        """Returns the numbers of cells `seen`, `burning` and `burnt`."""
        now = self._begun()
        return {key: int(now.get(key)) for key in (keys.SEEN, keys.BURNING, keys.BURNT)}

    def render(self) -> NDArray[np.uint8] | None:
        """Returns the picture, uint8 [height, width, 3], or None if it is shown in a window.

        Raises:
            UserError: the environment was made without a render mode.
        """
        if self.render_mode is None:
            known = self.metadata["render_modes"]
            raise UserError(f"render() needs a render_mode; known: {known}")
        picture = self._core.render()
        if self.render_mode == "rgb_array":
            return picture
        from matplotlib import pyplot  # imported here, since it takes a second

        window = pyplot.figure(self._window, clear=True)
        window.add_axes((0, 0, 1, 1), frame_on=False, xticks=[], yticks=[]).imshow(picture)
        window.show(warn=False)  # nothing without a display
        window.canvas.flush_events()
        return None

    def close(self) -> None:
        """Closes the window, if there is one."""
        if self.render_mode == "human":
            from matplotlib import pyplot

            pyplot.close(self._window)

    @property
    def _window(self) -> str:
        """The title of the window, unique to the environment."""
        return f"{self.metadata['name']} {id(self)}"

    def _begun(self) -> TensorDictBase:
        """Returns the current time step."""
        if self._now is None:
            raise UserError("no episode is running: call reset() first")
        return self._now

    def _of(self, agents: list[str], values: Iterable[Any]) -> dict[str, Any]:
        """Picks the values of some agents from the values of all."""
        every = zip(self.possible_agents, values, strict=True)
        return {agent: value for agent, value in every if agent in agents}

    def _show(self) -> None:
        if self.render_mode == "human":
            self.render()

    def _stacked(self, actions: dict[str, Array]) -> Array:
        """Returns the actions in the order of the agents, float32 [n, 3]."""
        given = {agent: to_action(actions[agent], 3, agent) for agent in self.agents}
        hover = np.zeros(3, np.float32)
        return np.stack([given.get(agent, hover) for agent in self.possible_agents])

    def _observations(self) -> list[Observation]:
        vectors = self.state().reshape(len(self.possible_agents), -1)
        pictures = self.pictures()
        if not pictures:
            return [*vectors]
        return [
            {keys.OBSERVATION[1]: vector, **{key: value[i] for key, value in pictures.items()}}
            for i, vector in enumerate(vectors)
        ]

    def _infos(self, td: TensorDictBase) -> list[dict[str, Any]]:
        told, shared = td.get(keys.AGENTS)[0].exclude(*_NOT_INFO), self.counts()
        values = {key: value.cpu().numpy().copy() for key, value in told.items()}
        rows = range(len(self.possible_agents))
        return [{key: value[i] for key, value in values.items()} | shared for i in rows]


parallel_env = WildfireParallelEnv
"""the name by which PettingZoo's users look for it"""


def env(**kwargs: Any) -> AECEnv:
    """Returns the environment with PettingZoo's AEC API; arguments as for `parallel_env`."""
    return parallel_to_aec(parallel_env(**kwargs))


def to_action(action: Any, size: int, agent: str = "the team") -> Array:
    """Returns an action as an array, float32 [size].

    Raises:
        UserError: it has another shape, or holds NaN.
    """
    numbers = np.asarray(action, np.float32)
    if numbers.shape != (size,):
        got = numbers.shape
        raise UserError(f"an action is an array of shape ({size},), got {got} for {agent}")
    if np.isnan(numbers).any():
        raise UserError(f"action of {agent}: {shown(numbers.tolist())} holds NaN")
    return numbers


def observation_space(env: EnvBase, config: WildfireConfig) -> tuple[Box, Space]:
    """Returns the space of an observation's vector, and of the whole observation."""
    features = env.observation_spec[keys.OBSERVATION].shape[-1]
    low, high = [*config.low, 0, 0, 0], [*config.high, 1, 1, config.horizon]
    if features != len(keys.FEATURES):  # communication has added numbers
        low, high = [-np.inf] * features, [np.inf] * features
    elif config.observation_scale == "box":
        low, high = [-1, -1, -1, 0, 0, 0], [1, 1, 1, 1, 1, 1]
    vector = Box(np.array(low, np.float32), np.array(high, np.float32))
    _, *others = keys.observation_keys(env.observation_spec)
    spaces: dict[str, Space] = {keys.OBSERVATION[1]: vector}
    for key in others:
        spec = env.observation_spec[key]
        spaces[key[1]] = Box(0, 1 if spec.dtype == torch.bool else 255, spec.shape[2:], np.uint8)
    return vector, Dict(spaces) if others else vector
