"""The scripted policies that there are: what a learned one has to beat."""

from .base import Scripted
from .follow_target import FollowTarget
from .lawnmower import Lawnmower
from .oracle import Oracle
from .random_policies import RandomActions, RandomWaypoints, Stationary

SCRIPTED: dict[str, type[Scripted]] = {
    "stationary": Stationary,
    "random_actions": RandomActions,
    "random_waypoints": RandomWaypoints,
    "lawnmower": Lawnmower,
    "follow_target": FollowTarget,
    "oracle": Oracle,
}
"""The policies that every evaluation reports, by name and in this order."""
