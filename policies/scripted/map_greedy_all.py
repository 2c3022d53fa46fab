"""A scripted policy that searches as map_greedy, as if all UAVs always heard each other."""

from typing import ClassVar

from emberlink.policies.planning import Messages
from emberlink.policies.scripted.map_greedy import MapGreedy


class MapGreedyAll(MapGreedy):
    """Searches as `map_greedy`; each UAV knows what all have seen and plan, at any distance."""

    hears: ClassVar[bool] = False
    messages: ClassVar[Messages] = "everyone"
