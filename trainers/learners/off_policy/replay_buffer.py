"""Stores transitions in a replay buffer per UAV or per team (paper, sections IV.C and IV.D)."""

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
    """Stores the transitions of all UAVs and samples a batch for each UAV.

    A row holds the transitions of all UAVs at one step of one environment, for every seed. All
    tensors of the observation are stored.

    Args:
        context: context of the learner.
        batch_size: transitions per UAV in a sample.
        buffer_size: capacity in transitions of a UAV. A shared buffer has this capacity for all
            UAVs together.
    """

    def __init__(self, context: LearnerContext, *, batch_size: int, buffer_size: int):
        uavs, shared = context.num_uavs, context.shared_replay
        self.teams, self.device = len(context.seeds), context.device
        self._keys = keys.observation_keys(context.observation_spec)
        self._failures = context.failures
        size = -(-buffer_size // uavs) if shared else buffer_size
        # The run cannot fill more rows.
        self.capacity = min(size, context.total_steps * context.num_envs)
        self.needed = -(-batch_size // uavs) if shared else batch_size
        """rows that hold a full batch"""
        never = context.total_steps + 1
        fits = self.needed <= self.capacity
        self.learning_starts = -(-self.needed // context.num_envs) if fits else never
        self.written = 0
        """rows written so far, including overwritten ones"""
        self._sampler = TeamSampler(
            uavs,
            shared=shared,
            rows=self.capacity,
            seeds=context.seeds,
            device=context.device,
        )
        self._buffer = ReplayBuffer(
            # Compilable: otherwise TorchRL synchronises with the device to read the write position.
            storage=_PreallocatedStorage(self.capacity, device=context.device, compilable=True),
            writer=RoundRobinWriter(compilable=True),
            sampler=self._sampler,
            batch_size=batch_size,
            transform=_to_batch,
        )

    def __len__(self) -> int:
        return len(self._buffer)

    @property
    def ready(self) -> bool:
        """Whether the buffer holds a full batch."""
        return len(self) >= self.needed

    @property
    def draws(self) -> Tensor:
        """Number of samples so far, int64 [] on the device."""
        return self._sampler.draws

    def extend(self, rollout: TensorDictBase) -> None:
        """Stores a rollout, batch size [seeds * environments, steps]."""
        self.extend_rows(to_rows(rollout, self.teams, self._keys, failures=self._failures))

    def extend_rows(self, rows: TensorDictBase) -> None:
        """Stores rows of `to_rows`."""
        self._buffer.extend(rows)
        self.written += len(rows)

    def sample(self) -> TensorDict:
        """Samples a batch for each UAV: batch size [batch], with the keys of a rollout."""
        return self._buffer.sample()

    def state_dict(self, *, transitions: bool = True) -> dict[str, Tensor]:
        """Returns the counters and the filled rows, which are not copied."""
        state = {"draws": self.draws.clone(), "written": torch.tensor(self.written)}
        if not (transitions and len(self)):
            return state
        rows: Any = self._buffer.storage[: len(self)]
        return state | prefixed(rows=flatten(rows))

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restores the state of `state_dict` into an empty buffer of at least the same capacity."""
        self.draws.copy_(state["draws"])
        rows = group(state, "rows")
        if not rows:
            return
        content = unflatten(rows, 2, self.device)
        self._buffer.extend(content)
        self.written = int(state["written"])
        behind = self.written % self.capacity
        if self.written > self.capacity and behind:
            # Writing the first rows again moves the write position behind the newest row.
            self._buffer.extend(content[:behind])


class TeamSampler(RandomSampler):
    """Samples a batch for each UAV, uniformly, from a storage of shape [rows, teams * uavs].

    A sample is a function of the seed and the number of earlier samples. It is the same on every
    device and does not depend on other seeds that are trained in parallel.

    Args:
        uavs: UAVs per team.
        shared: whether a UAV samples from the transitions of its team, or only from its own.
        rows: capacity of the storage.
        seeds: seed of each team.
        device: device of the storage and the indices.
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
        # On the device, so that CUDA graphs read their current values.
        self.draws = torch.zeros((), dtype=torch.int64, device=device)
        self.filled = torch.zeros((), dtype=torch.int64, device=device)
        self._keys = counter_rng.fold_in(torch.tensor(seeds, device=device), Use.REPLAY_SAMPLE)
        self._team = torch.arange(len(seeds), device=device)[:, None, None] * uavs
        self._own = torch.arange(uavs, device=device)

    def extend(self, index: Tensor) -> None:
        """Counts the rows that the buffer has written."""
        self.filled.add_(len(index)).clamp_(max=self.rows)

    def sample(self, storage: TensorStorage, batch_size: int) -> tuple[tuple[Tensor, Tensor], dict]:
        """Returns rows and columns, int64 [batch_size, teams * uavs] each.

        Entry [:, k] is the batch of UAV k.
        """
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


class _PreallocatedStorage(LazyTensorStorage):
    """Allocates all memory with the first transition, so that a lack of memory is seen at once."""

    def _init(self, data: TensorDictBase) -> None:
        super()._init(data)
        self._storage.zero_()

    def get(self, index: tuple[Tensor, Tensor]) -> TensorDictBase:
        """Returns the rows that `TeamSampler` sampled.

        TorchRL's method first slices the storage to the filled rows. A CUDA graph would record the
        size of that slice.
        """
        return self._storage[index]


def to_rows(
    rollout: TensorDictBase, teams: int, observations: Sequence[Any], *, failures: bool = False
) -> TensorDict:
    """Returns the transitions of a rollout as rows of a replay buffer.

    Args:
        rollout: batch size [teams * environments] or [teams * environments, steps].
        teams: number of seeds that are trained in parallel.
        observations: keys of the observation.
        failures: whether to include "alive", from the end of each step.

    Returns:
        Batch size [environments * steps, teams * uavs]. Episodes are truncated and never
        terminated, so values beyond the horizon are bootstrapped.
    """
    dims = rollout.ndim
    rows, uavs = math.prod(rollout.shape) // teams, rollout.get(keys.ACTION).shape[dims]

    def arrange(value: Tensor) -> Tensor:
        """Maps [*batch, uavs, ...] to [rows, teams * uavs, ...]."""
        rest = value.shape[dims + 1 :]
        value = value.reshape(teams, rows, uavs, *rest)
        return value.transpose(0, 1).reshape(rows, teams * uavs, *rest)

    def per_uav(key: str) -> Tensor:
        return arrange(rollout.get(("next", key)).unsqueeze(-2).expand(*rollout.shape, uavs, 1))

    alive = {"alive": arrange(rollout.get(("next", *keys.ALIVE)))} if failures else {}
    following = {key[-1]: arrange(rollout.get(("next", *key))) for key in observations}
    return TensorDict(
        {
            **{key[-1]: arrange(rollout.get(key)) for key in observations},
            **alive,
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
    """Arranges a sample [batch, uavs] with the keys of a rollout, batch size [batch]."""
    return TensorDict(
        {
            keys.AGENTS: sample.exclude("next"),
            "next": TensorDict({keys.AGENTS: sample.get("next")}, batch_size=sample.shape[:1]),
        },
        batch_size=sample.shape[:1],
    )
