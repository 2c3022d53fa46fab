"""Plans the flights of scripted policies: target cells, and places to meet in time."""

import math
from abc import ABC, abstractmethod
from typing import ClassVar, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from emberlink.envs import keys
from emberlink.envs.wildfire import WildfireEnv
from emberlink.envs.world.radio import PASSING
from emberlink.policies.scripted.base import Scripted

REPORT = 250
"""steps from one report to a base to the next, for policies that report all the time"""
HERE = 2.0
"""cells added to distances, so that no cell is at distance 0"""


class Rally(NamedTuple):
    """Stores where each UAV has to be, and from which step on."""

    place: Tensor
    """float32 [envs, n, 2], cells"""
    reach: Tensor
    """float32 [envs, n]: greatest distance from the place, cells"""
    step: Tensor
    """float32 [envs, n]; inf for a UAV that does not have to be anywhere"""


class Searcher(Scripted, ABC):
    """Flies to the cells above which UAVs see the highest sum of weights per cost.

    UAVs choose anew whenever they can have flown some cells (every 10 steps at most). The targets
    are carried in the TensorDict.
    """

    TARGET: ClassVar[str]
    """key of the targets, float [num_envs, n, 2], cells"""
    flown: ClassVar[float]
    """cells flown between two plans"""
    claim: ClassVar[float]
    """cells within this distance of a UAV's target, along x and y, have no weight for other UAVs
    that know of the target"""

    columns: Tensor
    rows: Tensor
    _view_x: Tensor
    _view_y: Tensor
    _base: Tensor

    def __init__(self, env: WildfireEnv):
        super().__init__(env)
        self.in_keys.append(keys.ALIVE)
        self.out_keys.append(self.TARGET)
        self.period = min(10, max(1, round(self.flown / self.world.displacement)))
        for name, side in zip(("columns", "rows"), self.world.grid, strict=True):
            self.register_buffer(name, torch.arange(side).float(), persistent=False)
        for name, side in zip(("_view_x", "_view_y"), self.world.grid, strict=True):
            self.register_buffer(name, band(side, self.radius), persistent=False)
        self.register_buffer("_base", torch.tensor(self.world.base or (0.0, 0.0)))
        self.to(env.device)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        target = self.carried(tensordict, self.TARGET, tensordict.get(keys.POSITION)[..., :2])
        due = tensordict.get(keys.STEP) % self.period == 0
        if due.any():
            target = torch.where(due.view(-1, 1, 1), self.plan(tensordict), target)
        return self.fly(tensordict.set(self.TARGET, target), self.above(target))

    @abstractmethod
    def plan(self, tensordict: TensorDictBase) -> Tensor:
        """Returns a new target of each UAV, float [num_envs, n, 2], cells."""

    def search(
        self, step: Tensor, ground: Tensor, weight: Tensor, hears: Tensor, rally: Rally | None
    ) -> Tensor:
        """Returns targets from which UAVs come to where they have to be in time.

        Args:
            step: int64 [envs], steps since the episode began.
            ground, weight, hears: see `choose`.
            rally: where the UAVs have to be; None if nowhere.
        """
        distance = self.distance(ground)
        cost, speed = distance + HERE, self.world.displacement
        if rally is None:
            return self.choose(ground, weight, cost, hears)[0]
        along_x = (rally.place[..., :1] - self.columns).unsqueeze(-1)
        along_y = (rally.place[..., 1:] - self.rows).unsqueeze(-2)
        apart = torch.hypot(along_x, along_y) - rally.reach[..., None, None]
        needs = (apart.clamp(min=0) / speed + PASSING) * (apart > 0)
        arrives = step.view(-1, 1, 1, 1) + distance / speed
        cost.masked_fill_(arrives + needs > rally.step[..., None, None], math.inf)
        target, value = self.choose(ground, weight, cost, hears)
        # A UAV without a target leaves for its place if the next plan would be too late.
        apart = torch.linalg.vector_norm(rally.place - ground, dim=-1) - rally.reach
        needs = apart.clamp(min=0) / speed + PASSING + self.period
        leaves = (apart > 0) & (step.unsqueeze(-1) + needs >= rally.step) & (value <= 0)
        return torch.where(leaves.unsqueeze(-1), rally.place, target)

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
            near_x = (cell[:, :1] - self.columns).abs() <= self.claim
            near_y = (cell[:, 1:] - self.rows).abs() <= self.claim
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
