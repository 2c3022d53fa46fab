"""Samples sequences of decisions, from which networks with a memory learn."""

from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from emberlink.envs import keys
from emberlink.envs.utils.errors import UserError
from emberlink.trainers.learners.base import LearnerContext
from emberlink.trainers.learners.off_policy.replay_buffer import ReplayMemory
from emberlink.trainers.learners.off_policy.samplers import SequenceSampler, TeamSampler

MISSING = (keys.AGENTS, "missing")
"""int64 [batch, uavs]: decisions that a burn-in lacks, because its episode begins later"""


def fit_burn_in(config: Any, horizon: int) -> Any:
    """Returns a learner's configuration with a burn-in of fewer decisions than an episode has.

    Decisions before the beginning of an episode would be computed and have no effect.
    """
    return replace(config, burn_in=min(config.burn_in, horizon - 1))


class SequenceMemory(ReplayMemory):
    """Stores the transitions of all UAVs and samples sequences for each UAV, see `SequenceSampler`.

    Args:
        context: context of the learner.
        batch_size: transitions to learn from per UAV in a sample, rounded up to whole sequences.
        sequence: decisions to learn from in a sequence.
        burn_in: decisions before, which prepare the memory.
        more: `buffer_size` and `joint` of `ReplayMemory`.

    Raises:
        UserError: the episode is shorter than a sequence, or the buffer cannot hold enough.
    """

    def __init__(
        self, context: LearnerContext, *, batch_size: int, sequence: int, burn_in: int, **more: Any
    ):
        self._context, self.sequence, self.burn_in = context, sequence, burn_in
        if sequence > context.horizon:
            raise UserError(
                f"learner.sequence={sequence}: an episode has {context.horizon} decisions "
                f"(env.horizon / policy.hold)"
            )
        super().__init__(context, batch_size=batch_size, **more)
        held = self.capacity // context.num_envs
        # At least one sequence fits while the buffer is full, whatever decision is overwritten.
        wanted = burn_in + 2 * sequence - 1
        if held < min(wanted, context.total_steps):
            shared = f"shared by {context.num_uavs} UAVs, " if context.shared_replay else ""
            raise UserError(
                f"learner.buffer_size={more['buffer_size']}: {shared}holds {held} decisions of "
                f"{context.num_envs} environments; {wanted} are needed for a burn-in of {burn_in} "
                f"(learner.burn_in, at most an episode) and learner.sequence={sequence}"
            )
        self.learning_starts = max(self.learning_starts, sequence)

    def _make_sampler(self, uavs: int, **more: Any) -> TeamSampler:
        return SequenceSampler(
            uavs,
            burn_in=self.burn_in,
            sequence=self.sequence,
            horizon=self._context.horizon,
            envs=self._context.num_envs,
            **more,
        )

    @property
    def ready(self) -> bool:
        """Whether the buffer holds a full batch, and a sequence."""
        return super().ready and self.written >= self.sequence * self._context.num_envs

    def extend(self, rollout: TensorDictBase) -> None:
        """Stores a rollout, batch size [seeds * environments, steps], step by step."""
        for step in rollout.split(1, 1):
            super().extend(step)

    def sample(self) -> TensorDict:
        """Samples sequences for each UAV: batch size [batch], [batch, uavs, decisions, ...] each.

        Observations are those of the burn-in and of the decisions to learn from, and under "next"
        also the one after. All other tensors are those of the decisions to learn from. "alive" is
        false where a UAV had failed, and where a sequence is not within the episode.
        """
        drawn: Any = self._buffer.sample(return_info=True)
        sample, info = drawn
        missing, past = info[MISSING[1]], self.burn_in
        observed, following = {}, {}
        for _, name in self._keys:
            observed[name] = sample.get(name).transpose(1, 2)
            # "next" of a decision that the burn-in lacks is not the first observation.
            before = observed[name][:, :, : past + 1]
            following[name] = torch.cat((before, self._learnt(sample, ("next", name))), 2)
        agents = {**observed, "action": self._learnt(sample, "action"), MISSING[1]: missing}
        agents["alive"] = self._alive(sample, info)
        outcome = ("reward", "done", "terminated")
        after = {name: self._learnt(sample, ("next", name)) for name in outcome}
        after |= {**following, MISSING[1]: missing.clone()}
        batch, size = missing.shape, missing.shape[:1]
        return TensorDict(
            {
                keys.AGENTS: TensorDict(agents, batch_size=batch),
                "next": TensorDict({keys.AGENTS: TensorDict(after, batch)}, batch_size=size),
            },
            batch_size=size,
        )

    def _learnt(self, sample: Any, name: Any) -> Tensor:
        """Returns the tensor of the decisions to learn from, [batch, uavs, decisions, ...]."""
        return sample.get(name).transpose(1, 2)[:, :, self.burn_in :]

    def _alive(self, sample: Any, info: dict[str, Tensor]) -> Tensor:
        """Returns the decisions to learn from of a sample, bool [batch, uavs, decisions]."""
        within = info["within"].transpose(1, 2)
        if not self._failures:
            return within
        return within & self._learnt(sample, "alive")
