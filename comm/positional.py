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
        delay, agents = world.radio.delay, (num_envs, world.num_uavs)
        self.links = Late(delay, torch.tensor(False), *agents, world.num_uavs)
        self.said = Late(delay, torch.tensor(0.0), *agents, self.numbers)
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

    def reset(self, tensordict: TensorDictBase, mask: Tensor) -> None:
        """Forgets the messages in flight."""
        self.links.start_episodes(mask)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        hears, heard = self._converse(tensordict)
        if self.maps is None:
            return self._join(tensordict, hears, heard)
        sent = tensordict.get(keys.STEP) - self.world.radio.delay
        self.maps.hear_positions(hears, sent, heard)
        return tensordict

    def take_part(
        self, steps: TensorDictBase, last: TensorDictBase
    ) -> tuple[TensorDictBase, Tensor | None, Tensor | None]:
        if self.maps is not None:
            return super().take_part(steps, last)
        hears, heard = self._converse(steps)
        sent = self.bytes_sent(steps) if self.counts else None
        return self._join(last, hears[-1], heard[-1]), None, sent

    def _converse(self, steps: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Returns whose vectors arrive at each UAV, bool [..., n, n], and these vectors."""
        hears, left = steps.get(keys.HEARS), steps.get(keys.BUDGET, None)
        if left is not None:
            hears = hears & (left >= 4 * self.numbers).unsqueeze(-2)
        vectors = steps.get(keys.OBSERVATION if self.maps is None else keys.POSITION)
        return self.links(hears), self.said(vectors)

    def _join(self, tensordict: TensorDictBase, hears: Tensor, heard: Tensor) -> TensorDictBase:
        """Rewrites the observations of a time step, of the vectors that arrive at it."""
        vectors = tensordict.get(keys.OBSERVATION)
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
