"""The common part of learners with a replay buffer and target networks (DDPG, TD3)."""

from abc import abstractmethod
from collections.abc import Mapping
from functools import partial
from typing import Annotated, Any, ClassVar

import torch
from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import Tensor
from torchrl.objectives import LossModule, SoftUpdate, group_optimizers

from emberlink.envs import keys
from emberlink.envs.utils.errors import UserError
from emberlink.policies.exploration import ExplorationConfig, OrnsteinUhlenbeck
from emberlink.policies.networks import STATE_ACTION_VALUE
from emberlink.trainers.learners.base import (
    STRICT,
    Count,
    Learner,
    LearnerConfig,
    LearnerContext,
    Losses,
    NotNegative,
    Positive,
    generators,
)
from emberlink.trainers.learners.replay_buffer import DONE, TERMINATED, ReplayMemory
from emberlink.trainers.learners.tensors import (
    copy_into,
    group,
    load_optimizer,
    optimizer_tensors,
    prefixed,
)
from emberlink.trainers.rollout.cuda_graphs import graphed


@dataclass(frozen=True, kw_only=True, config=STRICT)
class OffPolicyConfig(LearnerConfig):
    """The settings of learners with a replay buffer and target networks."""

    gamma: Annotated[float, Field(ge=0, lt=1)]
    """discount per step"""
    actor_lr: Positive
    """Adam's learning rate of the actors"""
    critic_lr: Positive
    """Adam's learning rate of the critics"""
    critic_weight_decay: NotNegative
    """L2 penalty in the critics' Adam"""
    tau: Annotated[float, Field(gt=0, le=0.5)]
    """share of the networks in their targets per update of the targets"""
    updates_per_step: Count
    """updates of every UAV's networks per step of all environments side by side"""
    batch_size: Annotated[int, Field(ge=1, le=1_000_000)]
    """transitions per UAV and update"""
    buffer_size: Count
    """transitions that a replay memory holds"""
    exploration: ExplorationConfig

    @model_validator(mode="after")
    def _a_batch_fits(self) -> "OffPolicyConfig":
        if self.batch_size > self.buffer_size:
            raise UserError(
                f"batch_size={self.batch_size} is more than buffer_size={self.buffer_size} holds"
            )
        return self


