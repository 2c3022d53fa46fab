"""Full communication: method 3 of the paper (section IV.E, algorithm 2)."""

from typing import ClassVar

import torch
from pydantic.dataclasses import dataclass
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded

from emberlink.comm.base import CommModule
from emberlink.envs import keys
from emberlink.envs.config import WildfireConfig
from emberlink.envs.utils.validation import STRICT
from emberlink.envs.world.radio import Late


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
    heeds_packets: ClassVar[bool] = True
    units: ClassVar[tuple[str, ...]] = ("own_first",)

    _own: Tensor
    _order: Tensor
    """int64 [n, n, 1]: the UAVs in the order in which a UAV (row) observes them with `own_first`"""

    def __init__(self, world: WildfireConfig, config: PositionalConfig, num_envs: int = 1):
        super().__init__(world, config, num_envs)
        self.numbers = len(keys.FEATURES if self.maps is None else "xyz")
        sent = world.radio.delay, num_envs
        self.links = Late(*sent, torch.tensor(False), *[world.num_uavs] * 2)
        self.said = Late(*sent, torch.tensor(0.0), world.num_uavs, self.numbers)
        # UAVs that fail send nothing from then on, and late messages may be of any step.
        self.every_step = world.measures == "all" or world.radio.delay > 0
        own = torch.eye(world.num_uavs, dtype=torch.bool)
        self.register_buffer("_own", own, persistent=False)
        uav = torch.arange(world.num_uavs)
        order = (uav.unsqueeze(-1) + uav) % world.num_uavs
        self.register_buffer("_order", order.unsqueeze(-1), persistent=False)

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
        step, left = tensordict.get(keys.STEP), tensordict.get(keys.BUDGET, None)
        vectors = tensordict.get(keys.OBSERVATION if self.maps is None else keys.POSITION)
        hears = tensordict.get(keys.HEARS)
        if left is not None:
            hears = hears & (left >= 4 * self.numbers).unsqueeze(-2)
        hears, heard = self.links(step, hears), self.said(step, vectors)
        if self.maps is not None:
            self.maps.hear_positions(hears, step - self.world.radio.delay, heard)
            return tensordict
        joined = torch.where(hears.unsqueeze(-1), heard.unsqueeze(-3), 0.0)
        joined = torch.where(self._own.unsqueeze(-1), vectors.unsqueeze(-3), joined)
        if self.config.own_first:
            joined = joined.gather(-2, self._order.expand_as(joined))
        return tensordict.set(keys.OBSERVATION, joined.flatten(-2))

    def bytes_sent(self, tensordict: TensorDictBase) -> Tensor:
        """Returns 24 for each UAV, the six float32 numbers of its vector; 12 for a position."""
        size, left = 4 * self.numbers, tensordict.get(keys.BUDGET, None)
        sent = torch.full_like(tensordict.get(keys.HEARS)[..., 0], size, dtype=torch.int64)
        return sent if left is None else sent * (left >= size)
