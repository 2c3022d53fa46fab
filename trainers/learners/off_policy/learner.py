"""Defines the base class of learners with a replay buffer and target networks (DDPG, TD3)."""

from abc import abstractmethod
from collections.abc import Mapping
from functools import partial
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import Tensor
from torchrl.data import Composite
from torchrl.objectives import LossModule, SoftUpdate, group_optimizers

from emberlink.envs import keys
from emberlink.policies.exploration import OrnsteinUhlenbeck
from emberlink.policies.gaussian import MemoryActor
from emberlink.policies.networks import STATE_ACTION_VALUE, Generators, build
from emberlink.policies.networks.recurrent import RecurrentActor
from emberlink.policies.settings import PolicyConfig
from emberlink.trainers.learners.anchor import Anchor
from emberlink.trainers.learners.base import (
    Learner,
    LearnerContext,
    Losses,
    copy_to_seeds,
    generators,
)
from emberlink.trainers.learners.off_policy.config import OffPolicyConfig
from emberlink.trainers.learners.off_policy.networks import SequenceActor, with_taken
from emberlink.trainers.learners.off_policy.networks import critics as make_critics
from emberlink.trainers.learners.off_policy.replay_buffer import DONE, TERMINATED, ReplayMemory
from emberlink.trainers.learners.off_policy.sequences import MISSING, SequenceMemory, fit_burn_in
from emberlink.trainers.learners.tensors import (
    copy_into,
    group,
    load_optimizer,
    optimizer_tensors,
    prefixed,
)
from emberlink.trainers.rollout.cuda_graphs import graphed


