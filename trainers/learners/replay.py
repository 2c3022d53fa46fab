"""Stores the UAVs' transitions, per UAV or shared by all (paper, sections IV.C and IV.D)."""

import logging
from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.data.replay_buffers.samplers import RandomSampler

from emberlink.envs import keys
from emberlink.trainers.learners.base import LearnerContext
from emberlink.trainers.learners.tensors import flatten, group, prefixed, unflatten

DONE = (keys.AGENTS, "done")
TERMINATED = (keys.AGENTS, "terminated")


class TeamReplay:
    """A replay buffer of rows with an entry for each UAV, which draws a batch for each UAV.

    Args:
        context: context of the learner.
        generator: draws the batches; on the device of the context.
        batch_size: entries per UAV in a batch.
        buffer_size: capacity in entries of a UAV. A shared buffer has this capacity for all UAVs
            together.
        joint: whether the UAVs draw the same rows, see `UavSampler`.
        mixed: whether a UAV also draws the entries of others, if the buffer is shared.
    """

    def __init__(
        self,
        context: LearnerContext,
        generator: torch.Generator,
        *,
        batch_size: int,
        buffer_size: int,
        joint: bool = False,
        mixed: bool = True,
    ):
        uavs, shared, self.device = context.num_uavs, context.shared_replay, context.device
        rows = -(-buffer_size // uavs) if shared else buffer_size
        self.capacity = min(rows, context.total_steps * context.num_envs)  # a run fills no more
        self.needed = -(-batch_size // uavs) if shared else batch_size
        """rows that hold a full batch"""
        self.written = 0
        """rows written so far, including overwritten ones"""
        logging.getLogger("torchrl").addFilter(_tells_no_storage)
        self._buffer = ReplayBuffer(
            storage=LazyTensorStorage(self.capacity, device=context.device),
            sampler=UavSampler(uavs, generator, shared=shared and mixed, joint=joint),
            batch_size=batch_size,
        )

    def __len__(self) -> int:
        return len(self._buffer)

    @property
    def ready(self) -> bool:
        """Whether the buffer holds a full batch."""
        return len(self) >= self.needed

    def extend(self, rows: TensorDictBase) -> None:
        """Stores rows, batch size [rows, uavs]."""
        self._buffer.extend(rows)
        self.written += len(rows)

    def sample(self) -> TensorDictBase:
        """Draws a batch for each UAV: batch size [batch, uavs]."""
        return self._buffer.sample()

    def state_dict(self) -> dict[str, Tensor]:
        """Returns the filled rows, which are not copied, and their number so far."""
        rows: Any = self._buffer.storage[: len(self)] if len(self) else TensorDict({})
        return prefixed(rows=flatten(rows)) | {"written": torch.tensor(self.written)}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restores the state of `state_dict` into an empty buffer of at least the same capacity."""
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


class UavSampler(RandomSampler):
    """Draws rows and columns of a storage [rows, uavs] uniformly, a batch for each UAV.

    Args:
        uavs: number of UAVs.
        generator: on the device of the storage.
        shared: whether a UAV draws the entries of all UAVs, or only its own.
        joint: whether all UAVs draw the same rows; with `shared`, the columns are rolled by a
            random shift per row.
    """

    def __init__(self, uavs: int, generator: torch.Generator, *, shared: bool, joint: bool):
        super().__init__()
        self.generator, self.shared, self.joint = generator, shared, joint
        self.own = torch.arange(uavs, device=generator.device)

    def sample(self, storage: Any, batch_size: int) -> tuple[tuple[Tensor, Tensor], dict]:
        """Returns rows and columns, int64 [batch_size, uavs] each; [:, k] is for UAV k."""
        rows = self._draw(batch_size, len(storage))
        columns = self.own.expand(batch_size, -1)
        if self.shared:
            drawn = self._draw(batch_size, len(self.own))
            columns = (columns + drawn) % len(self.own) if self.joint else drawn
        return (rows, columns), {}

    def _draw(self, count: int, limit: int) -> Tensor:
        size = count, 1 if self.joint else len(self.own)
        drawn = torch.randint(limit, size, generator=self.generator, device=self.own.device)
        return drawn.expand(-1, len(self.own))


def _tells_no_storage(record: logging.LogRecord) -> bool:
    return "Initialized LazyTensorStorage" not in str(record.msg)  # at each training's first row


def to_rows(rollout: TensorDictBase, context: LearnerContext) -> TensorDict:
    """Returns the transitions of a rollout as rows, batch size [environments * steps, uavs].

    Episodes are truncated and never terminated, so values beyond the horizon are bootstrapped.

    Args:
        rollout: batch size [environments, steps].
        context: context of the learner; "alive", from the end of each step, is kept if UAVs fail.
    """
    observed = [name for _, name in keys.observation_keys(context.observation_spec)]
    now, after = rollout.get(keys.AGENTS), rollout.get(("next", keys.AGENTS))
    rows = now.select(*observed, "action")
    following = after.select(*observed, "reward")
    for key in ("done", "terminated"):
        following.set(key, rollout.get(("next", key)).unsqueeze(2).expand(*now.shape, 1))
    if context.failures:
        rows.set("alive", after.get("alive"))
    return rows.set("next", following).flatten(0, 1)


def to_batch(sample: TensorDictBase) -> TensorDict:
    """Arranges a sample of transitions [batch, uavs] with the keys of a rollout, [batch]."""
    following = TensorDict({keys.AGENTS: sample.get("next")}, batch_size=sample.shape[:1])
    parts = {keys.AGENTS: sample.exclude("next"), "next": following}
    return TensorDict(parts, batch_size=sample.shape[:1])
