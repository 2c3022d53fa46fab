"""A scripted policy that searches as map_greedy and brings what it knows to the base."""

import math
from typing import Any, ClassVar

import torch
from torch import Tensor

from emberlink.envs.wildfire import WildfireEnv
from emberlink.envs.world import radio
from emberlink.policies.planning import HERE, Rally
from emberlink.policies.scripted.map_greedy import MapGreedy


class Courier(MapGreedy):
    """Searches as `map_greedy`, and forms a chain of radios to the base by the end of the episode.

    Each UAV computes a chain of places from the base to the middle of the fire that it knows, one
    radio range apart (`radio.chain`). UAV 0 holds the place next to the base, UAV 1 the next one,
    and so on. UAVs that are not needed in the chain stay in range of its last place. A UAV that
    knows of no fire has to be in range of the base. In a world in which UAVs fail, a UAV takes no
    account of those of which it has heard nothing for 150 steps, directly or through others.

    Until then UAVs search, and choose only cells from which they still come to their place in time,
    15 steps before the end. Without a base they search as `MapGreedy`.
    """

    informs_base: ClassVar[bool] = True

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
        return Rally(place, reach, torch.full_like(reach, self.world.horizon))
