"""The actors and critics that learn from batches of a replay buffer."""

from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from emberlink.envs import keys
from emberlink.policies.networks import STATE_ACTION_VALUE, Generators, build, make_critic
from emberlink.policies.networks.recurrent import RecurrentActor, RecurrentCritic
from emberlink.policies.networks.stacked import StackedCritic
from emberlink.trainers.learners.base import LearnerContext
from emberlink.trainers.learners.off_policy.sequences import MISSING

TAKEN = (keys.AGENTS, "taken")
"""float32 [batch, uavs, ..., 3]: the actions in the replay buffer, for critics of teams; without
numbers under "next", where all UAVs take the actions of their target actors"""


def critics(config: Any, context: LearnerContext, generators: Generators) -> Any:
    """Returns new critics of all UAVs, a TensorDict module with the networks in `module`.

    Args:
        config: settings of the learner (`OffPolicyConfig`).
        context: context of the learner.
        generators: of the initial weights, one per seed.
    """
    specs, policy = (context.observation_spec, context.action_spec), context.policy
    more: dict[str, Any] = {
        "share_parameters": config.share_parameters,
        "policy": policy,
        "generator": generators,
    }
    if policy.memory == "none" and config.critic == "own":
        return make_critic(*specs, config.hidden, **more)
    kind = StackedCritic if policy.memory == "none" else RecurrentCritic
    network = build(kind, *specs, config.hidden, team=config.critic == "team", **more)
    return Critic(network, context, config)


class SequenceActor(TensorDictModuleBase):
    """Writes the actions of the decisions to learn from, given sequences of observations.

    Args:
        network: the actors of all UAVs.
        context: context of the learner.
        config: settings of the learner.
    """

    def __init__(self, network: RecurrentActor, context: LearnerContext, config: Any):
        super().__init__()
        self.module, self.config = network, config
        self._observed = keys.observation_keys(context.observation_spec)
        reads: list[Any] = [*self._observed, MISSING]
        writes: list[Any] = [keys.ACTION]
        self.in_keys, self.out_keys = reads, writes

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        observations = [tensordict.get(key) for key in self._observed]
        missing, config = tensordict.get(MISSING), self.config
        action = self.module(observations, missing, config.burn_in, config.sequence)
        return tensordict.set(keys.ACTION, action)


class Critic(TensorDictModuleBase):
    """Writes the value of each UAV's action, with a memory or from what the team sees and does.

    The critic of a UAV in a team reads the observations and actions of all UAVs (MADDPG, Lowe et
    al. 2017, NeurIPS). For the actors' losses, a UAV's own action is that of its actor, and those
    of the others are from the replay buffer.

    Args:
        network: the critics of all UAVs.
        context: context of the learner.
        config: settings of the learner.
    """

    def __init__(self, network: StackedCritic, context: LearnerContext, config: Any):
        super().__init__()
        self.module, self.config = network, config
        self._observed = keys.observation_keys(context.observation_spec)
        self._remembers, self._team = context.policy.memory != "none", config.critic == "team"
        own = [MISSING] if self._remembers else []
        reads: list[Any] = [*self._observed, *own, *([TAKEN] if self._team else []), keys.ACTION]
        writes: list[Any] = [STATE_ACTION_VALUE]
        self.in_keys, self.out_keys = reads, writes

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        observations = [tensordict.get(key) for key in self._observed]
        action = tensordict.get(keys.ACTION)
        if self._team:
            action = self.module.grouping.joint(action, tensordict.get(TAKEN))
        if self._remembers:
            missing = tensordict.get(MISSING)
            value = self.module(observations, missing, self.config.burn_in, action)
        else:
            value = self.module(*observations, action)
        return tensordict.set(STATE_ACTION_VALUE, value)


def with_taken(batch: TensorDictBase) -> TensorDictBase:
    """Returns a batch with `TAKEN`; the batch does not change."""
    taken = batch.get(keys.ACTION)
    batch = batch.copy().set(TAKEN, taken)
    return batch.set(("next", *TAKEN), taken[..., :0])
