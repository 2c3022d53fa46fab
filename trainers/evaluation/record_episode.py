"""Records the data for drawing an episode."""

from collections.abc import Collection
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import TransformedEnv, set_exploration_type, step_mdp
from torchrl.envs.utils import ExplorationType

from emberlink.comm.base import CommModule
from emberlink.envs import keys
from emberlink.envs.rendering.marks import ROLES, FrameData


def record_episode(
    env: TransformedEnv,
    policy: TensorDictModuleBase,
    comm: CommModule,
    *,
    steps: Collection[int],
    member: int = 0,
) -> list[FrameData]:
    """Returns the frames of one episode without exploration noise.

    Args:
        env: environments with communication.
        policy: writes ("agents", "action").
        comm: communication module of the environment.
        steps: steps to record, from 0 to the horizon.
        member: index of the environment to record.
    """
    world: Any = env.base_env
    hears = any(key in comm.out_keys for key in policy.in_keys)
    frames: list[FrameData] = []
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        td = env.reset()
        for step in range(world.config.horizon + 1):
            if step > 0:
                td = step_mdp(env.step(policy(td)), keep_other=True)
            if step in steps:
                fire_map = world.fire_map[member]
                base = world.config.base
                frames.append(frame_data(td[member], fire_map, hears=hears, base=base))
    return frames


def frame_data(
    td: TensorDictBase,
    fire_map: Tensor,
    *,
    hears: bool,
    base: tuple[float, float] | None = None,
) -> FrameData:
    """Returns the data for drawing one environment at one step.

    Links, roles and targets are included if the communication module writes them.

    Args:
        td: output of a reset or a step, batch size [].
        fire_map: uint8 [X, Y], see `WildfireEnv.fire_map`.
        hears: whether the policy reads an output of the communication module.
        base: place of the base station, cells; None without one.
    """
    links = td.get(keys.HEARS, None) if hears else None
    follows = td.get(keys.FOLLOWS, None) if hears else None
    target = td.get(keys.TARGET, None) if hears else None
    return FrameData(
        step=int(td.get(keys.STEP)),
        seen=int(td.get(keys.SEEN)),
        burnt=int(td.get(keys.BURNT)),
        fire_map=_array(fire_map),
        position=_array(td.get(keys.POSITION)),
        links=None if links is None else _array(links),
        roles=None if follows is None else _array(roles(follows)),
        target=None if target is None else _array(target),
        alive=_array(td.get(keys.ALIVE)),
        base=base,
    )


def roles(follows: Tensor) -> Tensor:
    """Returns the role of each UAV as an index in `marks.ROLES`, int64 [..., n].

    Args:
        follows: int64 [..., n], the UAV that each UAV follows: itself for a discoverer, -1 for
            none.
    """
    discoverer, seeker, wanderer = range(len(ROLES))
    itself = torch.arange(follows.shape[-1], device=follows.device)
    role = torch.where(follows == itself, discoverer, seeker)
    return role.masked_fill(follows < 0, wanderer)


def _array(tensor: Tensor) -> Any:
    return tensor.cpu().numpy().copy()
