"""Defines the base class of learners with a replay buffer and target networks (DDPG, TD3)."""

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
from emberlink.trainers.learners.off_policy.replay_buffer import DONE, TERMINATED, ReplayMemory
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
    """learning rate of the actors' Adam"""
    critic_lr: Positive
    """learning rate of the critics' Adam"""
    critic_weight_decay: NotNegative
    """L2 penalty in the critics' Adam"""
    tau: Annotated[float, Field(gt=0, le=0.5)]
    """soft update of the target networks: target += tau * (network - target)"""
    updates_per_step: Count
    """updates of every UAV's networks per step of the batch of environments"""
    batch_size: Annotated[int, Field(ge=1, le=1_000_000)]
    """transitions per update and UAV"""
    buffer_size: Count
    """capacity of a replay buffer, in transitions of a UAV"""
    exploration: ExplorationConfig
    """exploration noise"""

    @model_validator(mode="after")
    def _a_batch_fits(self) -> "OffPolicyConfig":
        if self.batch_size > self.buffer_size:
            raise UserError(
                f"batch_size={self.batch_size} is larger than buffer_size={self.buffer_size}"
            )
        return self


class OffPolicyLearner(Learner):
    """Updates actors and critics from replayed transitions; subclasses define the losses."""

    critic_name: ClassVar[str]
    """name of the critic in TorchRL's loss: "value" or "qvalue\""""

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
        self.loss.value_estimator.float()  # gamma, also if the default dtype is another
        # Registers an updater with the loss; `_move_targets` performs the updates.
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
        """Sets `actor` and returns TorchRL's loss of it and new critics, with reduction "none"."""

    @abstractmethod
    def losses(self, batch: TensorDictBase, *, actor: bool = True) -> Losses:
        """Computes the losses with gradients, one number per UAV.

        Losses are averaged over the batch of each UAV and not over UAVs; otherwise gradients would
        shrink with the number of UAVs.

        Args:
            batch: batch size [batch].
            actor: whether to compute the actors' losses, too.
        """

    @staticmethod
    def mean_over_batch(loss: Tensor, batch: TensorDictBase) -> Tensor:
        """Returns the mean loss of each UAV, [uavs], over the transitions in which UAVs flew.

        Args:
            loss: [batch, uavs].
            batch: batch size [batch]; without `keys.ALIVE`, UAVs cannot fail.
        """
        alive = batch.get(keys.ALIVE, None)
        if alive is None:
            return loss.mean(0)
        weight = alive.to(loss.dtype)
        return (loss * weight).sum(0) / weight.sum(0).clamp(min=1)

    def moves_actor(self, update: int) -> bool:
        """Returns whether an update, counted from 1, changes actors and target networks, too."""
        return True

    def sample(self) -> TensorDictBase:
        """Draws the batch of an update, batch size [batch]."""
        return self.replay.sample()

    def gradients(self) -> dict[str, Tensor]:
        """Returns the gradients by parameter, [uavs, ...] each, of parameters that have one."""
        named = self.parameters.items()
        return {name: value.grad for name, value in named if value.grad is not None}

    def learn(self, rollout: TensorDictBase) -> list[Losses]:
        """Stores a rollout, and performs updates if there is a full batch."""
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
        """Performs one step of the optimizers and of the target networks."""
        self.updates += 1
        return self._update(batch, self.moves_actor(self.updates))

    def _sample_and_update(self, actor: bool) -> Losses:
        return self._update(self.sample(), actor)

    def _update(self, batch: TensorDictBase, actor: bool) -> Losses:
        """Performs an update; after a detection of the guard, no weight changes."""
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
        """Performs the soft update of the target networks."""
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
        """Returns a network's parameters by name, such as "actor.first.weight", layer by layer."""
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
        # Capturable: Adam's step counter is on the device, where a CUDA graph can increment it.
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
        """Returns the weights of all seeds' networks and target networks by name, not copied."""
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
