"""Scripted policies: baselines that learned policies are compared with."""

from typing import TYPE_CHECKING

from emberlink.envs.utils.lazy import lazy

if TYPE_CHECKING:
    from emberlink.policies.scripted.base import Scripted

__all__ = ["ORDER", "Scripted"]

ORDER = (
    *("stationary", "random_actions", "random_waypoints"),
    *("lawnmower", "follow_target"),
    *("map_greedy_alone", "map_greedy", "map_greedy_all", "courier", "oracle"),
)
"""the names of emberlink's own, in the order of tables"""

__getattr__ = lazy(__name__, {"Scripted": "base"})
