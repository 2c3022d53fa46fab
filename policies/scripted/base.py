"""Defines the base class of scripted policies."""

from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from emberlink.envs import keys
from emberlink.envs.utils import counter_rng
from emberlink.envs.utils.plugins import Plugins
from emberlink.envs.wildfire import WildfireEnv
from emberlink.envs.world import motion
from emberlink.envs.world.sensor import search_altitude, view_radius


class Scripted(TensorDictModuleBase):
    """Maps observations to actions without learning.

    It reads and writes TensorDicts as a learned actor does and has no weights. State that lasts
    for several steps is written to the TensorDict, which the caller carries to the next step.

    Args:
        env: the environment that it acts in. Policies with maps also read its fire at cells that
            were seen; `Oracle` reads the whole fire.
    """

    recipe: ClassVar[str | None] = None
    """the method whose communication the policy needs; None if it needs none"""
    hears: ClassVar[bool] = False
    """whether the policy depends on the radio of the world"""

    low: torch.Tensor
    high: torch.Tensor
    """corners of the map, float64 [3], at the `search_altitude`, cells"""

    def __init__(self, env: WildfireEnv):
        super().__init__()
        self.world = env.config
        reads: list[Any] = [keys.POSITION, keys.RNG_KEY, keys.STEP]
        writes: list[Any] = [keys.ACTION]
        self.in_keys, self.out_keys = reads, writes
        low, high = motion.corners(self.world.low, self.world.high)
        low[2] = high[2] = search_altitude(self.world)
        self.radius = view_radius(high[2].item(), self.world.view_angle)
        """half the side of the square in view from the altitude of flight, cells"""
        self.stride = self.world.displacement
        """cells that a UAV flies with one action, along x, y and z each"""
        self.register_buffer("low", low)
        self.register_buffer("high", high)
        self.to(env.device)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes ("agents", "action"), float32 [num_envs, n, 3] in [-1, 1]."""
        raise NotImplementedError

    @staticmethod
    def step_key(tensordict: TensorDictBase, use: int) -> torch.Tensor:
        """Returns the random key of a step for a `counter_rng.Use`, int64 [num_envs]."""
        return counter_rng.step_key(tensordict.get(keys.RNG_KEY), tensordict.get(keys.STEP), use)

    def bytes_sent(self, tensordict: TensorDictBase) -> torch.Tensor | None:
        """Returns the bytes that each UAV sends at a step, int64 [num_envs, n]; zeros by default.

        If None, the bytes that the communication module counts are used.
        """
        return torch.zeros_like(tensordict.get(keys.ALIVE), dtype=torch.int64)

    def fly(self, tensordict: TensorDictBase, target: torch.Tensor) -> TensorDictBase:
        """Writes the action that flies at full speed to a target, float [num_envs, n, 3], cells."""
        way = target - tensordict.get(keys.POSITION)
        return tensordict.set(keys.ACTION, motion.towards(way, self.stride))

    def above(self, place: torch.Tensor) -> torch.Tensor:
        """Returns the points at the `search_altitude` above places, float [num_envs, n, 2]."""
        altitude = self.high[2:].to(place.dtype).expand_as(place[..., :1])
        return torch.cat((place, altitude), -1)

    def carried(self, tensordict: TensorDictBase, key: str, initial: torch.Tensor) -> torch.Tensor:
        """Returns the tensor under `key`; `initial`, [num_envs, ...], where an episode begins."""
        previous = tensordict.get(key, None)
        if previous is None:
            return initial
        begins = tensordict.get(keys.STEP) == 0
        return torch.where(begins.view(-1, *[1] * (initial.ndim - 1)), initial, previous)


SCRIPTED = Plugins(Scripted, "emberlink.scripted", "policy")
