"""Brings UAVs home: the base learns what they know if they form a chain of radios in time."""

import torch
from torch import Tensor

from emberlink.envs.config import WildfireConfig
from emberlink.envs.world import radio

_MARGIN = 15  # steps at home; messages may be lost, and are passed on over one link per step
_DIAGONAL = 2**0.5  # greatest distance over the ground that a unit of action leads
_BELOW_ONE = 1 - 2**-20  # so that rounding leads no UAV out of the box


def is_needed(world: WildfireConfig) -> bool:
    """Returns whether there is a base that hears UAVs at the ceiling."""
    return world.base is not None and world.radio.range > world.altitude[1]


def find(
    world: WildfireConfig, base: Tensor, burning: Tensor, step: Tensor, heard: Tensor
) -> Tensor:
    """Returns where each UAV has to be at the end, float32 [envs, n, 3].

    These are its place in a `radio.chain_to_fire` along x and y, and the greatest distance from it,
    cells.

    Args:
        world: the world and the team.
        base: float32 [2], cells.
        burning: bool [envs, n, X, Y], the cells that each UAV knows to burn.
        step: int64 [envs].
        heard: int64 [envs, n, n], the last step at which a UAV (row) knows the position of another
            one; -1 for never.
    """
    flies = radio.believed_to_fly(world, step, heard.clamp(min=0))
    place, reach = radio.chain_to_fire(world, base, burning, flies)
    return torch.cat((place, reach.unsqueeze(-1)), -1)


def steer(
    world: WildfireConfig, action: Tensor, home: Tensor, position: Tensor, step: Tensor
) -> Tensor:
    """Returns the actions of a step: home, if a UAV that flies on would come too late.

    A UAV has to be home, and at the ceiling, 15 steps before the end and from then on. The two are
    decided apart from each other: the action along x and y, and that along z.

    Args:
        world: the world and the team.
        action: float32 [envs, n, 3], the actions of the policy.
        home: float32 [envs, n, 3], see `find`.
        position: float32 [envs, n, 3], cells.
        step: int64 [envs, n], steps since the episode began.
    """
    speed = world.displacement
    way, up = home[..., :2] - position[..., :2], world.altitude[1] - position[..., 2:]
    # If it flies on, it may be farther away after this step, and has the steps that are left then.
    apart = torch.linalg.vector_norm(way, dim=-1) - home[..., 2] + _DIAGONAL * speed
    left = world.horizon - _MARGIN - (step + 1)
    leaves = (apart > 0) & (apart / speed > left)
    climbs = (up.squeeze(-1) + speed) / speed > left
    along = way / speed
    along = along / along.abs().amax(-1, keepdim=True).clamp(min=1)
    needed = _BELOW_ONE * torch.cat((along, (up / speed).clamp(max=1)), -1)
    performed = torch.stack((leaves, leaves, climbs), -1)
    return torch.where(performed, needed.to(action.dtype), action)
