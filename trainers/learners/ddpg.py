"""DDPG for all UAVs (Lillicrap et al. 2016; paper, section III.C)."""

from typing import Any

import torch
from pydantic.dataclasses import dataclass
from tensordict import TensorDictBase
from torchrl.objectives import DDPGLoss

from emberlink.trainers.learners.base import STRICT, LearnerContext, Losses
from emberlink.trainers.learners.off_policy import OffPolicyConfig, OffPolicyLearner


@dataclass(frozen=True, kw_only=True, config=STRICT)
class DDPGConfig(OffPolicyConfig):
    """Stores the settings of DDPG."""


class DDPG(OffPolicyLearner):
    """Updates the actor, the critic and their target networks of each UAV from its own batch."""

    config_type = DDPGConfig
    critic_name = "value"

    def make_loss(self, context: LearnerContext, generators: list[torch.Generator]) -> DDPGLoss:
        actor, (critic,) = self.make_networks(context, generators)
        return DDPGLoss(actor, critic, delay_actor=True, delay_value=True, reduction="none")

    def losses(self, batch: TensorDictBase, *, actor: bool = True) -> Losses:
        critic: Any = self.loss.value_network
        with critic.module.sharing():
            losses = self.loss(batch)
        return {
            "actor": self.mean_over_batch(losses["loss_actor"], batch),
            "critic": self.mean_over_batch(losses["loss_value"], batch),
        }
