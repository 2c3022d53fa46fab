"""The physics of one step: motion, field of view, coverage and reward, as tensor operations."""

from emberlink.envs.world.coverage_map import CoverageMap, Sighting
from emberlink.envs.world.reward import left_box, step_reward
from emberlink.envs.world.sensor import Sensor, view_radius

__all__ = ["CoverageMap", "Sensor", "Sighting", "left_box", "step_reward", "view_radius"]
