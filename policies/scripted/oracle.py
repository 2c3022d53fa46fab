"""A scripted policy that knows the fire: an upper baseline of coverage."""

import math

import torch
from tensordict import TensorDictBase
from torch import Tensor

from emberlink.envs import keys
from emberlink.envs.wildfire import WildfireEnv
from emberlink.policies.planning import Foresight
from emberlink.policies.scripted.base import Scripted

_STEP_COST = 1000.0  # cells; above any distance on a map, so that burning cells come first


class Oracle(Scripted):
    """Flies to the nearest uncovered cells, given the whole fire and the cells seen so far.

    At every step each UAV is assigned a cell that no UAV has seen. The cost of a cell is its
    Chebyshev distance from the UAV plus 1000 cells for each step until it burns. So burning cells
    come first, then the cells that burn soonest. The UAV with the lowest cost chooses first and
    reserves all cells in view from its cell at the maximum altitude, so that UAVs spread out. Ties
    go to the lower index of UAVs and of cells. A UAV without a cell stays at its position, and one
    that has failed gets none. All UAVs fly at the maximum altitude.

    Where cells burn out, or with a base, the targets are those of `Foresight` instead.

    Args:
        env: the environment that it acts in; its fire is read at every step.
    """

    TARGET = "_oracle_target"
    columns: Tensor
    rows: Tensor

    def __init__(self, env: WildfireEnv):
        super().__init__(env)
        self._env = (env,)  # in a tuple, so that it is not registered as a submodule
        foresees = env.burn_out is not None or self.world.base is not None
        self._foresight = Foresight(env) if foresees else None
        self.in_keys.append(keys.ALIVE)
        if foresees:
            self.out_keys.append(self.TARGET)
        self.register_buffer("columns", torch.arange(self.world.grid[0]).double().to(env.device))
        self.register_buffer("rows", torch.arange(self.world.grid[1]).double().to(env.device))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self._foresight is None:
            target = self._nearest_cells(tensordict)
        else:
            target = self._foreseen(tensordict, self._foresight)
        ceiling = self.high[2:].expand_as(target[..., :1])
        return self.fly(tensordict, torch.cat((target, ceiling), -1))

    def _foreseen(self, tensordict: TensorDictBase, foresight: Foresight) -> Tensor:
        """Returns the targets of `Foresight`, float32 [num_envs, n, 2]."""
        target = self.carried(tensordict, self.TARGET, tensordict.get(keys.POSITION)[..., :2])
        due = tensordict.get(keys.STEP) % foresight.period == 0
        if due.any():
            target = torch.where(due.view(-1, 1, 1), foresight.plan(tensordict), target)
        tensordict.set(self.TARGET, target)
        return target

    def _nearest_cells(self, tensordict: TensorDictBase) -> Tensor:
        """Returns the cell that is assigned to each UAV, float64 [num_envs, n, 2]."""
        ground, alive = tensordict.get(keys.POSITION)[..., :2].double(), tensordict.get(keys.ALIVE)
        delay = self._delay(tensordict.get(keys.STEP))
        nearest = torch.stack([self._nearest(delay, xy)[0] for xy in ground.unbind(1)], -1)
        nearest.masked_fill_(~alive, math.inf)  # the last to choose
        target = ground.clone()
        for turn in torch.sort(nearest, dim=-1, stable=True).indices.unsqueeze(-1).unbind(1):
            uav = turn.unsqueeze(-1).expand(-1, 1, 2)
            xy = ground.gather(1, uav).squeeze(1)
            cost, cell = self._nearest(delay, xy)
            chooses = cost.isfinite().unsqueeze(-1) & alive.gather(1, turn)
            target.scatter_(1, uav, torch.where(chooses, cell, xy).unsqueeze(1))
            self._reserve(delay, cell)
        return target

    def _delay(self, step: Tensor) -> Tensor:
        """Returns the cost of the wait for each cell, float64 [num_envs, X, Y], cells.

        It is infinite for cells that have been seen or never burn.
        """
        (env,) = self._env
        arrival = env.arrival_time.double()
        wait = (arrival - step.view(-1, 1, 1)).clamp_(min=0)
        done = (env.fire_map == 1) | (arrival > self.world.horizon)
        return (wait * _STEP_COST).masked_fill_(done, math.inf)

    def _nearest(self, delay: Tensor, ground: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the cell of lowest cost for one UAV of every environment.

        Args:
            delay: float64 [num_envs, X, Y], from `_delay`.
            ground: float64 [num_envs, 2], the UAV's position, cells.

        Returns:
            The cost, float64 [num_envs], inf if there is no cell, and the cell, float64
            [num_envs, 2].
        """
        along_x = (ground[:, :1] - self.columns).abs().unsqueeze(-1)
        along_y = (ground[:, 1:] - self.rows).abs().unsqueeze(-2)
        distance, index = (torch.maximum(along_x, along_y) + delay).flatten(1).min(-1)
        side = len(self.rows)
        return distance, torch.stack((index // side, index % side), -1).double()

    def _reserve(self, delay: Tensor, cell: Tensor) -> None:
        """Sets `delay` to infinity for all cells in view from a cell, float64 [num_envs, 2]."""
        near_x = (cell[:, :1] - self.columns).abs() <= self.radius
        near_y = (cell[:, 1:] - self.rows).abs() <= self.radius
        delay.masked_fill_(near_x.unsqueeze(-1) & near_y.unsqueeze(-2), math.inf)
