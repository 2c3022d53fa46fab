"""What a scripted policy is: a policy that learns nothing."""

from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from emberlink.envs import keys
from emberlink.envs.utils import counter_rng
from emberlink.envs.wildfire import WildfireEnv
from emberlink.envs.world import motion
from emberlink.envs.world.sensor import view_radius

_NOT_QUITE = 1 - 2**-22  # rounding must not carry a UAV across the edge that it flies to


class Scripted(TensorDictModuleBase):
    """Reads and writes TensorDicts as a learned actor does; no gradients, no weights.

    What it must remember from step to step it writes into the TensorDict, which is carried on.

    Args:
        env: the environment that it is played in. Its constants are read and, by a policy that
            says so, what no UAV could know.
    """

    recipe: ClassVar[str | None] = None
    """the method whose communication it needs; None where any will do"""

    low: torch.Tensor
    high: torch.Tensor

    def __init__(self, env: WildfireEnv):
        super().__init__()
        self.world = env.config
        reads: list[Any] = [keys.POSITION, keys.RNG_KEY, keys.STEP]
        writes: list[Any] = [keys.ACTION]
        self.in_keys, self.out_keys = reads, writes
        low, high = motion.corners(self.world.low, self.world.high)
        self.radius = view_radius(high[2].item(), self.world.view_angle)
        """half the side of the square that is seen from full altitude, cells"""
        self.register_buffer("low", low)
        self.register_buffer("high", high)
        self.to(env.device)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes ("agents", "action"), float32 [num_envs, n, 3] in [-1, 1]."""
        raise NotImplementedError

    @staticmethod
    def step_key(tensordict: TensorDictBase, use: int) -> torch.Tensor:
        """Returns the key of the random numbers of this step for one use, int64 [num_envs]."""
        return counter_rng.step_key(tensordict.get(keys.RNG_KEY), tensordict.get(keys.STEP), use)

    def fly(self, tensordict: TensorDictBase, target: torch.Tensor) -> TensorDictBase:
        """Writes the action that flies straight at a target at full speed and stops there.

        Args:
            tensordict: the moment.
            target: [num_envs, n, 3], cells.
        """
        step = (target - tensordict.get(keys.POSITION)) / self.world.displacement
        action = (step / step.abs().amax(-1, keepdim=True).clamp(min=1)).float()
        return tensordict.set(keys.ACTION, action * _NOT_QUITE)

    def remembered(
        self, tensordict: TensorDictBase, key: str, initial: torch.Tensor
    ) -> torch.Tensor:
        """What was carried under `key`, or `initial` in an episode's first step."""
        before = tensordict.get(key, None)
        if before is None:
            return initial
        begins = tensordict.get(keys.STEP) == 0
        return torch.where(begins.view(-1, *[1] * (initial.ndim - 1)), initial, before)
