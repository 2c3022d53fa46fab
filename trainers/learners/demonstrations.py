"""Stores what UAVs observed and what a teacher would have done."""

from typing import Any

from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from emberlink.envs import keys
from emberlink.trainers.learners.off_policy.replay_buffer import ReplayMemory, arrange
from emberlink.trainers.learners.off_policy.sequences import MISSING, SequenceMemory

_TEACHER, _ALIVE, _MISSING = keys.TEACHER[1], keys.ALIVE[1], MISSING[1]


class _OfTeacher(ReplayMemory):
    """Stores observations and what a teacher would have done, in place of transitions."""

    def _rows(self, rollout: TensorDictBase) -> TensorDict:
        kept = [*self._keys, keys.TEACHER, *([keys.ALIVE] if self._failures else [])]
        rows = {key[-1]: arrange(rollout.get(key), rollout.ndim, self.teams) for key in kept}
        return TensorDict(rows, batch_size=rows[_TEACHER].shape[:2], device=rollout.device)


class Demonstrations(_OfTeacher):
    """Samples single decisions, see `ReplayMemory`."""

    def sample(self) -> TensorDict:
        """Samples a batch for each UAV: batch size [batch], with the keys of a rollout."""
        sample = self._buffer.sample()
        return TensorDict({keys.AGENTS: sample}, batch_size=sample.shape[:1])


class DemonstrationSequences(_OfTeacher, SequenceMemory):
    """Samples sequences of decisions, see `SequenceMemory`."""

    def sample(self) -> TensorDict:
        """Samples sequences for each UAV: batch size [batch], [batch, uavs, decisions, ...] each.

        Observations are those of the burn-in and of the decisions to learn from, all other tensors
        those of the decisions to learn from; "alive" is that of `SequenceMemory.sample`.
        """
        drawn: Any = self._buffer.sample(return_info=True)
        sample, info = drawn
        agents: dict[str, Tensor] = {_MISSING: info[_MISSING]}
        for _, name in self._keys:
            agents[name] = sample.get(name).transpose(1, 2)
        agents[_TEACHER] = self._learnt(sample, _TEACHER)
        agents[_ALIVE] = self._alive(sample, info)
        batch = info[_MISSING].shape
        return TensorDict({keys.AGENTS: TensorDict(agents, batch)}, batch_size=batch[:1])
