"""Scripted policies that search where fire may burn unseen, by the maps of the UAVs."""

import math
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor

from emberlink.envs import keys
from emberlink.envs.wildfire import WildfireEnv
from emberlink.envs.world import radio
from emberlink.envs.world.knowledge import step_type
from emberlink.policies.scripted.base import Scripted
from emberlink.policies.scripted.planning import (
    HERE,
    REPORT,
    Rally,
    Targets,
    band,
    next_report,
    plan_period,
)
from emberlink.policies.scripted.team_maps import TARGET_BYTES, Messages, TeamMaps

_FLOWN = 2.0  # cells flown between two plans
_NEAR = 2  # cells; within this distance of known fire a cell may have ignited
_SPREAD = 50.0  # steps; time scale at which the chance of ignition near known fire grows
_FAR = 0.04  # chance of fire in a cell never seen, far from known fire
_AGAIN = 0.02  # chance of fire in a cell seen without fire long ago
_FORGET = 300.0  # steps; time scale of "long ago"
_AROUND = 6  # cells; within this distance, cells seen without fire make fire less likely
_CLAIM = 2.0  # cells; half the side of the square that a UAV claims
_EXACT = 2.0**16  # weights are multiples of its inverse, so that sums do not depend on their order


class MapGreedy(Scripted):
    """Flies to the cell with the highest chance of seeing new fire per distance.

    Each UAV has a map of the last step at which it knows each cell to have been seen: by itself, or
    by UAVs whose messages arrive, directly or passed on. From the map follows which cells burned
    when they were last seen; no other state of the fire is read. A cell that was seen burning or
    burnt out has no weight. A cell within 2 cells of known fire has a weight that grows with the
    time since it was last seen, up to 1 if it never was. Other cells have a small weight: the less,
    the more cells around them were seen without fire. The value of a target is the sum of the
    weights in view from it, divided by its distance plus 2 cells.

    UAVs choose anew whenever they can have flown 2 cells (every 10 steps at most), in the order of
    falling values. A UAV gives no weight to cells within 2 cells (along x and y) of the targets of
    UAVs whose messages it has. All fly at the `search_altitude`.

    The targets are carried in the TensorDict under "_map_greedy_target", the maps in the policy.

    Args:
        env: the environment that it acts in.
        maps: the belief maps, with the methods of `TeamMaps`; new ones if None.
    """

    hears: ClassVar[bool] = True
    messages: ClassVar[Messages] = "in range"
    informs_base: ClassVar[bool] = False
    """whether it brings sightings to a base"""
    TARGET = "_map_greedy_target"

    _near_x: Tensor
    _near_y: Tensor
    _around_x: Tensor
    _around_y: Tensor
    _area: Tensor

    def __init__(self, env: WildfireEnv, maps: Any = None):
        super().__init__(env)
        self.in_keys.append(keys.ALIVE)
        self.out_keys.append(self.TARGET)
        self.maps = TeamMaps(env, self.messages).to(env.device) if maps is None else maps
        self.targets = Targets(env, claim=_CLAIM)
        self.period = plan_period(_FLOWN, self.world.displacement)
        for name, reach in (("near", _NEAR), ("around", _AROUND)):
            for axis, side in zip("xy", self.world.grid, strict=True):
                self.register_buffer(f"_{name}_{axis}", band(side, reach).to(env.device))
        area = self._around_x.sum(-1, keepdim=True) * self._around_y.sum(0)
        self.register_buffer("_area", area)

    def bytes_sent(self, tensordict: TensorDictBase) -> Tensor:
        """Returns the bytes of a map (a step per cell) and a target, or of the parts said."""
        if self.maps.sent is not None:
            return self.maps.sent[:, : self.world.num_uavs] * tensordict.get(keys.ALIVE)
        size = step_type(self.world.horizon).itemsize * math.prod(self.world.grid) + TARGET_BYTES
        return size * tensordict.get(keys.ALIVE).long() * self.maps.sends

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.maps.update(tensordict)
        position = tensordict.get(keys.POSITION)
        target = self.carried(tensordict, self.TARGET, position[..., :2])
        due = tensordict.get(keys.STEP) % self.period == 0
        if due.any():
            target = torch.where(due.view(-1, 1, 1), self._plan(tensordict), target)
        tensordict.set(self.TARGET, target)
        ceiling = self.high[2:].float().expand_as(target[..., :1])
        return self.fly(tensordict, torch.cat((target, ceiling), -1))

    def _plan(self, tensordict: TensorDictBase) -> Tensor:
        """Returns a new target of each UAV, float32 [num_envs, n, 2], cells."""
        ground = tensordict.get(keys.POSITION)[..., :2]
        last_seen = self.maps.last_seen()
        ignited, burnt_out = self.maps.was_fire(last_seen)
        burning = ignited & ~burnt_out
        weight = self._weight(tensordict.get(keys.STEP), last_seen, ignited, burning)
        distance = self.targets.distance(ground)
        return self._choose(tensordict.get(keys.STEP), ground, burning, weight, distance)

    def _weight(self, step: Tensor, last_seen: Tensor, ignited: Tensor, burning: Tensor) -> Tensor:
        """Returns the chance that a look at a cell shows new fire, float32 [num_envs, n, X, Y]."""
        never = last_seen < 0
        age = step.view(-1, 1, 1, 1) - last_seen
        near = self._near_x @ burning.float() @ self._near_y > 0
        without_fire = (~never & ~ignited).float()
        empty = self._around_x @ without_fire @ self._around_y / self._area
        far = torch.where(never, _FAR * (1 - empty) ** 3, _AGAIN * (1 - (-age / _FORGET).exp()))
        close = torch.where(never, 1.0, 1 - (-age / _SPREAD).exp())
        weight = torch.where(near, close, far).masked_fill_(ignited, 0.0)
        return weight.mul_(_EXACT).round_().div_(_EXACT)

    def _choose(
        self, step: Tensor, ground: Tensor, burning: Tensor, weight: Tensor, distance: Tensor
    ) -> Tensor:
        """Returns targets; `step` and `burning` are for subclasses."""
        return self.targets.choose(ground, weight, distance + HERE, self._hears(ground))[0]

    def _hears(self, ground: Tensor) -> Tensor:
        """Returns whose targets each UAV knows, bool [num_envs, n, n]."""
        uavs = ground.shape[1]
        return self.maps.reach[:, :uavs, :uavs]