class OffPolicyLearner(Learner):
    """Updates actors and critics from replayed transitions; a subclass gives the losses."""

    critic_name: ClassVar[str]
    """what TorchRL's loss calls the critic: "value" or "qvalue\""""

    def __init__(self, config: OffPolicyConfig, context: LearnerContext):
        self.config, self.teams = config, len(context.seeds)
        self.guard = context.guard
        self.loss = self.make_loss(context, generators(context.seeds))
        self.loss.set_keys(
            state_action_value=STATE_ACTION_VALUE,
            reward=keys.REWARD,
            done=DONE,
            terminated=TERMINATED,
        )
        self.loss.make_value_estimator(gamma=config.gamma)
        # Tells the loss that its targets are moved; `_move_targets` does it.
        SoftUpdate(self.loss, tau=config.tau)
        parts: list[Any] = [self.actor, OrnsteinUhlenbeck(config.exploration)]
        self.explorer = TensorDictSequential(*parts)
        self.parameters = self._trained("actor") | self._trained(self.critic_name, "critic")
        self._make_optimizer()
        self.replay = ReplayMemory(
            context, batch_size=config.batch_size, buffer_size=config.buffer_size
        )
        self.learning_starts = self.replay.learning_starts
        self._graphs = {
            moves: graphed(partial(self._sample_and_update, moves), context.device)
            for moves in (False, True)
        }

    @abstractmethod
    def make_loss(self, context: LearnerContext, generators: list[torch.Generator]) -> LossModule:
        """Sets `actor` and returns TorchRL's loss for it and new critics, reduction "none"."""

    @abstractmethod
    def losses(self, batch: TensorDictBase, *, actor: bool = True) -> Losses:
        """Computes the losses, one per UAV, with gradients.

        The mean is over a UAV's batch alone: averaged over UAVs as well, every gradient would
        shrink with the size of the team.

        Args:
            batch: batch size [batch].
            actor: whether the actors are updated too.
        """

    def moves_actor(self, update: int) -> bool:
        """Returns whether an update, counted from 1, moves the actors and the targets too."""
        return True

    def sample(self) -> TensorDictBase:
        """Draws the batch of an update, batch size [batch]."""
        return self.replay.sample()

    def gradients(self) -> dict[str, Tensor]:
        """Returns the gradients that are there by parameter, [uavs, ...] each."""
        named = self.parameters.items()
        return {name: value.grad for name, value in named if value.grad is not None}

    def learn(self, rollout: TensorDictBase) -> list[Losses]:
        """Stores a rollout and makes the updates of its step, once there is a full batch."""
        self.replay.extend(rollout)
        if not self.replay.ready:
            return []
        losses = []
        for _ in range(self.config.updates_per_step):
            self.updates += 1
            update = self._graphs[self.moves_actor(self.updates)]()
            losses.append({name: value.clone() for name, value in update.items()})
        return losses

    def update(self, batch: TensorDictBase) -> Losses:
        """Makes one step of the optimizers and of the targets."""
        self.updates += 1
        return self._update(batch, self.moves_actor(self.updates))

    def _sample_and_update(self, actor: bool) -> Losses:
        return self._update(self.sample(), actor)

    def _update(self, batch: TensorDictBase, actor: bool) -> Losses:
        """Changes nothing once the guard has found something."""
        self.guard.record_batch(batch)
        losses = self.losses(batch, actor=actor)
        torch.stack([*losses.values()]).sum().backward()
        losses = {name: value.detach() for name, value in losses.items()}
        self.guard.check_gradients(losses, self.gradients())
        self.optimizer.step()
        self.optimizer.zero_grad()
        if actor:
            self._move_targets()
        return losses

    def _move_targets(self) -> None:
        """Moves the target networks the share `tau` of the way to the networks."""
        for name in ("actor", self.critic_name):
            networks, targets = (
                [
                    leaf.data
                    for leaf in getattr(self.loss, f"{kind}_network_params").values(True, True)
                ]
                for kind in (name, f"target_{name}")
            )
            share = self.guard.share(self.config.tau).to(targets[0].dtype)
            torch._foreach_lerp_(targets, networks, [share] * len(targets))  # pyright: ignore[reportPrivateImportUsage]

    def _trained(self, network: str, name: str = "") -> dict[str, Tensor]:
        """Returns a network's parameters in the order of the layers, "actor.first.weight" first."""
        tree = getattr(self.loss, f"{network}_network_params")
        items = tree.items(include_nested=True, leaves_only=True)
        return {
            ".".join((name or network, *key[key.index("module") + 1 :])): value
            for key, value in items
        }

    def _make_optimizer(self) -> None:
        config = self.config
        actor, critic = (
            [value for name, value in self.parameters.items() if name.startswith(network)]
            for network in ("actor.", "critic.")
        )
        # Capturable: Adam's count of steps is on the device too, where a CUDA graph can add to it.
        adam = partial(torch.optim.Adam, fused=True, capturable=actor[0].is_cuda)
        self.optimizer = group_optimizers(
            adam(actor, lr=config.actor_lr),
            adam(critic, lr=config.critic_lr, weight_decay=config.critic_weight_decay),
        )
        self.optimizer.found_inf = self.guard.bad  # pyright: ignore[reportAttributeAccessIssue]
        self._rates = [entry["lr"] for entry in self.optimizer.param_groups]

    def scale_lr(self, scale: float) -> None:
        for entry, rate in zip(self.optimizer.param_groups, self._rates, strict=True):
            entry["lr"] = scale * rate

    def networks(self) -> dict[str, Tensor]:
        """Returns the weights of all seeds' networks and targets by name, as they lie in memory."""
        return {name: v for name, v in self.loss.state_dict().items() if "_params." in name}

    def weights(self, team: int = 0) -> dict[str, Tensor]:
        return {
            name: value.detach().unflatten(0, (self.teams, -1))[team]
            for name, value in self.networks().items()
        }

    def state_dict(self, *, transitions: bool = True) -> dict[str, Tensor]:
        return prefixed(
            networks=self.networks(),
            optimizer=optimizer_tensors(self.optimizer),
            counters={"updates": torch.tensor(self.updates)},
            replay=self.replay.state_dict(transitions=transitions),
        )

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        copy_into(self.networks(), group(state, "networks"))
        load_optimizer(self.optimizer, group(state, "optimizer"))
        self.updates = int(state["counters/updates"])
        self.replay.load_state_dict(group(state, "replay"))
