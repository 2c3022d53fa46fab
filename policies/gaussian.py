"""Policies that draw actions from normal distributions whose means are a network's outputs."""

import math
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.data import Composite
from torchrl.envs.utils import ExplorationType, exploration_type

from emberlink.envs import keys
from emberlink.envs.utils import counter_rng
from emberlink.envs.utils.counter_rng import Use
from emberlink.policies.networks.recurrent import RecurrentActor
from emberlink.policies.networks.sequence import GaussianNetwork

MEAN = (keys.AGENTS, "mean")
"""float32 [..., 3]: means of the actions"""
MEMORY = (keys.AGENTS, "memory")
"""float32 [..., size]: state of the actors' memory, carried from decision to decision"""
LOG_PROB = (keys.AGENTS, "action_log_prob")
"""float32 [...]: logarithm of the probability density of the drawn action"""


class MemoryActor(TensorDictModuleBase):
    """Writes the mean action of each UAV, clipped to [-1, 1], and the new state of its memory.

    The memory is empty at step 0 of an episode, and if the TensorDict holds no state of it.

    Args:
        network: the actors of all UAVs; its `step` gives mean actions and the memory's state.
        observation_spec: of the environment.
    """

    def __init__(self, network: GaussianNetwork | RecurrentActor, observation_spec: Composite):
        super().__init__()
        self.module: Any = network
        self._observed = keys.observation_keys(observation_spec)
        remembers = network.memory.size > 0
        reads: list[Any] = [*self._observed, *([keys.STEP] if remembers else [])]
        writes: list[Any] = [keys.ACTION, MEAN, *([MEMORY] if remembers else [])]
        self.in_keys, self.out_keys = reads, writes

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        observations = [tensordict.get(key) for key in self._observed]
        mean, after = self.module.step(observations, self._state(tensordict))
        tensordict.set(MEAN, mean)
        if after.shape[-1]:
            tensordict.set(MEMORY, after)
        return tensordict.set(keys.ACTION, mean.clamp(-1, 1))

    def _state(self, tensordict: TensorDictBase) -> Tensor | None:
        state = tensordict.get(MEMORY, None)
        if state is None or MEMORY not in self.out_keys:
            return None
        began = tensordict.get(keys.STEP) == 0
        return state.masked_fill(began[..., None, None], 0.0)


class GaussianExplorer(TensorDictModuleBase):
    """Draws actions from the actors' distributions and writes their log-probabilities.

    Random numbers come from each environment's random key, as in `OrnsteinUhlenbeck`. Actions are
    not clipped; the environment does that. If exploration is off
    (`torchrl.envs.set_exploration_type`), the actions are those of the actors.

    Args:
        actor: the actors of all UAVs.
    """

    def __init__(self, actor: MemoryActor):
        super().__init__()
        self.actor = actor
        reads: list[Any] = list(dict.fromkeys([*actor.in_keys, keys.RNG_KEY, keys.STEP]))
        writes: list[Any] = [*actor.out_keys, LOG_PROB]
        self.in_keys, self.out_keys = reads, writes

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.actor(tensordict)
        if exploration_type() not in (None, ExplorationType.RANDOM):
            return tensordict
        mean = tensordict.get(MEAN)
        step = tensordict.get(keys.STEP)
        key = counter_rng.step_key(tensordict.get(keys.RNG_KEY), step, Use.EXPLORATION_NOISE)
        normal = counter_rng.normal(key, mean.shape[-2] * mean.shape[-1]).view_as(mean)
        std = self.actor.module.std(mean.shape[:-1])
        density = -0.5 * (normal.square() + math.log(2 * math.pi)) - std.log()
        tensordict.set(LOG_PROB, density.sum(-1))
        return tensordict.set(keys.ACTION, torch.addcmul(mean, std, normal))