class MapGreedyAlone(MapGreedy):
    """Searches as `map_greedy`; each UAV knows its own sightings and target alone."""

    hears: ClassVar[bool] = False
    messages: ClassVar[Messages] = "none"


class MapGreedyAll(MapGreedy):
    """Searches as `map_greedy`; each UAV knows what all have seen and plan, at any distance."""

    hears: ClassVar[bool] = False
    messages: ClassVar[Messages] = "everyone"


class Courier(MapGreedy):
    """Searches as `map_greedy`, and forms a chain of radios to the base by the end of the episode.

    Each UAV computes a chain of places from the base to the middle of the fire that it knows, one
    radio range apart (`radio.chain`). UAV 0 holds the place next to the base, UAV 1 the next one,
    and so on. UAVs that are not needed in the chain stay in range of its last place. A UAV that
    knows of no fire has to be in range of the base. In a world in which UAVs fail, a UAV ignores
    UAVs without news, direct or passed on, for 150 steps.

    Until then UAVs search, and choose only cells from which they still come to their place in time,
    15 steps before the end. Without a base they search as `MapGreedy`.
    """

    informs_base: ClassVar[bool] = True
    every: ClassVar[int | None] = None
    """steps from one chain to the next; None for one at the end of the episode"""

    _base: Tensor

    def __init__(self, env: WildfireEnv, maps: Any = None):
        super().__init__(env, maps)
        world, device = self.world, env.device
        self.register_buffer("_base", torch.tensor(world.base or (0.0, 0.0), device=device))

    def _choose(
        self, step: Tensor, ground: Tensor, burning: Tensor, weight: Tensor, distance: Tensor
    ) -> Tensor:
        cost, hears = distance + HERE, self._hears(ground)
        if self.world.base is None:
            return self.targets.choose(ground, weight, cost, hears)[0]
        speed = self.world.displacement
        rally = self._rally(step, burning)
        cells = self.targets.columns, self.targets.rows
        late = rally.too_late(cells, step.view(-1, 1, 1, 1) + distance / speed, speed)
        target, value = self.targets.choose(
            ground, weight, cost.masked_fill_(late, math.inf), hears
        )
        leaves = rally.leaves(ground, step, speed, self.period) & (value <= 0)
        return torch.where(leaves.unsqueeze(-1), rally.place, target)

    def _rally(self, step: Tensor, burning: Tensor) -> Rally:
        """Returns where each UAV has to be at the end, given the fire and the UAVs it knows."""
        heard = self.maps.heard
        place, reach = radio.chain_to_fire(self.world, self._base, burning, step, heard)
        horizon = self.world.horizon
        due = next_report(step, self.every or horizon, horizon)
        return Rally(place, reach, due.expand_as(reach))


class Shuttle(Courier):
    """Searches as `courier`, and forms the chain every 250 steps: the base learns in time."""

    every: ClassVar[int | None] = REPORT


class ShuttleAlone(Shuttle):
    """Searches as `shuttle`; each UAV knows its own sightings and target alone."""

    hears: ClassVar[bool] = False
    messages: ClassVar[Messages] = "none"


class ShuttleAll(Shuttle):
    """Searches as `shuttle`; each UAV knows what all have seen and plan, at any distance."""

    hears: ClassVar[bool] = False
    messages: ClassVar[Messages] = "everyone"
