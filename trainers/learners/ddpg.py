"""DDPG for all UAVs (Lillicrap et al. 2016; paper, section III.C)."""

from typing import Any

import torch
from pydantic.dataclasses import dataclass
from tensordict import TensorDictBase
from torchrl.objectives import DDPGLoss

from emberlink.policies.networks import make_critic
from emberlink.trainers.learners.base import STRICT, LearnerContext, Losses
from emberlink.trainers.learners.off_policy import OffPolicyConfig, OffPolicyLearner


@dataclass(frozen=True, kw_only=True, config=STRICT)
class DDPGConfig(OffPolicyConfig):
    """The settings of DDPG."""


class DDPG(OffPolicyLearner):
    """Updates the actor, the critic and their target networks of each UAV from its own batch."""

    config_type = DDPGConfig
    critic_name = "value"

    def make_loss(self, context: LearnerContext, generators: list[torch.Generator]) -> DDPGLoss:
        specs = context.observation_spec, context.action_spec
        self.actor = self.make_actor(self.config, *specs, generators, context.policy)
        critic = make_critic(
            *specs,
            self.config.hidden,
            generator=generators,
            share_parameters=self.config.share_parameters,
            agent_index=context.policy.agent_index,
        )
        return DDPGLoss(self.actor, critic, delay_actor=True, delay_value=True, reduction="none")

    def losses(self, batch: TensorDictBase, *, actor: bool = True) -> Losses:
        critic: Any = self.loss.value_network
        with critic.module.sharing():
            losses = self.loss(batch)
        return {
            "actor": self.mean_over_batch(losses["loss_actor"], batch),
            "critic": self.mean_over_batch(losses["loss_value"], batch),
        }
