"""Remembers the inputs of the last decisions."""

from typing import ClassVar

import torch
from torch import Tensor

from emberlink.policies.networks.layers import Generators
from emberlink.policies.networks.memory.base import Memory
from emberlink.policies.settings import PolicyConfig


class Stack(Memory):
    """Concatenates the inputs of the last `policy.decisions` decisions, the oldest first.

    Inputs before the beginning of the episode are 0.
    """

    settings: ClassVar[tuple[str, ...]] = "policy.decisions", "learner.sequence", "learner.burn_in"

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
        self.decisions = config.decisions
        self.features, self.size = config.decisions * inputs, (config.decisions - 1) * inputs

    @classmethod
    def burn_in(cls, config: PolicyConfig) -> int:
        return config.decisions - 1

    def forward(self, x: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        before = state.unflatten(-1, (self.decisions - 1, -1))
        every = torch.cat((before, x), 2)
        last = every[:, :, -(self.decisions - 1) :].flatten(2)
        # [groups, rows, decisions, inputs, stacked] -> the stacked inputs one after another
        return every.unfold(2, self.decisions, 1).transpose(-1, -2).flatten(3), last
