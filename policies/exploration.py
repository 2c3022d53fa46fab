"""Adds Ornstein-Uhlenbeck noise to the actions for exploration."""

import math
from typing import Annotated

import torch
from pydantic import Field
from pydantic.dataclasses import dataclass
from tensordict import TensorDictBase

from emberlink.envs import keys
from emberlink.envs.utils.validation import STRICT
from emberlink.policies.state import Stateful, written

NOISE = (keys.AGENTS, "noise")
"""float32 [..., 3]: the state of the noise process, carried from step to step"""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class ExplorationConfig:
    """Ornstein-Uhlenbeck noise: x += theta * (0 - x) * dt + sigma * sqrt(dt) * N(0, 1)."""

    theta: Annotated[float, Field(ge=0, le=1e30)]
    """rate of return to 0"""
    sigma: Annotated[float, Field(ge=0, le=1e30)]
    """standard deviation per square root of time"""
    dt: Annotated[float, Field(gt=0, le=1e30)]
    """time per step"""


class OrnsteinUhlenbeck(Stateful):
    """Adds Ornstein-Uhlenbeck noise to the actions and clips them to [-1, 1].

    The process starts from 0 in each episode and is not annealed, as in the paper. TorchRL's module
    draws from the global generator, and adds noise according to a variable of the whole process.

    Args:
        generator: of the noise, on the device of the actions.
    """

    def __init__(self, config: ExplorationConfig, uavs: int, generator: torch.Generator):
        super().__init__(uavs, {NOISE: 3}, reads=[keys.ACTION], writes=[keys.ACTION])
        self.keep = 1 - config.theta * config.dt
        self.shock = config.sigma * math.sqrt(config.dt)
        self.generator = generator

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get(keys.ACTION)
        normal = torch.empty_like(action).normal_(generator=self.generator)
        noise = self.keep * self.state(tensordict, NOISE) + self.shock * normal
        tensordict.set(written(NOISE), noise)
        return tensordict.set(keys.ACTION, (action + noise).clamp(-1, 1))
