"""Builds time steps of an environment by hand, and the consensus for them."""

from dataclasses import replace

import torch
from tensordict import TensorDict

from emberlink.comm.base import Communication
from emberlink.comm.consensus import Consensus, ConsensusConfig
from emberlink.envs import keys
from emberlink.envs.config import WildfireConfig

WORLD = WildfireConfig(grid=(64, 64))


def time_step(
    position, new, old=None, *, centre=None, old_centre=None, hit_boundary=None, step=0, seed=1
):
    """Returns a time step of the environment from lists per UAV, or per environment and UAV."""
    position = torch.as_tensor(position, dtype=torch.float32)
    position = position.unsqueeze(0) if position.ndim == 2 else position
    envs, uavs = position.shape[:2]

    def of_uavs(values, *shape, dtype=torch.float32):
        if values is None:
            return torch.zeros(envs, uavs, *shape, dtype=dtype)
        return torch.as_tensor(values, dtype=dtype).expand(envs, uavs, *shape).clone()

    return TensorDict(
        {
            keys.OBSERVATION: torch.zeros(envs, uavs, 6),
            keys.POSITION: position,
            keys.NEW_FIRE: of_uavs(new, dtype=torch.int64),
            keys.OLD_FIRE: of_uavs(old, dtype=torch.int64),
            keys.NEW_CENTRE: of_uavs(centre, 2),
            keys.OLD_CENTRE: of_uavs(old_centre, 2),
            keys.HIT_BOUNDARY: of_uavs(hit_boundary, 3, dtype=torch.bool),
            keys.REWARD: torch.zeros(envs, uavs, 1),
            keys.RNG_KEY: torch.arange(envs) + seed,
            keys.STEP: torch.full((envs,), step),
        },
        batch_size=[envs],
    )


def communication(now: TensorDict, config=None, world=WORLD) -> Communication:
    """Returns the consensus for as many environments and UAVs as a time step has."""
    envs, uavs = now[keys.POSITION].shape[:2]
    module = Consensus(replace(world, num_uavs=uavs), config or ConsensusConfig(), envs)
    return Communication(module)
