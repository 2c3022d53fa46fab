"""Scripted policies: baselines that learned policies are compared with."""

ORDER = (
    *("stationary", "random_actions", "random_waypoints"),
    *("lawnmower", "follow_target"),
    *("map_greedy_alone", "map_greedy", "map_greedy_all", "courier", "oracle"),
)
"""the names of emberlink's own, in the order of tables"""
