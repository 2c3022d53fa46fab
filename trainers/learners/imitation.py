"""Imitation of a scripted teacher in states visited by the student (DAgger, Ross et al. 2011)."""

from collections.abc import Mapping
from typing import Annotated, Any

import torch
from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from emberlink.envs import keys
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import Name
from emberlink.policies.gaussian import MEMORY, GaussianActor
from emberlink.trainers.learners.base import (
    LEARNERS,
    STRICT,
    Count,
    Learner,
    LearnerConfig,
    LearnerContext,
    Losses,
    Positive,
    mean_over_batch,
)
from emberlink.trainers.learners.replay import TeamReplay


@dataclass(frozen=True, kw_only=True, config=STRICT)
class ImitationConfig(LearnerConfig):
    """Stores the settings of imitation."""

    share_parameters: bool = True
    """whether all UAVs use the same weights; if not, each UAV has its own"""
    actor_of: Name
    """learner whose actors are trained; its runs can begin with them (`learner.warm_start`)"""
    teacher: Name
    """scripted policy that is imitated: `map_greedy` or another one that plans by the same maps"""
    teacher_share: Annotated[float, Field(ge=0, le=1)]
    """share of decisions that the teacher takes at the beginning; it falls linearly to 0"""
    lr: Positive
    """learning rate of Adam at the beginning; it falls linearly to 0 at the end of the run"""
    bfloat16: bool = False
    """whether updates compute with numbers of 16 bits where these suffice (`torch.autocast`)"""
    updates_per_step: Count
    """updates per decision of the batch of environments"""
    samples: Count
    """decisions per update and UAV; with a memory, rounded up to whole sequences"""
    buffer_size: Count
    """capacity of the replay buffer, in decisions of a UAV"""
    sequence: Count = 16
    """successive decisions that a memory, and late messages, learn from at once"""

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

    Each UAV takes the teacher's action with a probability that falls to 0. A replay buffer holds
    the UAV's observations and the teacher's actions. The loss of an update is the smooth L1
    distance to the teacher's action.

    With a memory or late messages, the replay buffer holds sequences of decisions, with the state
    before the first one (Kapturowski et al. 2019, ICLR).
    """

    config_type = ImitationConfig

    def __init__(self, config: ImitationConfig, context: LearnerContext):
        self.config, self.context = config, context
        specs = context.observation_spec, context.action_spec
        initial = torch.Generator().manual_seed(context.seed)
        self.actor = self.make_actor(config, *specs, initial, context.policy, context.lag)
        self.loss: nn.Module = self.actor.module
        self.generator = torch.Generator(context.device).manual_seed(context.seed)
        self.explorer: Any = Mixture(self.actor, self.generator)
        self.observed = keys.observation_keys(context.observation_spec)
        speaks = context.policy.message != "none"
        self.observed += [keys.HEARS] if speaks else []
        self.remembers = context.policy.memory != "none" or context.lag > 0
        self.sequence = min(config.sequence, context.horizon) if self.remembers else 1
        """decisions of a row of the replay buffer"""
        self.replay = TeamReplay(
            context,
            self.generator,
            batch_size=-(-config.samples // self.sequence),
            buffer_size=-(-config.buffer_size // self.sequence),
            joint=speaks,  # the messages of a team at one time
            # With `agent_index`, the input is the index of a column.
            mixed=not speaks and not context.policy.agent_index,
        )
        self.optimizer = torch.optim.Adam(self.loss.parameters(), lr=config.lr, fused=True)
        self.recent = []  # decisions that do not fill a row yet
        self._schedule()

    @classmethod
    def make_actor(cls, config: Any, *given: Any, **more: Any) -> Any:
        """Returns new actors of the learner `actor_of`."""
        learner = LEARNERS.find(config.actor_of, "learner.actor_of")
        if issubclass(learner, cls):
            others = ", ".join(name for name in LEARNERS.known() if name != config.actor_of)
            raise UserError(
                f"learner.actor_of={config.actor_of}: has no actors of its own; known: {others}"
            )
        return learner.make_actor(config, *given, **more)

    def _schedule(self) -> None:
        """Lowers the teacher's share and the learning rate linearly."""
        left = max(0.0, 1 - self.decisions / self.context.total_steps)
        self.explorer.share = self.config.teacher_share * left
        for entry in self.optimizer.param_groups:
            entry["lr"] = self.config.lr * left

    def learn(self, rollout: TensorDictBase) -> list[Losses]:
        """Stores a rollout, and performs updates if there is a full batch."""
        self._store(rollout)
        updates = range(self.config.updates_per_step if self.replay.ready else 0)
        losses = [self.update(self.replay.sample()) for _ in updates]
        self._schedule()
        return losses

    def _store(self, rollout: TensorDictBase) -> None:
        """Stores rows of `sequence` decisions; pads the last row of an episode."""
        kept: list[Any] = [*self.observed, keys.TEACHER]
        kept += [keys.ALIVE] if self.context.failures else []
        kept += [MEMORY] if self.remembers else []
        for decision in rollout.select(*kept).split(1, 1):
            self.recent.append(decision)
            self.decisions += 1
            missing = self.sequence - len(self.recent)
            if missing and self.decisions % self.context.horizon:
                continue
            parts: Any = [*self.recent, *[decision] * missing]
            whole: Any = torch.cat(parts, 1)
            agents = whole.get(keys.AGENTS)
            alive = agents.get("alive", torch.ones(agents.shape, dtype=torch.bool)).clone()
            alive[:, len(self.recent) :] = False
            rows = {name: value.transpose(1, 2) for name, value in agents.items()}
            if self.remembers:
                rows["memory"] = rows["memory"][:, :, 0]
            rows["alive"] = alive.transpose(1, 2).to(agents.device)
            size = rollout.shape[0], self.context.num_uavs
            self.replay.extend(TensorDict(rows, size, device=rollout.device))
            self.recent = []

    def update(self, batch: TensorDictBase) -> Losses:
        """Performs one step of the optimizer on rows of the replay buffer, [batch, uavs]."""
        with self.precision():
            losses = self.losses(batch)
        networks = 1 if self.config.share_parameters else self.context.num_uavs
        losses["imitation"].unflatten(0, (networks, -1)).mean(1).sum().backward()
        self.optimizer.step()
        self.optimizer.zero_grad()
        self.updates += 1
        return {name: value.detach() for name, value in losses.items()}

    def losses(self, batch: TensorDictBase) -> Losses:
        """Computes the loss with gradients, one number per UAV."""
        network = self.actor.module
        observed = [batch.get(name).transpose(1, 2) for _, name in self.observed]
        if isinstance(self.actor, GaussianActor):  # the mean before it is clipped
            state = batch.get("memory") if self.remembers else network.empty_state(len(batch))
            action, _ = network(state, *observed)
        else:
            action = network(*observed)
        teacher = batch.get(keys.TEACHER[1]).transpose(1, 2)
        loss = nn.functional.smooth_l1_loss(action, teacher, reduction="none").mean(-1)
        return {"imitation": mean_over_batch(loss, batch.get("alive").transpose(1, 2))}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        super().load_state_dict(state)
        self._schedule()


class Mixture(TensorDictModuleBase):
    """Takes the teacher's action with a probability, for each UAV and decision, else the actor's.

    Args:
        actor: the actors of all UAVs.
        generator: on the device of the actions.
    """

    share = 0.0
    """the probability"""

    def __init__(self, actor: Any, generator: torch.Generator):
        super().__init__()
        self.actor, self.generator = actor, generator
        reads: list[Any] = [*actor.in_keys, keys.TEACHER]
        self.in_keys, self.out_keys = reads, list(actor.out_keys)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        acted, teacher = self.actor(tensordict), tensordict.get(keys.TEACHER)
        draws = torch.empty_like(teacher[..., :1]).uniform_(generator=self.generator)
        action = torch.where(draws < self.share, teacher, acted.get(keys.ACTION))
        return acted.set(keys.ACTION, action)
