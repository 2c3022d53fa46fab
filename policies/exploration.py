"""Adds Ornstein-Uhlenbeck noise to the actions for exploration."""

import math
from typing import Annotated, Any

import torch
from pydantic import Field
from pydantic.dataclasses import dataclass
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.utils import ExplorationType, exploration_type

from emberlink.envs import keys
from emberlink.envs.utils import counter_rng
from emberlink.envs.utils.counter_rng import Use
from emberlink.envs.utils.validation import STRICT

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


class OrnsteinUhlenbeck(TensorDictModuleBase):
    """Adds Ornstein-Uhlenbeck noise to the actions and clips them to [-1, 1].

    The process starts from 0 in each episode and is not annealed, as in the paper. Random numbers
    come from each environment's random key, so the noise of an environment does not depend on the
    number of environments or on the device. (TorchRL's module draws from the global generator.) If
    exploration is off (`torchrl.envs.set_exploration_type`), the actions are unchanged.

    Args:
        config: constants of the process.
    """

    def __init__(self, config: ExplorationConfig):
        super().__init__()
        self.keep = 1 - config.theta * config.dt
        self.shock = config.sigma * math.sqrt(config.dt)
        reads: list[Any] = [keys.ACTION, keys.RNG_KEY, keys.STEP]
        writes: list[Any] = [keys.ACTION, NOISE]
        self.in_keys, self.out_keys = reads, writes

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        if exploration_type() not in (None, ExplorationType.RANDOM):
            return tensordict
        action, step = tensordict.get(keys.ACTION), tensordict.get(keys.STEP)
        key = counter_rng.step_key(tensordict.get(keys.RNG_KEY), step, Use.EXPLORATION_NOISE)
        normal = counter_rng.normal(key, action.shape[-2] * action.shape[-1]).view_as(action)
        before = tensordict.get(NOISE, None)
        if before is None:
            before = torch.zeros_like(action)
        before = before.masked_fill((step == 0)[:, None, None], 0.0)
        noise = self.keep * before + self.shock * normal
        tensordict.set(NOISE, noise)
        return tensordict.set(keys.ACTION, (action + noise).clamp(-1, 1))
