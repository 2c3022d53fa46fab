"""The replay memory of a team: one per UAV, or one for all (paper, sections IV.C and IV.D)."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, ReplayBuffer, RoundRobinWriter
from torchrl.data.replay_buffers.samplers import RandomSampler
from torchrl.data.replay_buffers.storages import TensorStorage

from emberlink.envs import keys
from emberlink.envs.utils import counter_rng
from emberlink.envs.utils.counter_rng import Use
from emberlink.trainers.learners.base import LearnerContext
from emberlink.trainers.learners.tensors import flatten, group, prefixed, unflatten

DONE = (keys.AGENTS, "done")
TERMINATED = (keys.AGENTS, "terminated")

_ROWS, _COLUMNS = range(2)


class ReplayMemory:
    """Stores the transitions of all UAVs and draws a batch for each of them.

    Rows are transitions of all UAVs at one step of one environment of each seed. Everything that
    the networks read is stored, of any shape.

    Args:
        context: of the learner.
        batch_size: transitions per UAV and sample.
        buffer_size: UAV transitions that a memory holds; a shared one holds them of all together.
    """

    def __init__(self, context: LearnerContext, *, batch_size: int, buffer_size: int):
        uavs, shared = context.num_uavs, context.shared_replay
        self.teams, self.device = len(context.seeds), context.device
        self._keys = keys.observation_keys(context.observation_spec)
        size = -(-buffer_size // uavs) if shared else buffer_size
        # No more is allocated than a run can fill.
        self.capacity = min(size, context.total_steps * context.num_envs)
        self.needed = -(-batch_size // uavs) if shared else batch_size
        """rows at which the memory first holds a full batch"""
        never = context.total_steps + 1
        fits = self.needed <= self.capacity
        self.learning_starts = -(-self.needed // context.num_envs) if fits else never
        self.written = 0
        """rows written so far, those that were overwritten included"""
        self._sampler = TeamSampler(
            uavs,
            shared=shared,
            rows=self.capacity,
            seeds=context.seeds,
            device=context.device,
        )
        self._buffer = ReplayBuffer(
            # Compilable: without it, TorchRL waits for the device to tell where it last wrote.
            storage=_ClaimedStorage(self.capacity, device=context.device, compilable=True),
            writer=RoundRobinWriter(compilable=True),
            sampler=self._sampler,
            batch_size=batch_size,
            transform=_to_batch,
        )

    def __len__(self) -> int:
        return len(self._buffer)

    @property
    def ready(self) -> bool:
        """Whether there is a full batch to draw."""
        return len(self) >= self.needed

    @property
    def draws(self) -> Tensor:
        """How many batches have been drawn, int64 [] on the device."""
        return self._sampler.draws

    def extend(self, rollout: TensorDictBase) -> None:
        """Stores a rollout, batch size [seeds * environments, steps]."""
        self.extend_rows(to_rows(rollout, self.teams, self._keys))

    def extend_rows(self, rows: TensorDictBase) -> None:
        """Stores rows as `to_rows` gives them."""
        self._buffer.extend(rows)
        self.written += len(rows)

    def sample(self) -> TensorDict:
        """Draws a batch for each UAV: batch size [batch], "agents" and "next" as collected."""
        return self._buffer.sample()

    def state_dict(self, *, transitions: bool = True) -> dict[str, Tensor]:
        """Returns the counters and the rows that are filled; the rows are not copied."""
        state = {"draws": self.draws.clone(), "written": torch.tensor(self.written)}
        if not (transitions and len(self)):
            return state
        rows: Any = self._buffer.storage[: len(self)]
        return state | prefixed(rows=flatten(rows))

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restores what `state_dict` gave, into a memory that is empty and no smaller."""
        self.draws.copy_(state["draws"])
        rows = group(state, "rows")
        if not rows:
            return
        content = unflatten(rows, 2, self.device)
        self._buffer.extend(content)
        self.written = int(state["written"])
        behind = self.written % self.capacity
        if self.written > self.capacity and behind:
            # The next row goes behind the newest: up to there, the same is written once more.
            self._buffer.extend(content[:behind])


