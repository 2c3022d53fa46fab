"""A scripted policy that searches as map_greedy, without messages."""

from typing import ClassVar

from emberlink.policies.planning import Messages
from emberlink.policies.scripted.map_greedy import MapGreedy


class MapGreedyAlone(MapGreedy):
    """Searches as `map_greedy`; each UAV knows its own sightings and target alone."""

    hears: ClassVar[bool] = False
    messages: ClassVar[Messages] = "none"
