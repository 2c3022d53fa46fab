"""Defines the public attributes of `WildfireEnv`: sizes, names, maps and pictures."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torchrl.envs import EnvBase

from emberlink.envs import keys
from emberlink.envs.config import WildfireConfig
from emberlink.envs.rendering import frame
from emberlink.envs.utils.errors import UserError
from emberlink.envs.world.coverage_map import CoverageMap
from emberlink.envs.world.knowledge import Knowledge
from emberlink.envs.world.measures import Measures


class TeamView(EnvBase):
    """Sizes, names, maps and pictures of the environments; a base class of `WildfireEnv`."""

    config: WildfireConfig
    _fire_name: str | None
    _map: CoverageMap
    _measures: Measures | None
    _time: Tensor
    _fail_step: Tensor | None
    _position: Tensor

    def __repr__(self) -> str:
        config = self.config
        fire = self._fire_name or f"{len(self._map)} given"
        return (
            f"WildfireEnv(num_envs={self.num_envs}, grid={config.grid}, "
            f"num_uavs={config.num_uavs}, horizon={config.horizon}, fire={fire}, "
            f"device={self.device})"
        )

    @property
    def num_envs(self) -> int:
        """The number of environments."""
        return self.batch_size[0]

    @property
    def n_agents(self) -> int:
        """The number of UAVs in the team."""
        return self.config.num_uavs

    @property
    def max_steps(self) -> int:
        """The steps of an episode."""
        return self.config.horizon

    @property
    def group_map(self) -> dict[str, list[str]]:
        """The UAVs' names under the key that their tensors stand under."""
        return {keys.AGENTS: [f"uav_{i}" for i in range(self.n_agents)]}

    @property
    def fire_map(self) -> Tensor:
        """The paper's map, uint8 [num_envs, X, Y]: 0 no fire, 1 seen fire, 2 unseen fire.

        A burnt-out cell is 3 if it was seen while it burned, else 4.
        """
        now = self._time[:, None, None]
        fire = (self.arrival_time <= now).to(torch.uint8) * (2 - self._map.seen.to(torch.uint8))
        if self.burn_out is not None:
            fire += 2 * (self.burn_out <= now)
        return fire

    @property
    def unseen_fire(self) -> Tensor:
        """The number of burning cells that no UAV has seen while they burned, int64 [num_envs]."""
        return (self.fire_map == 2).sum((-1, -2))

    @property
    def arrival_time(self) -> Tensor:
        """The fire of each environment: arrival times in steps, float32 [num_envs, X, Y]."""
        return self._map.arrival_time

    @property
    def burn_out(self) -> Tensor | None:
        """Burn-out times in steps, float32 [num_envs, X, Y]; None if cells burn for ever."""
        return self._map.burn_out

    @property
    def fail_step(self) -> Tensor | None:
        """The step from which each UAV has failed, int64 [num_envs, n]; None if none can fail."""
        return self._fail_step

    @property
    def knowledge(self) -> Knowledge | None:
        """The knowledge of each UAV and, last, of the base; None in a world without a base."""
        return None if self._measures is None else self._measures.knowledge

    def render(self, mode: str = "rgb_array", *, env: int = 0):
        """Draws one environment in the paper's colours, uint8 [height, width, 3].

        Raises:
            UserError: another mode than "rgb_array".
        """
        if mode != "rgb_array":
            raise UserError(f"render mode {mode!r} is not known; known: 'rgb_array'")
        return frame.frame(
            self.fire_map[env].cpu().numpy(),
            self._position[env].cpu().numpy(),
            view_angle=self.config.view_angle,
            alive=self._alive_now(env),
            base=self.config.base,
        )

    def _alive_now(self, env: int) -> NDArray[np.bool_] | None:
        """Returns which UAVs of an environment fly, bool [n]; None if none can fail."""
        failed = self._fail_step
        return None if failed is None else (self._time[env] < failed[env]).cpu().numpy()
