"""Plans the flights of scripted policies: target cells, and places to meet in time."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from emberlink.envs.wildfire import WildfireEnv
from emberlink.envs.world.radio import PASSING
from emberlink.envs.world.sensor import search_altitude, view_radius

REPORT = 250
"""steps from one report to a base to the next, for policies that report all the time"""
HERE = 2.0
"""cells added to distances, so that no cell is at distance 0"""


class Targets(nn.Module):
    """Chooses the cell above which each UAV sees the highest sum of weights per cost.

    Args:
        env: the environment; its grid and the view from the `search_altitude` are used.
        claim: cells within this distance of a UAV's target, along x and y, have no weight for
            other UAVs that know of the target.
    """

    columns: Tensor
    rows: Tensor
    _view_x: Tensor
    _view_y: Tensor

    def __init__(self, env: WildfireEnv, *, claim: float):
        super().__init__()
        world = env.config
        self._claim = claim
        radius = view_radius(search_altitude(world), world.view_angle)
        for name, side in zip(("columns", "rows"), world.grid, strict=True):
            self.register_buffer(name, torch.arange(side).float(), persistent=False)
        for name, side in zip(("_view_x", "_view_y"), world.grid, strict=True):
            self.register_buffer(name, band(side, radius), persistent=False)
        self.to(env.device)

    def distance(self, ground: Tensor) -> Tensor:
        """Returns Chebyshev distances, float [..., X, Y], of all cells from points [..., 2]."""
        along_x = (ground[..., :1] - self.columns).abs().unsqueeze(-1)
        along_y = (ground[..., 1:] - self.rows).abs().unsqueeze(-2)
        return torch.maximum(along_x, along_y)

    def in_view(self, weight: Tensor) -> Tensor:
        """Returns the sum of weights in view from above each cell, float [..., X, Y]."""
        return self._view_x @ weight @ self._view_y

    def choose(
        self, ground: Tensor, weight: Tensor, cost: Tensor, hears: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Assigns a cell to each UAV, in the order of falling values.

        Args:
            ground: float32 [envs, n, 2], positions, cells.
            weight: float32 [envs, n, X, Y], the weight of seeing each cell, at least 0.
            cost: float32 [envs, n, X, Y], positive; inf for cells that are no target.
            hears: bool [envs, n, n], whether a UAV (row) knows of another one's target.

        Returns:
            The cells, float32 [envs, n, 2], the position of a UAV without a cell of positive value;
            and the values, float32 [envs, n].
        """
        envs, uavs = ground.shape[:2]
        value = (self.in_view(weight) / cost).flatten(2).amax(-1)
        order = value.argsort(dim=-1, descending=True, stable=True)
        target, worth = ground.clone(), torch.zeros_like(value)
        taken_x = ground.new_zeros(envs, uavs, len(self.columns))
        taken_y = ground.new_zeros(envs, uavs, len(self.rows))
        env = torch.arange(envs, device=ground.device)
        for turn in order.unbind(1):
            heard = hears[env, turn].float().unsqueeze(-1)
            claimed = (taken_x * heard).mT @ taken_y > 0
            left = weight[env, turn].masked_fill_(claimed, 0.0)
            best, index = (self.in_view(left) / cost[env, turn]).flatten(1).max(-1)
            cell = torch.stack((index // len(self.rows), index % len(self.rows)), -1).float()
            found = (best > 0).unsqueeze(-1)
            cell = torch.where(found, cell, ground[env, turn])
            target[env, turn], worth[env, turn] = cell, best
            near_x = (cell[:, :1] - self.columns).abs() <= self._claim
            near_y = (cell[:, 1:] - self.rows).abs() <= self._claim
            taken_x[env, turn] = (near_x & found).float()
            taken_y[env, turn] = near_y.float()
        return target, worth


def band(side: int, reach: float) -> Tensor:
    """Returns whether each two of `side` places in a row are at most `reach` apart, as 0 and 1."""
    place = torch.arange(side)
    return ((place.unsqueeze(-1) - place).abs() <= reach).float()


def next_report(step: Tensor, every: int, horizon: int) -> Tensor:
    """Returns the next multiple of `every`, at most the horizon, float32 [envs, 1].

    Args:
        step: int64 [envs], steps since the episode began.
    """
    return ((step // every + 1) * every).clamp(max=horizon).unsqueeze(-1).float()


def plan_period(flown: float, displacement: float) -> int:
    """Returns the steps in which a UAV flies `flown` cells, from 1 to 10."""
    return min(10, max(1, round(flown / displacement)))


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
            step, period: int64 [envs], and steps between plans.
            speed: cells per step.
        """
        apart = torch.linalg.vector_norm(self.place - ground, dim=-1) - self.reach
        needs = apart.clamp(min=0) / speed + PASSING + period
        return (apart > 0) & (step.unsqueeze(-1) + needs >= self.step)
