"""Scripted policies that search where fire may burn unseen, by the maps of the UAVs."""

import math
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor

from emberlink.envs import keys
from emberlink.envs.config import RadioConfig
from emberlink.envs.wildfire import WildfireEnv
from emberlink.envs.world import radio
from emberlink.envs.world.knowledge import step_type
from emberlink.policies.scripted.planning import REPORT, Rally, Searcher, band, next_report
from emberlink.policies.scripted.team_maps import TARGET_BYTES, TeamMaps

_NEAR = 2  # cells; within this distance of known fire a cell may have ignited
_SPREAD = 50.0  # steps; time scale at which the chance of ignition near known fire grows
_FAR = 0.04  # chance of fire in a cell never seen, far from known fire
_AGAIN = 0.02  # chance of fire in a cell seen without fire long ago
_FORGET = 300.0  # steps; time scale of "long ago"
_AROUND = 6  # cells; within this distance, cells seen without fire make fire less likely
_EXACT = 2.0**16  # weights are multiples of its inverse, so that sums do not depend on their order


class MapGreedy(Searcher):
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
    talks: ClassVar[RadioConfig | None] = None
    """the radio over which UAVs exchange maps and targets; None for the world's"""
    TARGET: ClassVar[str] = "_map_greedy_target"
    flown: ClassVar[float] = 2.0
    claim: ClassVar[float] = 2.0

    _near_x: Tensor
    _near_y: Tensor
    _around_x: Tensor
    _around_y: Tensor
    _area: Tensor

    def __init__(self, env: WildfireEnv, maps: Any = None):
        super().__init__(env)
        self.maps = TeamMaps(env, self.talks).to(env.device) if maps is None else maps
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
        return super().forward(tensordict)

    def plan(self, tensordict: TensorDictBase) -> Tensor:
        step, ground = tensordict.get(keys.STEP), tensordict.get(keys.POSITION)[..., :2]
        last_seen = self.maps.last_seen()
        ignited, burnt_out = self.maps.was_fire(last_seen)
        burning = ignited & ~burnt_out
        weight = self._weight(step, last_seen, ignited, burning)
        hears = self.maps.reach[:, : self.world.num_uavs, : self.world.num_uavs]
        return self.search(step, ground, weight, hears, self._rally(step, burning))

    def _rally(self, step: Tensor, burning: Tensor) -> Rally | None:
        """Returns where each UAV has to be, given the fire and the UAVs it knows."""

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


class MapGreedyAlone(MapGreedy):
    """Searches as `map_greedy`; each UAV knows its own sightings and target alone."""

    hears: ClassVar[bool] = False
    talks: ClassVar[RadioConfig | None] = RadioConfig(range=0.0)


class MapGreedyAll(MapGreedy):
    """Searches as `map_greedy`; each UAV knows what all have seen and plan, at any distance."""

    hears: ClassVar[bool] = False
    talks: ClassVar[RadioConfig | None] = RadioConfig(range=math.inf)


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

    every: ClassVar[int | None] = None
    """steps from one chain to the next; None for one at the end of the episode"""

    def _rally(self, step: Tensor, burning: Tensor) -> Rally | None:
        if self.world.base is None:
            return None
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
    talks: ClassVar[RadioConfig | None] = RadioConfig(range=0.0)


class ShuttleAll(Shuttle):
    """Searches as `shuttle`; each UAV knows what all have seen and plan, at any distance."""

    hears: ClassVar[bool] = False
    talks: ClassVar[RadioConfig | None] = RadioConfig(range=math.inf)
