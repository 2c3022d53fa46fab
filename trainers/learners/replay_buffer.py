"""Replay memory of a team: one per UAV, or one for all (paper, sections IV.C and IV.D)."""

import math
from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import LazyTensorStorage, ReplayBuffer, RoundRobinWriter
from torchrl.data.replay_buffers.samplers import RandomSampler
from torchrl.data.replay_buffers.storages import TensorStorage

from emberlink.envs import keys
from emberlink.envs.utils import counter_rng
from emberlink.envs.utils.counter_rng import Use

DONE = (keys.AGENTS, "done")
TERMINATED = (keys.AGENTS, "terminated")


_ROWS, _COLUMNS = range(2)


class TeamSampler(RandomSampler):
    """Draws a batch for each UAV, uniformly, from a storage of shape [rows, teams * uavs].

    A draw is a function of the team's seed and of how many came before: it is the same on every
    device, and for a team alone as for one of several.

    Args:
        uavs: how many a team has.
        shared: whether a UAV draws from the transitions of its team or from its own alone.
        rows: that the storage holds.
        seeds: one per team.
        device: where indices are made: the storage's.
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
        # On the device, so that a recorded graph reads what they are by then.
        self.draws = torch.zeros((), dtype=torch.int64, device=device)
        self.filled = torch.zeros((), dtype=torch.int64, device=device)
        self._keys = counter_rng.fold_in(torch.tensor(seeds, device=device), Use.REPLAY_SAMPLE)
        self._team = torch.arange(len(seeds), device=device)[:, None, None] * uavs
        self._own = torch.arange(uavs, device=device)

    def extend(self, index: torch.Tensor) -> None:
        """Told by the memory where it has just written."""
        self.filled.add_(len(index)).clamp_(max=self.rows)

    def _empty(self) -> None:
        """Told by the memory that it holds nothing any more."""
        self.filled.zero_()

    def sample(
        self, storage: TensorStorage, batch_size: int
    ) -> tuple[tuple[torch.Tensor, torch.Tensor], dict]:
        """Rows and columns, int64 [batch_size, teams * uavs] each; column k is for UAV k."""
        if len(storage) == 0:
            raise RuntimeError("cannot sample from an empty replay memory")
        key = counter_rng.fold_in(self._keys, self.draws)
        self.draws += 1

        def draw(use: int, limit: int | torch.Tensor) -> torch.Tensor:
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
    """Takes its memory with the first transition: what does not fit fails then, not hours later."""

    def _init(self, data: TensorDictBase) -> None:
        super()._init(data)
        self._storage.zero_()

    def get(self, index: tuple[torch.Tensor, torch.Tensor]) -> TensorDictBase:
        """Reads rows that `TeamSampler` drew.

        From all rows there will ever be: TorchRL cuts off those not yet written, and a recorded
        graph would go on drawing from as many as there were when it was recorded.
        """
        return self._storage[index]


def make_memory(
    uavs: int,
    *,
    shared: bool,
    capacity: int,
    batch: int,
    most: int,
    seeds: Sequence[int],
    device: torch.device | str,
) -> ReplayBuffer:
    """The replay memory of a team, or of several that train side by side.

    Args:
        uavs: how many a team has.
        shared: one memory for all, or one per UAV.
        capacity: UAV transitions that a memory holds; a shared one holds them of all together.
        batch: transitions per UAV and sample.
        most: rows (moments of an environment) that will ever be stored, so that no more is
            allocated than a run can fill.
        seeds: of the samples, one per team.
        device: where transitions are kept.
    """
    rows = min(-(-capacity // uavs) if shared else capacity, most)
    return ReplayBuffer(
        # Compilable: without it, TorchRL waits for the device to tell where it last wrote.
        storage=_ClaimedStorage(rows, device=device, compilable=True),
        writer=RoundRobinWriter(compilable=True),
        sampler=TeamSampler(uavs, shared=shared, rows=rows, seeds=seeds, device=device),
        batch_size=batch,
        transform=_to_batch,
    )


def rows_needed(uavs: int, *, shared: bool, batch: int) -> int:
    """Rows in the storage at which a memory first holds a full batch."""
    return -(-batch // uavs) if shared else batch


def to_rows(step: TensorDictBase, teams: int = 1) -> TensorDict:
    """What is remembered of a collected step.

    Args:
        step: batch size [teams * environments] or [teams * environments, steps].
        teams: how many trained side by side.

    Returns:
        Batch size [environments * steps, teams * uavs]. Only `terminated` stops the bootstrap, and
        an episode never terminates: the value beyond the horizon is bootstrapped.
    """
    *batch, uavs, _ = step.get(keys.OBSERVATION).shape
    rows = math.prod(batch) // teams

    def arrange(value: torch.Tensor) -> torch.Tensor:
        """[*batch, uavs, features] -> [rows, teams * uavs, features]."""
        value = value.reshape(teams, rows, uavs, -1)
        return value.transpose(0, 1).reshape(rows, teams * uavs, -1)

    def per_uav(key: str) -> torch.Tensor:
        return arrange(step.get(("next", key)).unsqueeze(-2).expand(*batch, uavs, 1))

    return TensorDict(
        {
            "observation": arrange(step.get(keys.OBSERVATION)),
            "action": arrange(step.get(keys.ACTION)),
            "next": {
                "observation": arrange(step.get(("next", *keys.OBSERVATION))),
                "reward": arrange(step.get(("next", *keys.REWARD))),
                "done": per_uav("done"),
                "terminated": per_uav("terminated"),
            },
        },
        batch_size=(rows, teams * uavs),
        device=step.device,
    )


def _to_batch(sample: TensorDictBase) -> TensorDict:
    """[batch, uavs] -> the layout that the losses read, batch size [batch]."""
    return TensorDict(
        {
            keys.AGENTS: sample.exclude("next"),
            "next": TensorDict({keys.AGENTS: sample.get("next")}, batch_size=sample.shape[:1]),
        },
        batch_size=sample.shape[:1],
    )
