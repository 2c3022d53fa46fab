"""Calibrates worlds: tests that a world is worth learning in, and compares many worlds."""

from typing import TYPE_CHECKING

from emberlink.envs.utils.lazy import lazy

if TYPE_CHECKING:
    from emberlink.trainers.worlds.axes import Axes, World
    from emberlink.trainers.worlds.conditions import Condition
    from emberlink.trainers.worlds.play import played, world_config

__all__ = ["Axes", "Condition", "World", "played", "world_config"]

__getattr__ = lazy(
    __name__,
    {
        "Axes": "axes",
        "Condition": "conditions",
        "World": "axes",
        "played": "play",
        "world_config": "play",
    },
)
