"""Imitation of a scripted teacher on what the student visits (DAgger, Ross et al. 2011)."""

from collections.abc import Mapping
from typing import Annotated, Any

import torch
from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import Composite
from torchrl.envs.utils import ExplorationType, exploration_type

from emberlink.envs import keys
from emberlink.envs.utils import counter_rng
from emberlink.envs.utils.counter_rng import Use
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import Name
from emberlink.policies.gaussian import MEAN
from emberlink.policies.networks import Generators
from emberlink.policies.settings import PolicyConfig
from emberlink.trainers.learners import registry
from emberlink.trainers.learners.base import (
    ACTOR,
    STRICT,
    Count,
    Learner,
    LearnerConfig,
    LearnerContext,
    Losses,
    Positive,
    generators,
)
from emberlink.trainers.learners.demonstrations import Demonstrations, DemonstrationSequences
from emberlink.trainers.learners.off_policy.learner import OffPolicyLearner
from emberlink.trainers.learners.off_policy.sequences import MISSING, fit_burn_in
from emberlink.trainers.learners.tensors import (
    copy_into,
    group,
    load_optimizer,
    optimizer_tensors,
    prefixed,
)


@dataclass(frozen=True, kw_only=True, config=STRICT)
class ImitationConfig(LearnerConfig):
    """Stores the settings of imitation."""

    share_parameters: bool = True
    """whether all UAVs of a seed use the same weights; if not, each UAV has its own"""
    actor_of: Name
    """learner whose actors are trained; its runs can begin with them (`learner.warm_start`)"""
    teacher: Name
    """scripted policy that is imitated: `map_greedy` or another one that plans by the same maps"""
    teacher_share: Annotated[float, Field(ge=0, le=1)]
    """share of decisions that the teacher takes at the beginning; it falls linearly to 0"""
    lr: Positive
    """learning rate of Adam at the beginning; it falls linearly to 0 at the end of the run"""
    updates_per_step: Count
    """updates per decision of the batch of environments"""
    samples: Annotated[int, Field(ge=1, le=1_000_000)]
    """decisions per update and UAV; with a memory, rounded up to whole sequences"""
    buffer_size: Count
    """capacity of a buffer of decisions, in decisions of a UAV"""
    sequence: Count = 16
    """successive decisions that networks with a memory learn from"""
    burn_in: Annotated[int, Field(ge=0, le=1_000_000)] = 16
    """decisions before them, which prepare the memory and are not learnt from"""

    @model_validator(mode="after")
    def _decisions_fit(self) -> "ImitationConfig":
        if self.samples > self.buffer_size:
            raise UserError(f"samples={self.samples} is larger than buffer_size={self.buffer_size}")
        return self

    @property
    def reads_teacher(self) -> str:
        return self.teacher


