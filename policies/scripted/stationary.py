"""A scripted policy that never moves."""

import torch
from tensordict import TensorDictBase

from emberlink.envs import keys
from emberlink.policies.scripted.base import Scripted


class Stationary(Scripted):
    """Stays at the start position."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set(keys.ACTION, torch.zeros_like(tensordict.get(keys.POSITION)))