class OffPolicyLearner(Learner):
    """Updates actors and critics from replayed transitions; subclasses define the losses."""

    critic_name: ClassVar[str]
    """name of the critic in TorchRL's loss: "value" or "qvalue\""""

    def __init__(self, config: OffPolicyConfig, context: LearnerContext):
        config = fit_burn_in(config, context.horizon)
        self.config, self.teams = config, len(context.seeds)
        self._observed: list[Any] = keys.observation_keys(context.observation_spec)
        self.guard, self._remembers = context.guard, context.policy.memory != "none"
        self.loss = self.make_loss(context, generators(context.seeds))
        self.anchor = Anchor.of(self.actor.module, config, context.device)
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
        self.replay = self._make_replay(context)
        self.learning_starts = self.replay.learning_starts
        decisions = context.total_steps - self.learning_starts
        self._updates_of_run = max(1, decisions * config.updates_per_step)
        self._graphs = {
            moves: graphed(partial(self._sample_and_update, moves), context.device)
            for moves in (False, True)
        }

    def _make_replay(self, context: LearnerContext) -> ReplayMemory:
        config = self.config
        sizes: dict[str, Any] = {
            "batch_size": config.batch_size,
            "buffer_size": config.buffer_size,
            "joint": config.critic == "team",
            # A shared network learns from all UAVs anyway, and its input is the index of a column.
            "mixed": not (config.share_parameters and context.policy.agent_index),
        }
        if not self._remembers:
            return ReplayMemory(context, **sizes)
        lengths = {"sequence": config.sequence, "burn_in": config.burn_in}
        return SequenceMemory(context, **sizes, **lengths)

    @classmethod
    def make_actor(
        cls,
        config: Any,
        observation_spec: Composite,
        action_spec: Composite,
        generator: Generators = None,
        policy: PolicyConfig | None = None,
    ) -> Any:
        """Returns new actors, with a memory or without."""
        specs = observation_spec, action_spec
        if policy is None or policy.memory == "none":
            return super().make_actor(config, *specs, generator, policy)
        network = build(
            RecurrentActor,
            *specs,
            config.hidden,
            share_parameters=config.share_parameters,
            policy=policy,
            generator=generator,
        )
        return MemoryActor(network, observation_spec)

    def make_networks(
        self, context: LearnerContext, generators: list[torch.Generator], critics: int = 1
    ) -> tuple[Any, list[Any]]:
        """Sets `actor` and returns the actors and critics for TorchRL's loss of a batch.

        Args:
            context: context of the learner.
            generators: of the initial weights, one per seed.
            critics: number of critics of each UAV.
        """
        specs, config = (context.observation_spec, context.action_spec), self.config
        self.actor = self.make_actor(config, *specs, generators, context.policy)
        actor = self.actor
        if context.policy.memory != "none":
            actor = SequenceActor(actor.module, context, config)
        return actor, [make_critics(config, context, generators) for _ in range(critics)]

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
            loss: [batch, uavs], or [batch, uavs, decisions].
            batch: batch size [batch]; without `keys.ALIVE`, it consists of such transitions only.
        """
        alive = batch.get(keys.ALIVE, None)
        if loss.ndim == 3:
            loss = loss.transpose(1, 2).flatten(0, 1)
            alive = None if alive is None else alive.transpose(1, 2).flatten(0, 1)
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
            self._count_update()
            update = self._graphs[self.moves_actor(self.updates)]()
            losses.append({name: value.clone() for name, value in update.items()})
        return losses

    def update(self, batch: TensorDictBase) -> Losses:
        """Performs one step of the optimizers and of the target networks."""
        self._count_update()
        return self._update(batch, self.moves_actor(self.updates))

    def _count_update(self) -> None:
        """Counts an update; the weight of the anchor depends on the number of those before."""
        if self.anchor is not None:
            self.anchor.advance(self.updates / self._updates_of_run)
        self.updates += 1

    def _sample_and_update(self, actor: bool) -> Losses:
        return self._update(self.sample(), actor)

    def _update(self, batch: TensorDictBase, actor: bool) -> Losses:
        """Performs an update; after a detection of the guard, no weight changes."""
        self.guard.record_batch(batch)
        if self.config.critic == "team":
            batch = with_taken(batch)
        losses = self.losses(batch, actor=actor)
        if actor and self.anchor is not None:
            losses["anchor"] = self._distance(self.anchor, batch)
        torch.stack([*losses.values()]).sum().backward()
        losses = {name: value.detach() for name, value in losses.items()}
        self.guard.check_gradients(losses, self.gradients())
        self.optimizer.step()
        self.optimizer.zero_grad()
        if actor:
            self._move_targets()
        return losses

    def _distance(self, anchor: Anchor, batch: TensorDictBase) -> Tensor:
        """Returns the mean distance of each UAV's actions to those of the anchor, [uavs]."""
        inputs: list[Any] = [batch.get(key) for key in self._observed]
        if self._remembers:
            inputs = [inputs, batch.get(MISSING), self.config.burn_in, self.config.sequence]
        with torch.no_grad():
            theirs = anchor.network(*inputs)
        network: Any = self.actor.module
        return self.mean_over_batch(anchor.loss(network(*inputs), theirs), batch)

    def start_from(self, weights: Mapping[str, Tensor]) -> None:
        """Begins with the actors of another run, and target actors like them."""
        for policy in (self.actor.module, *([self.anchor.network] if self.anchor else [])):
            copy_to_seeds(policy, weights, self.teams)
        loss: Any = self.loss
        loss.target_actor_network_params.data.update_(loss.actor_network_params.data)

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
        return {name: v for name, v in self.loss.state_dict().items() if "_params." in name}

    def state_dict(self, *, transitions: bool = True) -> dict[str, Tensor]:
        return prefixed(
            networks=self.networks(),
            optimizer=optimizer_tensors(self.optimizer),
            counters={"updates": torch.tensor(self.updates)},
            anchor=self.anchor.network.state_dict() if self.anchor else {},
            replay=self.replay.state_dict(transitions=transitions),
        )

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        copy_into(self.networks(), group(state, "networks"))
        load_optimizer(self.optimizer, group(state, "optimizer"))
        self.updates = int(state["counters/updates"])
        if self.anchor is not None:
            copy_into(self.anchor.network.state_dict(), group(state, "anchor"))
        self.replay.load_state_dict(group(state, "replay"))
