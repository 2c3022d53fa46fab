"""Computes where UAVs meet so that what they saw reaches the base by the end of an episode."""

from typing import NamedTuple

import torch
from torch import Tensor

from emberlink.envs.world.radio import PASSING


class Rally(NamedTuple):
    """Stores where each UAV has to be, and from which step on."""

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
        needs = (apart.clamp(min=0) / speed + PASSING) * outside
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
        needs = apart.clamp(min=0) / speed + PASSING + period
        return (apart > 0) & (step.unsqueeze(-1) + needs >= self.step)
