"""Computes where UAVs meet so that what they saw reaches the base by the end of an episode."""

from typing import NamedTuple

import torch
from torch import Tensor

from emberlink.envs.config import WildfireConfig

_NEARER = 0.97  # of the range, so that rounding and small errors of position break no link
_RELAY_REACH = 0.2  # cells; distance at which a relay is at its place
_MARGIN = 15  # steps at the meeting place; messages may be lost, and are passed on step by step


class Rally(NamedTuple):
    """Says near which place each UAV has to be from which step on."""

    place: Tensor
    """float32 [envs, n, 2], cells"""
    reach: Tensor
    """float32 [envs, n]: greatest distance from the place, cells"""
    step: Tensor
    """float32 [envs, n]; inf for a UAV that does not have to be anywhere"""

    def too_late(self, cells: tuple[Tensor, Tensor], arrives: Tensor, speed: float) -> Tensor:
        """Returns whether a UAV that flies to a cell first is late, bool [envs, n, X, Y].

        Args:
            cells: the places of the cells along x, [X], and along y, [Y].
            arrives: float32 [envs, n, X, Y], the step at which the UAV arrives at the cell.
            speed: cells per step.
        """
        along_x = (self.place[..., :1] - cells[0]).unsqueeze(-1)
        along_y = (self.place[..., 1:] - cells[1]).unsqueeze(-2)
        apart = torch.hypot(along_x, along_y) - self.reach[..., None, None]
        outside = apart > 0
        needs = (apart.clamp(min=0) / speed + _MARGIN) * outside
        return arrives + needs > self.step[..., None, None]

    def leaves(self, ground: Tensor, step: Tensor, speed: float, period: int) -> Tensor:
        """Returns whether a UAV has to leave for its place before the next plan, bool [envs, n].

        Args:
            ground: float32 [envs, n, 2], positions, cells.
            step: int64 [envs].
            speed: cells per step.
            period: steps between plans.
        """
        apart = torch.linalg.vector_norm(self.place - ground, dim=-1) - self.reach
        needs = apart.clamp(min=0) / speed + _MARGIN + period
        return (apart > 0) & (step.unsqueeze(-1) + needs >= self.step)


def chain(
    world: WildfireConfig, base: Tensor, centre: Tensor, rank: Tensor, count: Tensor
) -> tuple[Tensor, Tensor]:
    """Returns the place of each UAV in a chain of radios from the base towards a fire.

    UAVs hold places at distances of one radio range from the base to the middle of the fire, as
    many as needed; at least one UAV is left over. The others have to be in range of the last place.

    Args:
        world: the world and the team.
        base: float32 [2], cells.
        centre: float32 [envs, n, 2], the middle of the fire, cells.
        rank: int64 [envs, n], place of each UAV in the chain, 0 next to the base.
        count: int64, broadcast against [envs, n], UAVs in the team.

    Returns:
        Place, float32 [envs, n, 2], and reach, float32 [envs, n], as in `Rally`.
    """
    hop = _NEARER * world.radio.range
    height = world.altitude[1]
    first = _NEARER * max(world.radio.range**2 - height**2, 0.0) ** 0.5
    way = centre - base
    distance = torch.linalg.vector_norm(way, dim=-1)
    needed = ((distance - first) / max(hop, 1e-6)).ceil()
    relays = torch.minimum(needed, (count - 1).float()).clamp(min=0)
    link = torch.minimum(rank.float(), relays - 1).clamp(min=0)
    along = torch.where(relays > 0, (first + hop * link).minimum(distance), 0.0)
    place = base + way * (along / distance.clamp(min=1e-6)).unsqueeze(-1)
    reach = torch.where(relays > 0, hop, first)
    return place, torch.where(rank < relays, _RELAY_REACH, reach)
