"""Defines the base class of learners from whole episodes (IPPO, MAPPO)."""

import math
from abc import abstractmethod
from collections.abc import Iterator, Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.data import Composite

from emberlink.envs import keys
from emberlink.envs.utils import counter_rng
from emberlink.envs.utils.counter_rng import Use
from emberlink.policies.gaussian import LOG_PROB, GaussianExplorer, MemoryActor
from emberlink.policies.networks import Generators
from emberlink.policies.networks.sequence import GaussianNetwork
from emberlink.policies.settings import PolicyConfig
from emberlink.trainers.learners.anchor import Anchor
from emberlink.trainers.learners.base import (
    ACTOR,
    Learner,
    LearnerContext,
    Losses,
    copy_to_seeds,
    generators,
)
from emberlink.trainers.learners.on_policy.advantages import Advantages
from emberlink.trainers.learners.on_policy.config import OnPolicyConfig
from emberlink.trainers.learners.on_policy.proximal import (
    ADVANTAGE,
    RETURN,
    VALUE,
    clip_by_row,
    make_loss,
    mean_of_uavs,
)
from emberlink.trainers.learners.tensors import (
    copy_into,
    flatten,
    group,
    load_optimizer,
    optimizer_tensors,
    prefixed,
    unflatten,
)

_CRITIC = "critic_network_params.module."


