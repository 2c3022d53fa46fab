"""Full communication: method 3 of the paper (section IV.E, algorithm 2)."""

from typing import Any, ClassVar

import torch
from pydantic.dataclasses import dataclass
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded

from emberlink.comm.base import CommModule
from emberlink.envs import keys
from emberlink.envs.config import WildfireConfig
from emberlink.envs.utils.validation import STRICT


@dataclass(frozen=True, kw_only=True, config=STRICT)
class PositionalConfig:
    """Stores the settings under `comm`."""

    own_first: bool = False
    """whether UAV k observes the vectors in the order k, k + 1, ..., n - 1, 0, ..., k - 1"""


class Positional(CommModule):
    """Concatenates the vectors of all UAVs for every UAV: 6 n numbers.

    UAV 0 is first. With a radio of unlimited range, all UAVs then observe the same numbers in the
    same order, as in algorithm 2. With `own_first`, the UAV itself is first. The vector of a UAV
    that is not heard is replaced by zeros. With `observation: map`, the pictures of a UAV show the
    positions that it has heard, and vectors are its own.
    """

    config_type: ClassVar[type] = PositionalConfig
    hears: ClassVar[bool] = True
    units: ClassVar[tuple[str, ...]] = ("own_first",)

    _own: Tensor
    _order: Tensor
    """int64 [n * n]: order in which pairs (observer, UAV) are shown with `own_first`"""

    def __init__(self, world: WildfireConfig, config: PositionalConfig, num_envs: int = 1):
        super().__init__(world, config, num_envs)
        inputs: list[Any] = [keys.OBSERVATION, keys.HEARS]
        self.in_keys = inputs
        self.every_step = world.measures == "all"  # UAVs that fail send nothing from then on
        own = torch.eye(world.num_uavs, dtype=torch.bool)
        self.register_buffer("_own", own, persistent=False)
        uav = torch.arange(world.num_uavs)
        order = world.num_uavs * uav.unsqueeze(-1) + (uav.unsqueeze(-1) + uav) % world.num_uavs
        self.register_buffer("_order", order.flatten(), persistent=False)

    def specs(self, observation: Composite) -> Composite:
        if self.maps is not None:
            return observation
        *batch, uavs, features = observation[keys.OBSERVATION].shape
        shape = torch.Size((*batch, uavs, uavs * features))
        observation[keys.OBSERVATION] = Unbounded(
            shape, device=observation.device, dtype=torch.float32
        )
        return observation

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self.maps is not None:
            self.maps.hear_positions(tensordict.get(keys.HEARS))
            return tensordict
        vectors = tensordict.get(keys.OBSERVATION)
        known = (tensordict.get(keys.HEARS) | self._own).unsqueeze(-1)
        joined = torch.where(known, vectors.unsqueeze(-3), 0.0)
        if self.config.own_first:
            pairs = joined.flatten(-3, -2).index_select(-2, self._order)
            joined = pairs.unflatten(-2, joined.shape[-3:-1])
        return tensordict.set(keys.OBSERVATION, joined.flatten(-2))

    def bytes_sent(self, tensordict: TensorDictBase) -> Tensor:
        """Returns 24 for each UAV, the six float32 numbers of its vector; 12 for a position."""
        said = keys.FEATURES if self.maps is None else "xyz"
        return torch.full_like(tensordict.get(keys.HEARS)[..., 0], 4 * len(said), dtype=torch.int64)
