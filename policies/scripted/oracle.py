"""A scripted policy that knows the fire: an upper baseline of coverage."""

import math
from typing import ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor

from emberlink.envs import keys
from emberlink.envs.wildfire import WildfireEnv
from emberlink.envs.world import radio
from emberlink.envs.world.sensor import Sensor
from emberlink.policies.scripted.planning import REPORT, Rally, Searcher, next_report

_STEP_COST = 1000.0  # cells; above any distance on a map, so that burning cells come first
_WAIT = 10.0  # steps; time scale at which the weight of a cell falls that ignites after the arrival
_LATE = 100.0  # steps before the end; the chain leads to the cells that burn in this time
_MEET = 0.9  # of the radio's range; distance at which a UAV that will fail meets another one


class Oracle(Searcher):
    """Flies to the nearest uncovered cells, given the whole fire and the cells seen so far.

    At every step each UAV is assigned a cell that no UAV has seen. The cost of a cell is its
    Chebyshev distance from the UAV plus 1000 cells for each step until it burns. So burning cells
    come first, then the cells that burn soonest. The UAV with the lowest cost chooses first and
    reserves all cells in view from its cell at that altitude, so that UAVs spread out. Ties
    go to the lower index of UAVs and of cells. A UAV without a cell stays at its position, and one
    that has failed gets none. All UAVs fly at the `search_altitude`.

    Where cells burn out, or with a base, it foresees more. The value of a target is then the number
    of cells in view from it that nobody has seen burn and that burn when the UAV arrives, divided
    by its distance plus 2 cells. The UAV with the highest value chooses first and claims 7 x 7
    cells. With a base, a cell counts if neither a flying UAV nor the base has a sighting of it
    while it burned. At the end of the episode the UAVs form a chain to the base (`radio.chain`),
    each place held by the nearest UAV. Before it fails, a UAV flies to the nearest UAV that will
    not fail.

    Args:
        env: the environment that it acts in; its fire and failures are read at every step.
    """

    every: ClassVar[int | None] = None
    """steps from one chain to the base to the next; None for one at the end of the episode"""
    TARGET: ClassVar[str] = "_oracle_target"
    flown: ClassVar[float] = 1.0
    claim: ClassVar[float] = 3.0

    def __init__(self, env: WildfireEnv):
        super().__init__(env)
        self._env = (env,)  # in a tuple, so that it is not registered as a submodule
        self._sensor = Sensor(self.world)
        self.foresees = env.burn_out is not None or self.world.base is not None
        self.period = self.period if self.foresees else 1

    def plan(self, tensordict: TensorDictBase) -> Tensor:
        return self._foreseen(tensordict) if self.foresees else self._nearest_cells(tensordict)

    def _foreseen(self, tensordict: TensorDictBase) -> Tensor:
        """Returns the targets with the most cells in view per distance, [num_envs, n, 2]."""
        ground, step = tensordict.get(keys.POSITION)[..., :2], tensordict.get(keys.STEP)
        alive, speed = tensordict.get(keys.ALIVE), self.world.displacement
        arrives = step.view(-1, 1, 1, 1) + self.distance(ground) / speed
        weight, hears = self._weight(arrives, alive), alive.unsqueeze(-1) & alive.unsqueeze(-2)
        rally = None if self.world.base is None else self._rally(ground, step)
        return self.search(step, ground, weight, hears, rally).double()

    def _times(self) -> tuple[Tensor, Tensor | float]:
        """Returns arrival and burn-out times, float32 [num_envs, 1, X, Y]; or inf."""
        (env,) = self._env
        end = math.inf if env.burn_out is None else env.burn_out.unsqueeze(1)
        return env.arrival_time.unsqueeze(1), end

    def _weight(self, arrives: Tensor, alive: Tensor) -> Tensor:
        """Returns the value of seeing each cell on arrival, float32 [num_envs, n, X, Y]."""
        ignition, end = self._times()
        meets = torch.maximum(arrives, ignition)
        useful = self._unseen(alive).unsqueeze(1) & (meets < end) & (meets <= self.world.horizon)
        useful &= alive[..., None, None]
        wait = (meets - arrives).masked_fill_(~useful, 0.0)
        return useful * (-wait / _WAIT).exp()

    def _unseen(self, alive: Tensor) -> Tensor:
        """Returns the cells without a surviving sighting in flames, bool [num_envs, X, Y]."""
        (env,) = self._env
        if env.knowledge is None or env.knowledge.seen_fire is None:
            return (env.fire_map != 1) & (env.fire_map != 3)
        has = torch.nn.functional.pad(alive, (0, 1), value=True)
        seen = (env.knowledge.seen_fire & has.unsqueeze(-1)).any(1)
        return ~self._sensor.crop(seen)

    def _rally(self, ground: Tensor, now: Tensor) -> Rally:
        """Returns where each UAV has to be at the next report, or before it fails."""
        (env,) = self._env
        horizon, uavs = self.world.horizon, ground.shape[1]
        fails = torch.full_like(ground[..., 0], horizon + 1)
        fails = fails if env.fail_step is None else env.fail_step.float()
        lasting = fails > horizon
        place, reach = self._chain(ground, lasting)
        apart = torch.cdist(ground, ground).masked_fill_(~lasting.unsqueeze(1), math.inf)
        nearest, other = apart.min(-1)
        meets = ~lasting & nearest.isfinite()
        friend = ground.gather(1, other.unsqueeze(-1).expand(-1, uavs, 2))
        place = torch.where(meets.unsqueeze(-1), friend, place)
        reach = torch.where(meets, _MEET * self.world.radio.range, reach)
        due = next_report(now, self.every or horizon, horizon)
        step = torch.where(lasting, due, torch.where(meets, fails - 1, math.inf))
        return Rally(place, reach, step)

    def _chain(self, ground: Tensor, lasting: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the place and reach of each UAV in a chain of the UAVs that do not fail."""
        ignition, end = self._times()
        late = (ignition <= self.world.horizon) & (end > self.world.horizon - _LATE)
        envs, uavs = lasting.shape
        centre, count = radio.middle(late), lasting.sum(-1, keepdim=True)
        rank = torch.full_like(lasting, uavs, dtype=torch.int64)
        env = torch.arange(envs, device=ground.device)
        for link in range(uavs):
            here = torch.full_like(count, link)
            place, _ = radio.chain(self.world, self._base, centre, here, count)
            apart = torch.linalg.vector_norm(ground - place, dim=-1)
            apart.masked_fill_(~lasting | (rank < uavs), math.inf)
            nearest, uav = apart.min(-1)
            rank[env, uav] = torch.where(nearest.isfinite(), link, rank[env, uav])
        return radio.chain(self.world, self._base, centre, rank, count)

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
            near_x = (cell[:, :1] - self.columns).abs() <= self.radius
            near_y = (cell[:, 1:] - self.rows).abs() <= self.radius
            delay.masked_fill_(near_x.unsqueeze(-1) & near_y.unsqueeze(-2), math.inf)  # reserved
        return target

    def _delay(self, step: Tensor) -> Tensor:
        """Returns the cost of waiting for each cell, inf if seen, float64 [num_envs, X, Y]."""
        (env,) = self._env
        arrival = env.arrival_time.double()
        wait = (arrival - step.view(-1, 1, 1)).clamp_(min=0)
        done = (env.fire_map == 1) | (arrival > self.world.horizon)
        return (wait * _STEP_COST).masked_fill_(done, math.inf)

    def _nearest(self, delay: Tensor, ground: Tensor) -> tuple[Tensor, Tensor]:
        """Returns one UAV's lowest cost, [num_envs], and its cell, [num_envs, 2], float64."""
        distance, index = (self.distance(ground) + delay).flatten(1).min(-1)
        side = len(self.rows)
        return distance, torch.stack((index // side, index % side), -1).double()


class OracleShuttle(Oracle):
    """Flies as `oracle`, and forms the chain to a base every 250 steps."""

    every: ClassVar[int | None] = REPORT
