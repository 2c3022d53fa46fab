"""The tensors that the environment reads and writes, as TorchRL specs."""

import torch
from tensordict import TensorDict
from torchrl.data import Binary, Bounded, Composite, TensorSpec, Unbounded

from emberlink.envs import keys
from emberlink.envs.config import WildfireConfig

DONE_NAMES = ("done", "terminated", "truncated")


def observation_spec(
    envs: int, world: WildfireConfig, window: int, true_map: bool = False
) -> Composite:
    """Returns the spec of what a reset writes but the done flags, batch size [envs]; see `keys`.

    Args:
        envs: number of environments.
        world: the team, and what is measured.
        window: cells along a side of the window in view.
        true_map: whether the map is written, too.
    """
    agents = (envs, world.num_uavs)

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
        keys.ALIVE[1]: Binary(shape=torch.Size(agents), dtype=torch.bool),
    }
    if world.observation == "window":
        shape = torch.Size((*agents, 3, window, window))
        per_uav[keys.WINDOW[1]] = Binary(shape=shape, dtype=torch.bool)
    if world.observation == "sight":
        shape = torch.Size((*agents, window, window))
        per_uav[keys.SIGHT[1]] = Unbounded(shape, dtype=torch.uint8)
    counts = [keys.RNG_KEY, keys.STEP, keys.SEEN, keys.BURNING, keys.BURNT]
    per_env: dict[str, TensorSpec] = {key: whole(envs) for key in counts}
    if world.measures == "all":
        per_env |= {key: real(envs) for key in (keys.FRONT_AGE, keys.FRONT_AGE_P95)}
    if world.base is not None:
        per_env |= {keys.BASE_SEEN: whole(envs), keys.BASE_AGE: real(envs)}
    if true_map:
        shape = torch.Size((envs, *world.grid))
        per_env[keys.TRUE_MAP] = Unbounded(shape, dtype=torch.uint8)
    return Composite({keys.AGENTS: Composite(per_uav, shape=agents), **per_env}, shape=(envs,))


def action_spec(envs: int, uavs: int) -> Composite:
    """Returns the spec of the actions: a displacement per UAV in [-1, 1] along x, y and z."""
    action = Bounded(-1.0, 1.0, torch.Size((envs, uavs, 3)), dtype=torch.float32)
    agents = Composite({keys.ACTION[1]: action}, shape=(envs, uavs))
    return Composite({keys.AGENTS: agents}, shape=(envs,))


def reward_spec(envs: int, uavs: int) -> Composite:
    """Returns the spec of the rewards, one per UAV."""
    reward = Unbounded(torch.Size((envs, uavs, 1)), dtype=torch.float32)
    agents = Composite({keys.REWARD[1]: reward}, shape=(envs, uavs))
    return Composite({keys.AGENTS: agents}, shape=(envs,))


def done_spec(envs: int, uavs: int | None = None) -> Composite:
    """Returns the spec of done, terminated (never true) and truncated (at the horizon).

    Args:
        envs: number of environments.
        uavs: UAVs per environment where each has flags too; None for one set per environment.
    """

    def flags(*shape: int) -> dict[str, TensorSpec]:
        return {
            name: Binary(shape=torch.Size((*shape, 1)), dtype=torch.bool) for name in DONE_NAMES
        }

    root = flags(envs)
    if uavs is not None:
        root[keys.AGENTS] = Composite(flags(envs, uavs), shape=(envs, uavs))
    return Composite(root, shape=(envs,))


def known_tensordict(
    source: dict, batch_size: torch.Size, device: torch.device | None
) -> TensorDict:
    """Returns a TensorDict of tensors whose shapes and device are known to be right.

    Checking them takes a quarter of a step of one environment.
    """
    return TensorDict._new_unsafe(source, batch_size=batch_size, device=device)
