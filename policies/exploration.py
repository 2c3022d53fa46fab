"""Exploration: Ornstein-Uhlenbeck noise on the actions."""

import math
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.utils import ExplorationType, exploration_type

from emberlink.envs import keys
from emberlink.envs.utils import counter_rng
from emberlink.envs.utils.counter_rng import Use

NOISE = (keys.AGENTS, "noise")
"""float32 [..., 3]: the process, carried from step to step."""


class OrnsteinUhlenbeck(TensorDictModuleBase):
    """x += theta * (0 - x) * dt + sigma * sqrt(dt) * N(0, 1), added to the action and clipped.

    It starts from 0 with each episode and does not fade: the paper anneals nothing. Its numbers
    come from the environment's own random stream, so that an environment's noise does not depend
    on how many run beside it, nor on the device. (TorchRL's module draws from the global generator
    and steps back through it for one batch as a whole.) Where exploration is off
    (`torchrl.envs.set_exploration_type`), actions are left as they are.

    Args:
        theta: pull towards 0.
        sigma: strength of the noise.
        dt: length of a step.
    """

    def __init__(self, *, theta: float, sigma: float, dt: float):
        super().__init__()
        self.keep, self.shock = 1 - theta * dt, sigma * math.sqrt(dt)
        reads: list[Any] = [keys.ACTION, keys.RNG_KEY, keys.STEP]
        writes: list[Any] = [keys.ACTION, NOISE]
        self.in_keys, self.out_keys = reads, writes

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        if exploration_type() not in (None, ExplorationType.RANDOM):
            return tensordict
        action, step = tensordict.get(keys.ACTION), tensordict.get(keys.STEP)
        moment = counter_rng.step_key(tensordict.get(keys.RNG_KEY), step, Use.EXPLORATION_NOISE)
        normal = counter_rng.normal(moment, action.shape[-2] * action.shape[-1]).view_as(action)
        before = tensordict.get(NOISE, None)
        if before is None:
            before = torch.zeros_like(action)
        before = before.masked_fill((step == 0)[:, None, None], 0.0)
        noise = self.keep * before + self.shock * normal
        tensordict.set(NOISE, noise)
        return tensordict.set(keys.ACTION, (action + noise).clamp(-1, 1))
