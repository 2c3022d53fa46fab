"""Defines the base class of memories."""

from abc import abstractmethod
from typing import Any

from torch import Tensor, nn

from emberlink.envs.utils.plugins import Plugins
from emberlink.policies.settings import PolicyConfig


class Memory(nn.Module):
    """Maps the inputs of successive decisions to features of the sequence so far.

    A subclass in its own file, `policies/networks/memory/<name>.py`, is a new kind of memory. The
    first dimension of its weights is the group, see `networks.layers`.

    Args:
        groups: number of groups of weights.
        inputs: number of features of an input.
        config: settings of the policy.
        start: `device` of the weights and `generator` of their initial values.
    """

    features: int
    """number of features of the output"""
    size: int
    """numbers per UAV that are carried from decision to decision; they are 0 before the first"""

    @abstractmethod
    def __init__(self, groups: int, inputs: int, config: PolicyConfig, **start: Any):
        super().__init__()

    @abstractmethod
    def forward(self, x: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Maps the inputs of a sequence of decisions to features.

        Args:
            x: float32 [groups, rows, decisions, inputs].
            state: float32 [groups, rows, size], from the decision before the first one.

        Returns:
            Features, [groups, rows, decisions, features], and the state after the last decision.
        """


MEMORIES = Plugins(Memory, "emberlink.memory", "policy.memory")
