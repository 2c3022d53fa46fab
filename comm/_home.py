"""Brings UAVs home: the base learns what they know if they form a chain of radios in time."""

import torch
from torch import Tensor

from emberlink.envs.config import WildfireConfig
from emberlink.envs.world import motion, radio

_DIAGONAL = 2**0.5  # greatest distance over the ground that a unit of action leads


def is_needed(world: WildfireConfig) -> bool:
    """Returns whether there is a base that hears UAVs at the ceiling."""
    return world.base is not None and world.radio.range > world.altitude[1]


def steer(
    world: WildfireConfig, action: Tensor, home: Tensor, position: Tensor, step: Tensor
) -> Tensor:
    """Returns the actions of a step: home, if a UAV that flies on would come too late.

    A UAV has to be home, and at the ceiling, 15 steps before the end and from then on. The two are
    decided apart from each other: the action along x and y, and that along z.

    Args:
        world: the world and the team.
        action: float32 [envs, n, 3], the actions of the policy.
        home: float32 [envs, n, 3], each UAV's place along x and y, and the greatest distance from
            it, cells.
        position: float32 [envs, n, 3], cells.
        step: int64 [envs, n], steps since the episode began.
    """
    speed = world.displacement
    way, up = home[..., :2] - position[..., :2], world.altitude[1] - position[..., 2:]
    # If it flies on, it may be farther away after this step, and has the steps that are left then.
    apart = torch.linalg.vector_norm(way, dim=-1) - home[..., 2] + _DIAGONAL * speed
    left = world.horizon - radio.PASSING - (step + 1)
    leaves = (apart > 0) & (apart / speed > left)
    climbs = (up.squeeze(-1) + speed) / speed > left
    needed = torch.cat((motion.towards(way, speed), motion.towards(up, speed)), -1)
    return torch.where(torch.stack((leaves, leaves, climbs), -1), needed, action)
