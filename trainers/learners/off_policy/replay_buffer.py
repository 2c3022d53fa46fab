"""Stores transitions in a replay buffer per UAV or per team (paper, sections IV.C and IV.D)."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, ReplayBuffer, RoundRobinWriter

from emberlink.envs import keys
from emberlink.trainers.learners.base import LearnerContext
from emberlink.trainers.learners.off_policy.samplers import TeamSampler
from emberlink.trainers.learners.tensors import flatten, group, prefixed, unflatten

DONE = (keys.AGENTS, "done")
TERMINATED = (keys.AGENTS, "terminated")


class ReplayMemory:
    """Stores the transitions of all UAVs and samples a batch for each UAV.

    A row holds the transitions of all UAVs at one step of one environment, for every seed. All
    tensors of the observation are stored.

    Args:
        context: context of the learner.
        batch_size: transitions per UAV in a sample.
        buffer_size: capacity in transitions of a UAV. A shared buffer has this capacity for all
            UAVs together.
        joint: whether the UAVs of a team sample the same rows, see `TeamSampler`.
        mixed: whether a UAV samples transitions of other UAVs, too, if the buffer is shared.
    """

    def __init__(
        self,
        context: LearnerContext,
        *,
        batch_size: int,
        buffer_size: int,
        joint: bool = False,
        mixed: bool = True,
    ):
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
        self._sampler = self._make_sampler(
            uavs,
            shared=shared and mixed,
            joint=joint,
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
        )

    def _make_sampler(self, uavs: int, **more: Any) -> TeamSampler:
        return TeamSampler(uavs, **more)

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
        self.extend_rows(self._rows(rollout))

    def extend_rows(self, rows: TensorDictBase) -> None:
        """Stores rows of `to_rows`."""
        self._buffer.extend(rows)
        self.written += len(rows)

    def _rows(self, rollout: TensorDictBase) -> TensorDict:
        """Returns what is stored of a rollout, batch size [rows, teams * uavs]."""
        return to_rows(rollout, self.teams, self._keys, failures=self._failures)

    def sample(self) -> TensorDict:
        """Samples a batch for each UAV: batch size [batch], with the keys of a rollout."""
        return _to_batch(self._buffer.sample())

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
        self._sampler.written.fill_(self.written)


class _PreallocatedStorage(LazyTensorStorage):
    """Allocates all memory with the first transition, so that a lack of memory is seen at once."""

    def _init(self, data: TensorDictBase) -> None:
        super()._init(data)
        self._storage.zero_()

    def get(self, index: tuple[Tensor, Tensor]) -> TensorDictBase:
        """Returns the rows that a sampler chose.

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
    shape = rollout.shape

    def arranged(key: Any) -> Tensor:
        return arrange(rollout.get(key), len(shape), teams)

    action = arranged(keys.ACTION)
    rows, columns = action.shape[:2]

    def per_uav(key: str) -> Tensor:
        flags = rollout.get(("next", key)).unsqueeze(-2)
        return arrange(flags.expand(*shape, columns // teams, 1), len(shape), teams)

    alive = {"alive": arranged(("next", *keys.ALIVE))} if failures else {}
    return TensorDict(
        {
            **{key[-1]: arranged(key) for key in observations},
            **alive,
            "action": action,
            "next": {
                **{key[-1]: arranged(("next", *key)) for key in observations},
                "reward": arranged(("next", *keys.REWARD)),
                "done": per_uav("done"),
                "terminated": per_uav("terminated"),
            },
        },
        batch_size=(rows, columns),
        device=rollout.device,
    )


def arrange(value: Tensor, dims: int, teams: int) -> Tensor:
    """Maps a tensor of a rollout, [*batch, uavs, ...], to rows, [rows, teams * uavs, ...].

    Args:
        value: the tensor.
        dims: number of dimensions of the batch, the first of which is [teams * environments].
        teams: number of seeds that are trained in parallel.
    """
    rows, (uavs, *rest) = math.prod(value.shape[:dims]) // teams, value.shape[dims:]
    value = value.reshape(teams, rows, uavs, *rest)
    return value.transpose(0, 1).reshape(rows, teams * uavs, *rest)


def _to_batch(sample: TensorDictBase) -> TensorDict:
    """Arranges a sample [batch, uavs] with the keys of a rollout, batch size [batch]."""
    return TensorDict(
        {
            keys.AGENTS: sample.exclude("next"),
            "next": TensorDict({keys.AGENTS: sample.get("next")}, batch_size=sample.shape[:1]),
        },
        batch_size=sample.shape[:1],
    )
