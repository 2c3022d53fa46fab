"""What the environment reads and writes, as TorchRL specs."""

import torch
from torchrl.data import Binary, Bounded, Composite, TensorSpec, Unbounded

from . import keys


def observation_spec(envs: int, uavs: int, window: int | None = None) -> Composite:
    """Everything that a moment holds but reward and done, batch size [envs]; see `keys`.

    Args:
        envs: environments.
        uavs: UAVs in each.
        window: cells along a side of the window that is observed; None without it.
    """
    agents = (envs, uavs)

    def real(*shape: int) -> Unbounded:
        return Unbounded(torch.Size(shape), dtype=torch.float32)

    def whole(*shape: int) -> Unbounded:
        return Unbounded(torch.Size(shape), dtype=torch.int64)

    per_uav: dict[str, TensorSpec] = {
        keys.OBSERVATION[1]: real(*agents, len(keys.FEATURES)),
        keys.POSITION[1]: real(*agents, 3),
        keys.NEW_FIRE[1]: whole(*agents),
        keys.OLD_FIRE[1]: whole(*agents),
        keys.NO_FIRE[1]: whole(*agents),
        keys.NEW_CENTRE[1]: real(*agents, 2),
        keys.OLD_CENTRE[1]: real(*agents, 2),
        keys.HIT_BOUNDARY[1]: Binary(shape=torch.Size((*agents, 3)), dtype=torch.bool),
    }
    if window is not None:
        shape = torch.Size((*agents, 3, window, window))
        per_uav[keys.WINDOW[1]] = Binary(shape=shape, dtype=torch.bool)
    per_env = {key: whole(envs) for key in (keys.RNG_KEY, keys.STEP, keys.SEEN, keys.BURNING)}
    return Composite({keys.AGENTS: Composite(per_uav, shape=agents), **per_env}, shape=(envs,))


def action_spec(envs: int, uavs: int) -> Composite:
    """A displacement per UAV in [-1, 1] along x, y and z."""
    action = Bounded(-1.0, 1.0, torch.Size((envs, uavs, 3)), dtype=torch.float32)
    agents = Composite({keys.ACTION[1]: action}, shape=(envs, uavs))
    return Composite({keys.AGENTS: agents}, shape=(envs,))


def reward_spec(envs: int, uavs: int) -> Composite:
    """A reward per UAV."""
    reward = Unbounded(torch.Size((envs, uavs, 1)), dtype=torch.float32)
    agents = Composite({keys.REWARD[1]: reward}, shape=(envs, uavs))
    return Composite({keys.AGENTS: agents}, shape=(envs,))


def done_spec(envs: int) -> Composite:
    """Done, terminated (never) and truncated (at the horizon) per environment."""
    names = ("done", "terminated", "truncated")
    flags = {name: Binary(shape=torch.Size((envs, 1)), dtype=torch.bool) for name in names}
    return Composite(flags, shape=(envs,))