class OnPolicyLearner(Learner):
    """Updates actors and critics after each episode, from the episode of every environment.

    Subclasses define the critics.
    """

    config: OnPolicyConfig

    def __init__(self, config: OnPolicyConfig, context: LearnerContext):
        self.config, self.context, self.teams = config, context, len(context.seeds)
        self.guard, self.device = context.guard, context.device
        self._observed: list[Any] = keys.observation_keys(context.observation_spec)
        new = generators(context.seeds)
        self.actor = self.make_actor(
            config, context.observation_spec, context.action_spec, new, context.policy
        )
        self.critic: Any = self.make_critic(context, new)
        self._critics = len(next(self.critic.module.parameters()))
        """number of critics of all seeds"""
        self._set_log_std()
        self.explorer = GaussianExplorer(self.actor)
        self.loss = make_loss(
            self.actor, self.critic, clip=config.clip, entropy=config.entropy, device=self.device
        )
        self.anchor = Anchor.of(self.actor.module, config, self.device)
        self.parameters = {f"actor.{k}": v for k, v in self.actor.module.named_parameters()}
        self.parameters |= {f"critic.{k}": v for k, v in self.critic.module.named_parameters()}
        values = list(self.parameters.values())
        self.optimizer = torch.optim.Adam(values, lr=config.lr, eps=1e-5, fused=True)
        self.optimizer.found_inf = self.guard.bad  # pyright: ignore[reportAttributeAccessIssue]
        self._lr_scale = 1.0
        self.learning_starts = context.horizon
        self.advantages = Advantages(config.gamma, config.gae_lambda, self._groups, self.device)
        self._decisions: list[TensorDictBase] = []
        """transitions of the current episode, batch size [seeds * environments, 1] each"""
        self._count = 0
        """decisions so far, in the whole run"""
        seeds = torch.tensor(context.seeds, device=self.device)
        self._keys = counter_rng.fold_in(seeds, Use.MINIBATCH)
        rows = torch.arange(self.teams * context.num_envs, device=self.device)
        self._rows = rows.view(self.teams, -1)
        """the environments of each seed, [seeds, environments]"""

    @classmethod
    def make_actor(
        cls,
        config: Any,
        observation_spec: Composite,
        action_spec: Composite,
        generator: Generators = None,
        policy: PolicyConfig | None = None,
    ) -> MemoryActor:
        """Returns new actors with a memory for as many seeds as there are generators."""
        uavs, actions = action_spec[keys.ACTION].shape[-2:]
        device: Any = observation_spec.device
        network = GaussianNetwork(
            uavs,
            keys.observation_shapes(observation_spec),
            actions,
            config.hidden,
            policy=policy or PolicyConfig(),
            share_parameters=config.share_parameters,
            device=device,
            generator=generator,
        )
        return MemoryActor(network, observation_spec)

    @abstractmethod
    def make_critic(
        self, context: LearnerContext, generators: list[torch.Generator]
    ) -> TensorDictModule:
        """Returns new critics, which write `VALUE` for whole episodes."""

    @property
    def _groups(self) -> tuple[int, int]:
        """Number of seeds, and of networks of a seed."""
        return self.teams, 1 if self.config.share_parameters else self.context.num_uavs

    @property
    def _minibatches(self) -> int:
        """Number of updates of an epoch."""
        return min(self.config.minibatches, self.context.num_envs)

    @property
    def _progress(self) -> float:
        """Share of the run before the iteration of the next update."""
        iteration = self.updates // (self.config.epochs * self._minibatches)
        return iteration * self.context.horizon / self.context.total_steps

    def learn(self, rollout: TensorDictBase) -> list[Losses]:
        """Stores a rollout, and makes all updates of an iteration at the end of an episode."""
        self._decisions += self._transitions(rollout).split(1, 1)
        self._count += rollout.shape[1]
        if self._count % self.context.horizon:
            return []
        episode: Any = torch.cat(self._decisions, 1)  # pyright: ignore[reportArgumentType]
        self._decisions = []
        self._estimate(episode, rollout.get("next")[:, -1:])
        self._set_lr()
        return [self.update(batch) for batch in self._batches(episode)]

    def _transitions(self, rollout: TensorDictBase) -> TensorDict:
        """Returns what is learnt from of a rollout, batch size [seeds * environments, steps]."""
        read = [*self._observed, *self.critic.in_keys, keys.ACTION, LOG_PROB]
        result = {key: rollout.get(key).clone() for key in read}
        result[keys.REWARD] = rollout.get(("next", *keys.REWARD)).clone()
        if self.context.failures:
            result[keys.ALIVE] = rollout.get(("next", *keys.ALIVE)).clone()
        return TensorDict(result, batch_size=rollout.shape, device=rollout.device)

    def _estimate(self, episode: TensorDictBase, last: TensorDictBase) -> None:
        """Writes advantages and returns, in units of the returns' standard deviation.

        Args:
            episode: batch size [seeds * environments, decisions].
            last: the time step after the last decision, batch size [seeds * environments, 1].
        """
        read = [part.select(*self.critic.in_keys) for part in (episode, last)]
        rewards = episode.get(keys.REWARD)
        value = rewards.new_empty(rewards.shape[0], rewards.shape[1] + 1, *rewards.shape[2:])
        # The environments of a minibatch at a time, to save memory.
        for rows in self._rows.tensor_split(self._minibatches, 1):
            rows = rows.flatten()
            whole: Any = torch.cat([part[rows] for part in read], 1)  # pyright: ignore[reportArgumentType]
            with torch.no_grad():
                value[rows] = self.critic(whole).get(VALUE)
        advantage, returns = self.advantages.estimate(value, rewards, episode.get(keys.ALIVE, None))
        episode.set(ADVANTAGE, advantage).set(RETURN, returns)
        del episode[keys.REWARD]

    def _batches(self, episode: TensorDictBase) -> Iterator[TensorDictBase]:
        """Yields the batches of an iteration, batch size [seeds * environments] each.

        The environments are permuted for each epoch; a seed's permutation does not depend on the
        other seeds.
        """
        for _ in range(self.config.epochs):
            key = counter_rng.fold_in(self._keys, self.updates)
            draws = counter_rng.uniform(key, self.context.num_envs)
            order = self._rows.gather(1, draws.argsort(dim=-1, stable=True))
            for chosen in order.tensor_split(self._minibatches, 1):
                yield episode[chosen.flatten()]

    def update(self, batch: TensorDictBase) -> Losses:
        """Performs one step of the optimizer; after a detection of the guard, no weight changes.

        Args:
            batch: episodes, batch size [seeds * environments] or with a dimension of decisions.
        """
        if self.anchor is not None:
            self.anchor.advance(self._progress)
        self.updates += 1
        batch = batch.copy().auto_batch_size_(1)
        self.guard.record_batch(batch)
        losses = self.losses(batch)
        torch.stack([self._of_networks(*item) for item in losses.items()]).sum().backward()
        losses = {name: value.detach() for name, value in losses.items()}
        gradients = {name: v.grad for name, v in self.parameters.items() if v.grad is not None}
        self.guard.check_gradients(losses, gradients)
        for network in ("actor.", "critic."):
            clip_by_row(
                [value for name, value in gradients.items() if name.startswith(network)],
                self.config.gradient_norm,
            )
        self.optimizer.step()
        self.optimizer.zero_grad()
        return losses

    def _of_networks(self, name: str, loss: Tensor) -> Tensor:
        """Returns the sum of the losses of all networks, each the mean over its UAVs.

        Args:
            name: "critic", or another name for a loss of the actors.
            loss: [seeds * uavs].
        """
        networks = self._critics if name == "critic" else math.prod(self._groups)
        return loss.unflatten(-1, (networks, -1)).mean(-1).sum()

    def losses(self, batch: TensorDictBase) -> Losses:
        """Computes the losses with gradients, one number per UAV of all seeds."""
        computed = self.loss(batch.copy().auto_batch_size_(2))
        alive = batch.get(keys.ALIVE, None)
        names = {"actor": "loss_objective", "critic": "loss_critic", "entropy": "loss_entropy"}
        losses = {
            name: mean_of_uavs(computed.get(key), alive, self.teams)
            for name, key in names.items()
            if key in computed.keys()  # noqa: SIM118  (a TensorDict iterates over its rows)
        }
        if self.anchor is not None:
            observed = [batch.get(key) for key in self._observed]
            with torch.no_grad():
                theirs, _ = self.anchor.network(*observed)
            mean, _ = self.actor.module(*observed)
            distance = self.anchor.loss(mean, theirs)
            losses["anchor"] = mean_of_uavs(distance, alive, self.teams)
        return losses

    def _set_lr(self) -> None:
        """Lowers the learning rate linearly; the last iteration still has a share of it."""
        share = max(0.0, 1 - self._progress)
        for entry in self.optimizer.param_groups:
            entry["lr"] = self.config.lr * self._lr_scale * share

    def start_from(self, weights: Mapping[str, Tensor]) -> None:
        for policy in (self.actor.module, *([self.anchor.network] if self.anchor else [])):
            copy_to_seeds(policy, weights, self.teams)
        self._set_log_std()

    def _set_log_std(self) -> None:
        """Sets the standard deviation of the actions to that of the beginning of a run."""
        network: Any = self.actor.module
        with torch.no_grad():
            network.log_std.fill_(self.config.log_std)

    def scale_lr(self, scale: float) -> None:
        self._lr_scale = scale

    def networks(self) -> dict[str, Tensor]:
        actor, critic = self.actor.module.state_dict(), self.critic.module.state_dict()
        return {ACTOR + name: value for name, value in actor.items()} | {
            _CRITIC + name: value for name, value in critic.items()
        }

    def state_dict(self, *, transitions: bool = True) -> dict[str, Tensor]:
        episode: Any = {}
        if transitions and self._decisions:
            episode = flatten(torch.cat(self._decisions, 1))  # pyright: ignore[reportArgumentType]
        counters = {"updates": torch.tensor(self.updates), "decisions": torch.tensor(self._count)}
        return prefixed(
            networks=self.networks(),
            optimizer=optimizer_tensors(self.optimizer),
            counters=counters,
            spread={"returns": self.advantages.spread},
            anchor=self.anchor.network.state_dict() if self.anchor else {},
            episode=episode,
        )

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        copy_into(self.networks(), group(state, "networks"))
        load_optimizer(self.optimizer, group(state, "optimizer"))
        self.updates = int(state["counters/updates"])
        self._count = int(state["counters/decisions"])
        copy_into({"returns": self.advantages.spread}, group(state, "spread"))
        if self.anchor is not None:
            copy_into(self.anchor.network.state_dict(), group(state, "anchor"))
        episode = group(state, "episode")
        self._decisions = list(unflatten(episode, 2, self.device).split(1, 1)) if episode else []