class TeamSampler(RandomSampler):
    """Draws a batch for each UAV, uniformly, from a storage of shape [rows, teams * uavs].

    A draw is a function of the seed and of the number of earlier draws: it is the same on every
    device, and for one seed alone as for one of several.

    Args:
        uavs: UAVs of a team.
        shared: whether a UAV draws from the transitions of its team or only from its own.
        rows: capacity of the storage.
        seeds: one per team.
        device: of the storage, where indices are made.
    """

    def __init__(
        self,
        uavs: int,
        *,
        shared: bool,
        rows: int,
        seeds: Sequence[int],
        device: torch.device | str,
    ):
        super().__init__()
        self.uavs, self.shared, self.rows = uavs, shared, rows
        # On the device, so that a recorded graph reads their present values.
        self.draws = torch.zeros((), dtype=torch.int64, device=device)
        self.filled = torch.zeros((), dtype=torch.int64, device=device)
        self._keys = counter_rng.fold_in(torch.tensor(seeds, device=device), Use.REPLAY_SAMPLE)
        self._team = torch.arange(len(seeds), device=device)[:, None, None] * uavs
        self._own = torch.arange(uavs, device=device)

    def extend(self, index: Tensor) -> None:
        """Counts the rows that the buffer has just written."""
        self.filled.add_(len(index)).clamp_(max=self.rows)

    def sample(self, storage: TensorStorage, batch_size: int) -> tuple[tuple[Tensor, Tensor], dict]:
        """Returns rows and columns, int64 [batch_size, teams * uavs] each; column k is UAV k's."""
        if len(storage) == 0:
            raise RuntimeError("cannot sample from an empty replay memory")
        key = counter_rng.fold_in(self._keys, self.draws)
        self.draws += 1

        def draw(use: int, limit: int | Tensor) -> Tensor:
            numbers = counter_rng.integers(
                counter_rng.fold_in(key, use), batch_size * self.uavs, limit
            )
            return numbers.view(-1, batch_size, self.uavs)

        rows = draw(_ROWS, self.filled)
        column = draw(_COLUMNS, self.uavs) if self.shared else self._own.expand_as(rows)
        rows, columns = (
            of_teams.transpose(0, 1).flatten(1) for of_teams in (rows, column + self._team)
        )
        return (rows, columns), {}


class _ClaimedStorage(LazyTensorStorage):
    """Claims all of its memory with the first transition, so that too little fails at once."""

    def _init(self, data: TensorDictBase) -> None:
        super()._init(data)
        self._storage.zero_()

    def get(self, index: tuple[Tensor, Tensor]) -> TensorDictBase:
        """Returns the rows that `TeamSampler` drew.

        TorchRL first cuts off the rows not yet written; a recorded graph would then always read
        from as many rows as there were when it was recorded.
        """
        return self._storage[index]


def to_rows(rollout: TensorDictBase, teams: int, observations: Sequence[Any]) -> TensorDict:
    """Returns the transitions of a rollout as rows of a replay memory.

    Args:
        rollout: batch size [teams * environments] or [teams * environments, steps].
        teams: how many seeds train side by side.
        observations: keys of the observation's tensors.

    Returns:
        Batch size [environments * steps, teams * uavs]. Only `terminated` stops the bootstrap, and
        an episode never terminates: the value beyond the horizon is bootstrapped.
    """
    dims = rollout.ndim
    rows, uavs = math.prod(rollout.shape) // teams, rollout.get(keys.ACTION).shape[dims]

    def arrange(value: Tensor) -> Tensor:
        """[*batch, uavs, ...] -> [rows, teams * uavs, ...]."""
        rest = value.shape[dims + 1 :]
        value = value.reshape(teams, rows, uavs, *rest)
        return value.transpose(0, 1).reshape(rows, teams * uavs, *rest)

    def per_uav(key: str) -> Tensor:
        return arrange(rollout.get(("next", key)).unsqueeze(-2).expand(*rollout.shape, uavs, 1))

    following = {key[-1]: arrange(rollout.get(("next", *key))) for key in observations}
    return TensorDict(
        {
            **{key[-1]: arrange(rollout.get(key)) for key in observations},
            "action": arrange(rollout.get(keys.ACTION)),
            "next": {
                **following,
                "reward": arrange(rollout.get(("next", *keys.REWARD))),
                "done": per_uav("done"),
                "terminated": per_uav("terminated"),
            },
        },
        batch_size=(rows, teams * uavs),
        device=rollout.device,
    )


def _to_batch(sample: TensorDictBase) -> TensorDict:
    """Arranges a sample [batch, uavs] as the losses read it, batch size [batch]."""
    return TensorDict(
        {
            keys.AGENTS: sample.exclude("next"),
            "next": TensorDict({keys.AGENTS: sample.get("next")}, batch_size=sample.shape[:1]),
        },
        batch_size=sample.shape[:1],
    )
