"""No memory: a decision depends on its observation alone."""

from typing import Any

from torch import Tensor

from emberlink.policies.networks.memory.base import Memory
from emberlink.policies.settings import PolicyConfig


class NoMemory(Memory):
    """Returns its input."""

    def __init__(self, groups: int, inputs: int, config: PolicyConfig, **start: Any):
        super().__init__(groups, inputs, config)
        self.features, self.size = inputs, 0

    def forward(self, x: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        return x, state
