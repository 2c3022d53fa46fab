"""Plays one episode and keeps what can be drawn of it."""

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
from emberlink.envs.rendering.marks import ROLES, Moment


def record(
    env: TransformedEnv,
    policy: TensorDictModuleBase,
    comm: CommModule,
    *,
    steps: Collection[int],
    member: int = 0,
) -> list[Moment]:
    """One episode without noise, as `evaluate.play` plays it.

    Args:
        env: a recipe's environment.
        policy: writes ("agents", "action").
        comm: the environment's communication.
        steps: the moments to keep, 0 ... horizon.
        member: the environment that is kept.
    """
    world: Any = env.base_env
    hears = any(key in comm.out_keys for key in policy.in_keys)
    kept: list[Moment] = []
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        now = env.reset()
        for step in range(world.config.horizon + 1):
            if step > 0:
                now = step_mdp(env.step(policy(now)), keep_other=True)
            if step in steps:
                fire_map = world.fire_map[member]
                kept.append(moment(now[member], fire_map, hears=hears))
    return kept


def moment(now: TensorDictBase, fire_map: Tensor, *, hears: bool) -> Moment:
    """What can be drawn of one moment of one environment, by the keys that it holds.

    Links, roles and targets are drawn where the communication writes them.

    Args:
        now: the moment, batch size [].
        fire_map: uint8 [X, Y], see `WildfireEnv.fire_map`.
        hears: whether the policy reads anything that the communication writes.
    """
    links = now.get(keys.HEARS, None) if hears else None
    follows = now.get(keys.FOLLOWS, None) if hears else None
    target = now.get(keys.TARGET, None) if hears else None
    return Moment(
        step=int(now.get(keys.STEP)),
        seen=int(now.get(keys.SEEN)),
        burning=int(now.get(keys.BURNING)),
        fire_map=_array(fire_map),
        position=_array(now.get(keys.POSITION)),
        links=None if links is None else _array(links),
        roles=None if follows is None else _array(roles(follows)),
        target=None if target is None else _array(target),
    )


def roles(follows: Tensor) -> Tensor:
    """The role of each UAV, its place in `marks.ROLES`, int64 [..., n].

    Args:
        follows: int64 [..., n]: the discoverer that it follows, itself for a discoverer, -1 for
            nobody.
    """
    discoverer, seeker, wanderer = range(len(ROLES))
    itself = torch.arange(follows.shape[-1], device=follows.device)
    role = torch.where(follows == itself, discoverer, seeker)
    return role.masked_fill(follows < 0, wanderer)


def _array(tensor: Tensor) -> Any:
    return tensor.cpu().numpy().copy()
