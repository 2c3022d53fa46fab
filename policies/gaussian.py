"""Policies that draw actions from normal distributions whose means are a network's outputs."""

import math
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite

from emberlink.envs import keys
from emberlink.policies.networks.sequence import GaussianNetwork
from emberlink.policies.state import Stateful, written

MEAN = (keys.AGENTS, "mean")
"""float32 [..., 3]: means of the actions"""
MEMORY = (keys.AGENTS, "memory")
"""float32 [..., size]: state of the actors' memory, and their messages in flight, carried from
decision to decision"""
LOG_PROB = (keys.AGENTS, "action_log_prob")
"""float32 [...]: logarithm of the probability density of the drawn action"""


class GaussianActor(Stateful):
    """Writes the mean action of each UAV, clipped to [-1, 1], and its new state.

    Args:
        network: the actors of all UAVs; its `step` gives mean actions and the state.
        observation_spec: of the environment.
    """

    def __init__(self, network: GaussianNetwork, observation_spec: Composite):
        observed = keys.observation_keys(observation_spec)
        if network.messages is not None:
            observed.append(keys.HEARS)
        carries = {MEMORY: network.size} if network.size else {}
        super().__init__(network.grouping.uavs, carries, reads=observed, writes=[keys.ACTION])
        self.module: Any = network
        self.observed = observed

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set(keys.ACTION, self.mean(tensordict).clamp(-1, 1))

    def mean(self, tensordict: TensorDictBase) -> Tensor:
        """Returns the means of the actions, not clipped, and writes the new state."""
        state = self.state(tensordict, MEMORY) if self.carries else None
        mean, after = self.module.step([tensordict.get(key) for key in self.observed], state)
        if self.carries:
            tensordict.set(written(MEMORY), after)
        return mean


class GaussianExplorer(Stateful):
    """Draws actions from the actors' distributions and writes their log-probabilities.

    Actions are not clipped; the environment does that. TorchRL's ProbabilisticActor draws from the
    global generator.

    Args:
        generator: of the actions, on their device.
    """

    def __init__(self, actor: GaussianActor, generator: torch.Generator):
        super().__init__(actor.uavs, {}, actor.in_keys, [*actor.out_keys, LOG_PROB])
        self.actor, self.generator = actor, generator

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        mean = self.actor.mean(tensordict)
        normal = torch.empty_like(mean).normal_(generator=self.generator)
        std = self.actor.module.std(mean.shape[:-1])
        density = -0.5 * (normal.square() + math.log(2 * math.pi)) - std.log()
        tensordict.set(LOG_PROB, density.sum(-1))
        return tensordict.set(keys.ACTION, torch.addcmul(mean, std, normal))
