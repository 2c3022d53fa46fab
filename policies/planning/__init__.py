"""Plans of scripted policies: maps of the UAVs' knowledge, targets, and places to meet."""

from emberlink.policies.planning.foresight import Foresight
from emberlink.policies.planning.rally import Rally
from emberlink.policies.planning.targets import HERE, Targets, band, plan_period
from emberlink.policies.planning.team_maps import Messages, TeamMaps

__all__ = [
    "HERE",
    "Foresight",
    "Messages",
    "Rally",
    "Targets",
    "TeamMaps",
    "band",
    "plan_period",
]
