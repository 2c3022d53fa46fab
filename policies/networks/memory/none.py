"""No memory: a decision depends on its observation alone."""

from typing import ClassVar

import torch
from torch import Tensor

from emberlink.policies.networks.layers import Generators
from emberlink.policies.networks.memory.base import Memory
from emberlink.policies.settings import PolicyConfig


class NoMemory(Memory):
    """Returns its input."""

    settings: ClassVar[tuple[str, ...]] = ()

    def __init__(
        self,
        groups: int,
        inputs: int,
        config: PolicyConfig,
        *,
        device: torch.device | str | None = None,
        generator: Generators = None,
    ):
        super().__init__(groups, inputs, config)
        self.features, self.size = inputs, 0

    def forward(self, x: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        return x, state