class Imitation(Learner):
    """Trains actors to act as the teacher would, where they and the teacher have flown.

    Each UAV's decision is the teacher's with a probability that falls to 0. What the UAV observed
    and what the teacher would have done is kept in a buffer. An update draws from it; the loss is
    the smooth L1 distance to the teacher's action.
    """

    config_type = ImitationConfig

    def __init__(self, config: ImitationConfig, context: LearnerContext):
        config = fit_burn_in(config, context.horizon)
        self.config, self.context, self.teams = config, context, len(context.seeds)
        self.guard = context.guard
        specs = context.observation_spec, context.action_spec
        self.actor = self.make_actor(config, *specs, generators(context.seeds), context.policy)
        self.explorer: Any = Mixture(self.actor, context.device)
        self.remembers = context.policy.memory != "none"
        self.replay = self._make_replay()
        self.learning_starts = self.replay.learning_starts
        network: nn.Module = self.actor.module
        self.parameters = {f"actor.{name}": value for name, value in network.named_parameters()}
        values = list(self.parameters.values())
        self.optimizer = torch.optim.Adam(values, lr=config.lr, fused=True)
        self.optimizer.found_inf = self.guard.bad  # pyright: ignore[reportAttributeAccessIssue]
        self._lr_scale, self._count = 1.0, 0
        self._advance(0)

    def _make_replay(self) -> Demonstrations | DemonstrationSequences:
        config = self.config
        sizes: dict[str, Any] = {
            "batch_size": config.samples,
            "buffer_size": config.buffer_size,
            "mixed": not self.context.policy.agent_index,  # the input is the index of a column
        }
        if not self.remembers:
            return Demonstrations(self.context, **sizes)
        sizes |= {"sequence": config.sequence, "burn_in": config.burn_in}
        return DemonstrationSequences(self.context, **sizes)

    @classmethod
    def make_actor(
        cls,
        config: Any,
        observation_spec: Composite,
        action_spec: Composite,
        generator: Generators = None,
        policy: PolicyConfig | None = None,
    ) -> Any:
        """Returns new actors of the learner `actor_of`."""
        learner = registry.find(config.actor_of, "learner.actor_of")
        if issubclass(learner, cls):
            others = ", ".join(name for name in registry.known() if name != config.actor_of)
            raise UserError(
                f"learner.actor_of={config.actor_of}: has no actors of its own; known: {others}"
            )
        return learner.make_actor(config, observation_spec, action_spec, generator, policy)

    def _advance(self, decisions: int) -> None:
        """Counts decisions, and lowers the teacher's share and the learning rate."""
        self._count += decisions
        left = max(0.0, 1 - self._count / self.context.total_steps)
        self.explorer.share.fill_(self.config.teacher_share * left)
        for entry in self.optimizer.param_groups:
            entry["lr"] = self.config.lr * self._lr_scale * left

    def learn(self, rollout: TensorDictBase) -> list[Losses]:
        self.replay.extend(rollout)
        losses = []
        if self.replay.ready:
            updates = range(self.config.updates_per_step)
            losses = [self.update(self.replay.sample()) for _ in updates]
        self._advance(rollout.shape[1])
        return losses

    def update(self, batch: TensorDictBase) -> Losses:
        """Performs one step of the optimizer; after a detection of the guard, no weight changes."""
        self.updates += 1
        self.guard.record_batch(batch)
        losses = self.losses(batch)
        networks = self.teams if self.config.share_parameters else len(losses["imitation"])
        losses["imitation"].unflatten(0, (networks, -1)).mean(1).sum().backward()
        losses = {name: value.detach() for name, value in losses.items()}
        gradients = {name: v.grad for name, v in self.parameters.items() if v.grad is not None}
        self.guard.check_gradients(losses, gradients)
        self.optimizer.step()
        self.optimizer.zero_grad()
        return losses

    def losses(self, batch: TensorDictBase) -> Losses:
        """Computes the loss with gradients, one number per UAV of all seeds."""
        if self.remembers:
            action = self._remembered(batch)
        else:
            acted = self.actor(batch.copy())
            # The mean of a normal distribution before it is clipped, else the action.
            action = acted.get(MEAN) if MEAN in self.actor.out_keys else acted.get(keys.ACTION)
        loss = nn.functional.smooth_l1_loss(action, batch.get(keys.TEACHER), reduction="none")
        return {"imitation": OffPolicyLearner.mean_over_batch(loss.mean(-1), batch)}

    def _remembered(self, batch: TensorDictBase) -> Tensor:
        """Returns the actions of sequences after their burn-in, [batch, uavs, decisions, 3].

        The memory is empty before the burn-in, and has no gradient in it.
        """
        observed = [batch.get(key) for key in keys.observation_keys(self.context.observation_spec)]
        burn_in, state, actions = self.config.burn_in, None, []
        for decision in range(burn_in + self.config.sequence):
            with torch.set_grad_enabled(decision >= burn_in):
                now = [x[:, :, decision] for x in observed]
                action, state = self.actor.module.step(now, state)
            if decision < burn_in:
                lacks = batch.get(MISSING) > decision
                state = state.masked_fill(lacks.unsqueeze(-1), 0.0)
            actions.append(action)
        return torch.stack(actions[burn_in:], 2)

    def scale_lr(self, scale: float) -> None:
        self._lr_scale = scale
        self._advance(0)

    def networks(self) -> dict[str, Tensor]:
        return {ACTOR + name: value for name, value in self.actor.module.state_dict().items()}

    def state_dict(self, *, transitions: bool = True) -> dict[str, Tensor]:
        counters = {"updates": torch.tensor(self.updates), "decisions": torch.tensor(self._count)}
        return prefixed(
            networks=self.networks(),
            optimizer=optimizer_tensors(self.optimizer),
            counters=counters,
            replay=self.replay.state_dict(transitions=transitions),
        )

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        copy_into(self.networks(), group(state, "networks"))
        load_optimizer(self.optimizer, group(state, "optimizer"))
        self.updates = int(state["counters/updates"])
        self._count = int(state["counters/decisions"])
        self.replay.load_state_dict(group(state, "replay"))
        self._advance(0)


class Mixture(TensorDictModuleBase):
    """Takes the teacher's action with a probability, for each UAV and decision, else the actor's.

    Random numbers come from each environment's random key. With exploration off, and without a
    teacher, all actions are the actor's.

    Args:
        actor: the actors of all UAVs.
        device: of the share.
    """

    share: Tensor
    """float32 []: the probability"""

    def __init__(self, actor: Any, device: torch.device | str):
        super().__init__()
        self.actor = actor
        self.register_buffer("share", torch.zeros((), device=device))
        reads: list[Any] = list(dict.fromkeys([*actor.in_keys, keys.RNG_KEY, keys.STEP]))
        writes: list[Any] = list(actor.out_keys)
        self.in_keys, self.out_keys = reads, writes

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        acted = self.actor(tensordict)
        teacher = tensordict.get(keys.TEACHER, None)
        if teacher is None or exploration_type() not in (None, ExplorationType.RANDOM):
            return acted
        step = tensordict.get(keys.STEP)
        key = counter_rng.step_key(tensordict.get(keys.RNG_KEY), step, Use.TEACHER)
        taken = counter_rng.uniform(key, teacher.shape[-2]) < self.share
        return acted.set(
            keys.ACTION, torch.where(taken.unsqueeze(-1), teacher, acted.get(keys.ACTION))
        )
