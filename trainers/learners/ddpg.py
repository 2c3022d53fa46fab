"""DDPG for all UAVs at once (Lillicrap et al. 2016; paper, section III.C)."""

from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.objectives import DDPGLoss, SoftUpdate, group_optimizers

from emberlink.envs import keys
from emberlink.policies.networks.actor_critic import STATE_ACTION_VALUE
from emberlink.trainers.config.schema import LearnerConfig

from .nan_guard import Watch
from .replay_buffer import DONE, TERMINATED


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
        self._rates = [group["lr"] for group in self.optimizer.param_groups]
        self.watch = Watch(self._named("actor") | self._named("value", "critic"))
        self.optimizer.found_inf = self.watch.bad  # pyright: ignore[reportAttributeAccessIssue]
        self.targets = _Targets(self.loss, config.tau, self.watch)

    def _parameters(self, network: str) -> list[Tensor]:
        return list(self._named(network).values())

    def _named(self, network: str, name: str = "") -> dict[str, Tensor]:
        """A network's tensors in the order in which they are used, "actor.first.weight" first."""
        tree = getattr(self.loss, f"{network}_network_params")
        items = tree.items(include_nested=True, leaves_only=True)
        return {".".join((name or network, *key[1:])): value for key, value in items}

    def slow_down(self, rate: float) -> None:
        """Sets the learning rates to this share of the configuration's."""
        for group, full in zip(self.optimizer.param_groups, self._rates, strict=True):
            group["lr"] = rate * full

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
        """One step of both optimisers and of the targets; none once something is not finite.

        Args:
            batch: a sample of `make_memory`'s, batch size [batch].

        Returns:
            The actors' and the critics' losses before the step, [uavs] each, detached.
        """
        self.watch.drawn(batch)
        actor, critic = self.losses(batch)
        (actor + critic).sum().backward()
        actor, critic = actor.detach(), critic.detach()
        self.watch.learnt(torch.stack((actor, critic)))
        self.optimizer.step()
        self.optimizer.zero_grad()
        self.watch.updated()
        self.targets.step()
        return actor, critic


class _Targets(SoftUpdate):
    """Soft updates that stop where the watch has found something."""

    def __init__(self, loss: DDPGLoss, tau: float, watch: Watch):
        super().__init__(loss, tau=tau)
        self._tau, self._watch = tau, watch

    def _step(self, p_source: Any, p_target: Any) -> None:
        sources, targets = (
            [one.data for one in tree.values(include_nested=True, leaves_only=True)]
            for tree in (p_source, p_target)
        )
        share = self._watch.share(self._tau).to(targets[0].dtype)
        torch._foreach_lerp_(targets, sources, [share] * len(targets))  # pyright: ignore[reportPrivateImportUsage]
