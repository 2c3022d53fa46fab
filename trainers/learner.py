"""DDPG for all UAVs at once (Lillicrap et al. 2016; paper, section III.C)."""

from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.objectives import DDPGLoss, SoftUpdate, group_optimizers

from emberlink.envs import keys
from emberlink.policies.actor_critic import STATE_ACTION_VALUE

from .config import LearnerConfig
from .memory import DONE, TERMINATED


class Learner:
    """Updates every UAV's actor, critic and their targets from its own batch.

    Args:
        actor, critic: the UAVs' networks, stacked; updated in place.
        config: the learner's constants.
    """

    def __init__(self, actor: TensorDictModule, critic: TensorDictModule, config: LearnerConfig):
        self.loss = DDPGLoss(actor, critic, delay_actor=True, delay_value=True, reduction="none")
        self.loss.set_keys(
            state_action_value=STATE_ACTION_VALUE,
            reward=keys.REWARD,
            done=DONE,
            terminated=TERMINATED,
        )
        self.loss.make_value_estimator(gamma=config.gamma)
        actor_parameters, critic_parameters = self._parameters("actor"), self._parameters("value")
        # Capturable: Adam's count of steps is on the device too, where a CUDA graph can add to it.
        adam = partial(torch.optim.Adam, fused=True, capturable=actor_parameters[0].is_cuda)
        self.optimizer = group_optimizers(
            adam(actor_parameters, lr=config.actor_lr),
            adam(critic_parameters, lr=config.critic_lr, weight_decay=config.critic_weight_decay),
        )
        self.targets = SoftUpdate(self.loss, tau=config.tau)

    def _parameters(self, network: str) -> list[Tensor]:
        tree = getattr(self.loss, f"{network}_network_params")
        return list(tree.values(include_nested=True, leaves_only=True))

    def losses(self, batch: TensorDictBase) -> tuple[Tensor, Tensor]:
        """The actors' and the critics' losses, one per UAV: [uavs] each.

        The mean is over a UAV's batch alone: averaged over UAVs as well, every gradient would
        shrink with the size of the team.
        """
        critic: Any = self.loss.value_network
        with critic.module.sharing():
            losses = self.loss(batch)
        return losses["loss_actor"].mean(0), losses["loss_value"].mean(0)

    def update(self, batch: TensorDictBase) -> tuple[Tensor, Tensor]:
        """One step of both optimisers and of the targets.

        Args:
            batch: a sample of `make_memory`'s, batch size [batch].

        Returns:
            The actors' and the critics' losses before the step, [uavs] each, detached.
        """
        actor, critic = self.losses(batch)
        (actor + critic).sum().backward()
        self.optimizer.step()
        self.optimizer.zero_grad()
        self.targets.step()
        return actor.detach(), critic.detach()
