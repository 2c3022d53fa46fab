"""Everyone hears everyone: method 3 of the paper (section IV.E, algorithm 2)."""

from typing import ClassVar

import torch
from pydantic import ConfigDict
from pydantic.dataclasses import dataclass
from tensordict import TensorDictBase
from torchrl.data import Composite, Unbounded

from emberlink.envs import keys

from .base import CommModule


@dataclass(frozen=True, kw_only=True, config=ConfigDict(extra="forbid", strict=True))
class PositionalConfig:
    """There is nothing to set."""


class Positional(CommModule):
    """Gives every UAV the concatenation of all UAVs' vectors, UAV 0 first: 6 n numbers.

    The order is the same for all, as in algorithm 2: a UAV tells its own place by its networks,
    which are its own.
    """

    config_type: ClassVar[type] = PositionalConfig

    def specs(self, observation: Composite) -> Composite:
        *batch, uavs, features = observation[keys.OBSERVATION].shape
        shape = torch.Size((*batch, uavs, uavs * features))
        observation[keys.OBSERVATION] = Unbounded(shape, device=observation.device)
        return observation

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        own = tensordict.get(keys.OBSERVATION)
        everyone = own.flatten(-2).unsqueeze(-2)
        return tensordict.set(keys.OBSERVATION, everyone.repeat_interleave(own.shape[-2], -2))
