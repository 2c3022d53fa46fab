"""Full communication: method 3 of the paper (section IV.E, algorithm 2)."""

import math
from typing import ClassVar

import torch
from pydantic import ConfigDict
from pydantic.dataclasses import dataclass
from tensordict import TensorDictBase
from torchrl.data import Composite, Unbounded

from emberlink.comm._radio import Radio, RadioConfig
from emberlink.comm.base import CommModule
from emberlink.envs import keys
from emberlink.envs.config import WildfireConfig


@dataclass(frozen=True, kw_only=True, config=ConfigDict(extra="forbid", strict=True))
class PositionalConfig:
    """No settings."""


class Positional(CommModule):
    """Concatenates the vectors of all UAVs, UAV 0 first, for every UAV: 6 n numbers.

    All UAVs observe the same numbers in the same order, as in algorithm 2.
    """

    config_type: ClassVar[type] = PositionalConfig

    def __init__(self, world: WildfireConfig, config: PositionalConfig, num_envs: int = 1):
        super().__init__(world, config, num_envs)
        self.radio = Radio(RadioConfig(range=math.inf))

    def specs(self, observation: Composite) -> Composite:
        *batch, uavs, features = observation[keys.OBSERVATION].shape
        shape = torch.Size((*batch, uavs, uavs * features))
        observation[keys.OBSERVATION] = Unbounded(
            shape, device=observation.device, dtype=torch.float32
        )
        return observation

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        vectors = tensordict.get(keys.OBSERVATION)
        joined = vectors.flatten(-2).unsqueeze(-2)
        return tensordict.set(keys.OBSERVATION, joined.repeat_interleave(vectors.shape[-2], -2))
