"""Replay memory of a team: one per UAV, or one for all (paper, sections IV.C and IV.D)."""

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.data.replay_buffers.samplers import RandomSampler
from torchrl.data.replay_buffers.storages import TensorStorage

from emberlink.envs import keys

DONE = (keys.AGENTS, "done")
TERMINATED = (keys.AGENTS, "terminated")


class TeamSampler(RandomSampler):
    """Draws a batch for each UAV from a storage of shape [rows, uavs], uniformly.

    Args:
        uavs: how many.
        shared: whether a UAV draws from everyone's transitions or from its own alone.
    """

    def __init__(self, uavs: int, *, shared: bool):
        super().__init__()
        self.uavs, self.shared = uavs, shared

    def sample(
        self, storage: TensorStorage, batch_size: int
    ) -> tuple[tuple[torch.Tensor, torch.Tensor], dict]:
        """Rows and columns, int64 [batch_size, uavs] each; column k belongs to UAV k's batch."""
        shape, device = (batch_size, self.uavs), storage.device

        def draw(limit: int) -> torch.Tensor:
            return torch.randint(limit, shape, generator=self._rng, device=device)

        if len(storage) == 0:
            raise RuntimeError("cannot sample from an empty replay memory")
        own = torch.arange(self.uavs, device=device).expand(shape)
        return (draw(len(storage)), draw(self.uavs) if self.shared else own), {}


def make_memory(
    uavs: int,
    *,
    shared: bool,
    capacity: int,
    batch: int,
    most: int,
    device: torch.device | str,
    generator: torch.Generator,
) -> ReplayBuffer:
    """A team's replay memory.

    Args:
        uavs: how many.
        shared: one memory for all, or one per UAV.
        capacity: UAV transitions that a memory holds; a shared one holds them of all together.
        batch: transitions per UAV and sample.
        most: rows (moments of an environment) that will ever be stored, so that no more is
            allocated than a run can fill.
        generator: of the samples.
    """
    rows = -(-capacity // uavs) if shared else capacity
    return ReplayBuffer(
        storage=LazyTensorStorage(min(rows, most), device=device),
        sampler=TeamSampler(uavs, shared=shared),
        batch_size=batch,
        transform=_to_batch,
        generator=generator,
    )


def rows_needed(uavs: int, *, shared: bool, batch: int) -> int:
    """Rows in the storage at which a memory first holds a full batch."""
    return -(-batch // uavs) if shared else batch


def to_rows(step: TensorDictBase) -> TensorDict:
    """What is remembered of a collected step, batch size [environments * steps, uavs].

    Only `terminated` stops the bootstrap, and an episode never terminates: the value beyond the
    horizon is bootstrapped.
    """
    observation = step.get(keys.OBSERVATION)
    shape = observation.shape[:-1]

    def per_uav(key: str) -> torch.Tensor:
        return step.get(("next", key)).unsqueeze(-2).expand(*shape, 1)

    rows = TensorDict(
        {
            "observation": observation,
            "action": step.get(keys.ACTION),
            "next": {
                "observation": step.get(("next", *keys.OBSERVATION)),
                "reward": step.get(("next", *keys.REWARD)),
                "done": per_uav("done"),
                "terminated": per_uav("terminated"),
            },
        },
        batch_size=shape,
    )
    return rows.flatten(0, len(shape) - 2) if len(shape) > 2 else rows


def _to_batch(sample: TensorDictBase) -> TensorDict:
    """[batch, uavs] -> the layout that the losses read, batch size [batch]."""
    return TensorDict(
        {
            keys.AGENTS: sample.exclude("next"),
            "next": TensorDict({keys.AGENTS: sample.get("next")}, batch_size=sample.shape[:1]),
        },
        batch_size=sample.shape[:1],
    )
