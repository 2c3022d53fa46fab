"""Stores what UAVs observed and what a teacher would have done."""

from typing import Any

from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from emberlink.envs import keys
from emberlink.trainers.learners.off_policy.replay_buffer import ReplayMemory, arrange
from emberlink.trainers.learners.off_policy.sequences import MISSING, SequenceMemory

_TEACHER, _ALIVE, _MISSING = keys.TEACHER[1], keys.ALIVE[1], MISSING[1]


class Demonstrations(ReplayMemory):
    """Samples single decisions, see `ReplayMemory`."""

    def _rows(self, rollout: TensorDictBase) -> TensorDict:
        return _rows(rollout, self.teams, self._keys, failures=self._failures)

    def sample(self) -> TensorDict:
        """Samples a batch for each UAV: batch size [batch], with the keys of a rollout."""
        sample = self._buffer.sample()
        return TensorDict({keys.AGENTS: sample}, batch_size=sample.shape[:1])


class DemonstrationSequences(SequenceMemory):
    """Samples sequences of decisions, see `SequenceMemory`."""

    def _rows(self, rollout: TensorDictBase) -> TensorDict:
        return _rows(rollout, self.teams, self._keys, failures=self._failures)

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


def _rows(rollout: TensorDictBase, teams: int, observations: Any, *, failures: bool) -> TensorDict:
    """Returns the decisions of a rollout as rows, batch size [rows, teams * uavs]."""
    kept = [*observations, keys.TEACHER, *([keys.ALIVE] if failures else [])]
    rows = {key[-1]: arrange(rollout.get(key), rollout.ndim, teams) for key in kept}
    return TensorDict(rows, batch_size=rows[_TEACHER].shape[:2], device=rollout.device)
