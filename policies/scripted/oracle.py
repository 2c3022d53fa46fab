"""What a team could cover that knew the fire."""

import math

import torch
from tensordict import TensorDictBase
from torch import Tensor

from emberlink.envs import keys
from emberlink.envs.wildfire import WildfireEnv
from emberlink.policies.scripted.base import Scripted

_STEP_OF_WAITING = 1000.0  # cells; longer than any map, so that cells which burn come first


class Oracle(Scripted):
    """Knows what burns, what will and what has been seen, and flies to the nearest uncovered cells.

    At every step each UAV is given a cell that nobody has seen. How far a cell is from a UAV is
    how far it is along the longer axis, as a flight takes, and 1000 cells more for each step until
    it burns: cells that burn come first, then those that burn soonest. The UAV that is nearest to
    any cell chooses first. UAVs spread out because what is in view, at full altitude, of a cell
    that has been chosen is no longer to be had for those that choose later. Among equals the
    lower index goes first, of UAVs and of cells. Who finds nothing left stays where it is. All
    fly at full altitude.

    Args:
        env: the environment that it is played in, whose fire it reads as the episode goes on.
    """

    columns: Tensor
    rows: Tensor

    def __init__(self, env: WildfireEnv):
        super().__init__(env)
        self._env = (env,)  # in a tuple: as an attribute it would be a module of this one
        self.register_buffer("columns", torch.arange(self.world.grid[0]).double().to(env.device))
        self.register_buffer("rows", torch.arange(self.world.grid[1]).double().to(env.device))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        position = tensordict.get(keys.POSITION)
        ground = position[..., :2].double()
        delay = self._delay(tensordict.get(keys.STEP))
        uavs = range(ground.shape[1])
        nearest = torch.stack([self._nearest(delay, ground[:, uav])[0] for uav in uavs], -1)
        target = ground.clone()
        for turn in torch.sort(nearest, dim=-1, stable=True).indices.unsqueeze(-1).unbind(1):
            who = turn.unsqueeze(-1).expand(-1, 1, 2)
            own = ground.gather(1, who).squeeze(1)
            distance, cell = self._nearest(delay, own)
            cell = torch.where(distance.isfinite().unsqueeze(-1), cell, own)
            target.scatter_(1, who, cell.unsqueeze(1))
            self._withdraw(delay, cell)
        ceiling = self.high[2:].expand_as(target[..., :1])
        return self.fly(tensordict, torch.cat((target, ceiling), -1))

    def _delay(self, step: Tensor) -> Tensor:
        """What the wait for each cell counts, float64 [num_envs, X, Y], cells; inf if not to do."""
        (env,) = self._env
        arrival = env.arrival_time.double()
        wait = (arrival - step.view(-1, 1, 1)).clamp_(min=0)
        done = (env.fire_map == 1) | (arrival > self.world.horizon)
        return (wait * _STEP_OF_WAITING).masked_fill_(done, math.inf)

    def _nearest(self, delay: Tensor, ground: Tensor) -> tuple[Tensor, Tensor]:
        """The nearest cell of one UAV of every environment.

        Args:
            delay: float64 [num_envs, X, Y].
            ground: float64 [num_envs, 2], where it is.

        Returns:
            How far it is, float64 [num_envs], inf where there is none, and where, [num_envs, 2].
        """
        along_x = (ground[:, :1] - self.columns).abs().unsqueeze(-1)
        along_y = (ground[:, 1:] - self.rows).abs().unsqueeze(-2)
        distance, index = (torch.maximum(along_x, along_y) + delay).flatten(1).min(-1)
        side = len(self.rows)
        return distance, torch.stack((index // side, index % side), -1).double()

    def _withdraw(self, delay: Tensor, cell: Tensor) -> None:
        """Takes what is in view of a cell of every environment, [num_envs, 2], out of `delay`."""
        near_x = (cell[:, :1] - self.columns).abs() <= self.radius
        near_y = (cell[:, 1:] - self.rows).abs() <= self.radius
        delay.masked_fill_(near_x.unsqueeze(-1) & near_y.unsqueeze(-2), math.inf)
