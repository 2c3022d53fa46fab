"""Messages that are learned: how UAVs make them, and how a UAV joins the messages that it hears.

At a decision, each UAV makes a message from its features; the UAVs that hear it by the radio of the
world read the message at the same decision or, where the radio is late (`env.radio.delay`), at the
first decision at or after its arrival. Numbers are rounded to 8 bits, with the gradient of the
number before (straight-through, Bengio et al. 2013). Gradients flow from the hearer to the weights
of the speaker, also to an earlier decision. A subclass of `Messages` is a new scheme.
"""

import math
from abc import abstractmethod
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from emberlink.envs.config import RadioConfig
from emberlink.envs.utils.plugins import Plugins
from emberlink.policies.networks.grouping import Grouping
from emberlink.policies.networks.layers import StackedLinear
from emberlink.policies.settings import PolicyConfig

_LEVELS = 127


class Messages(nn.Module):
    """Maps the features of a team's UAVs to what each of them hears.

    Args:
        grouping: which UAVs share weights.
        inputs: number of features of a UAV.
        size: numbers of a message.
        start: see `layers.Start`.
    """

    key_size: ClassVar[int] = 0
    """numbers of a message besides its `size`, each a byte"""
    fault: str = "none"
    """what happens to messages on their way: with `none` nothing, with `zero` their numbers become
    0, with `shuffle` a UAV hears the message of another UAV in another environment instead"""

    def __init__(self, grouping: Grouping, inputs: int, size: int, **start: Any):
        super().__init__()
        self.grouping, self.numbers = grouping, size + self.key_size
        self.say = StackedLinear(grouping.groups, inputs, size, gain=1.0, **start)
        if self.key_size:
            self.key = StackedLinear(grouping.groups, inputs, self.key_size, gain=1.0, **start)

    def speak(self, features: Tensor, batch: torch.Size) -> tuple[Tensor, Tensor]:
        """Returns the messages of UAVs, [envs, uavs, size], and their keys, [envs, uavs, key_size].

        Args:
            features: [groups, rows, inputs], see `Grouping.split`.
            batch: [envs, uavs].
        """
        message = self.grouping.join(eight_bits(self.say(features)), batch)
        if not self.key_size:
            return message, message[..., :0]
        return message, self.grouping.join(eight_bits(self.key(features)), batch)

    def forward(self, features: Tensor, message: Tensor, key: Tensor, hears: Tensor) -> Tensor:
        """Returns what UAVs hear, [groups, rows, size]; 0 for a UAV that hears nobody.

        Args:
            features: of the hearers, [groups, rows, inputs].
            message, key: what arrives now, see `speak`.
            hears: bool [envs, uavs, uavs], whether it arrives at a UAV (row) from another one
                (column).
        """
        message, key = self.arrive(message), self.arrive(key)
        weights = self.weights(features, key, hears).masked_fill(~hears, 0.0)
        return self.grouping.split(weights.to(message.dtype) @ message, hears.shape[:2])

    def arrive(self, said: Tensor) -> Tensor:
        """Returns numbers that UAVs say, [envs, uavs, numbers], as others hear them: see `fault`.

        Shuffled, UAV i of environment e has the numbers of UAV i - 1 of environment e - 1.
        """
        if self.fault == "zero":
            return torch.zeros_like(said)
        if self.fault == "shuffle":
            return said.roll((1, 1), (0, 1))
        return said

    @abstractmethod
    def weights(self, features: Tensor, key: Tensor, hears: Tensor) -> Tensor:
        """Returns the weight of each message (column) for a UAV (row), [envs, uavs, uavs].

        Weights of messages that are not heard have no effect.

        Args:
            features, hears: see `forward`.
            key: of the messages, [envs, uavs, key_size].
        """


class Mean(Messages):
    """Takes the mean of the messages that a UAV hears (CommNet, Sukhbaatar et al. 2016)."""

    def weights(self, features: Tensor, key: Tensor, hears: Tensor) -> Tensor:
        return hears / hears.sum(-1, keepdim=True).clamp(min=1)


class Attention(Messages):
    """Weighs messages by their keys (TarMAC, Das et al. 2019, ICML).

    A message is a value and a key; the weights are the softmax of the products of the keys with the
    hearer's query, over the messages that it hears.
    """

    key_size = 8

    def __init__(self, grouping: Grouping, inputs: int, size: int, **start: Any):
        super().__init__(grouping, inputs, size, **start)
        self.query = StackedLinear(grouping.groups, inputs, self.key_size, gain=1.0, **start)

    def weights(self, features: Tensor, key: Tensor, hears: Tensor) -> Tensor:
        query = self.grouping.join(self.query(features), hears.shape[:2])
        scores = (query @ key.mT / math.sqrt(self.key_size)).masked_fill(~hears, -torch.inf)
        # A UAV that hears nobody has no softmax.
        return scores.masked_fill(~hears.any(-1, keepdim=True), 0.0).softmax(-1)


def eight_bits(x: Tensor) -> Tensor:
    """Returns tanh(x), rounded to one of 255 numbers, with the gradient of tanh(x)."""
    y = x.tanh()
    return y + ((y * _LEVELS).round() / _LEVELS - y).detach()


MESSAGES = Plugins(Messages, "emberlink.messages", "policy.message")


def message_bytes(policy: PolicyConfig) -> int:
    """Returns the bytes that a UAV sends at a decision, 0 without messages."""
    if policy.message == "none":
        return 0
    return policy.message_size + MESSAGES.find(policy.message).key_size


def message_lag(policy: PolicyConfig, radio: RadioConfig) -> int:
    """Returns the decisions from saying a message to hearing it, 0 without messages."""
    return 0 if policy.message == "none" else -(-radio.delay // policy.hold)
