"""Generated fires: scenarios, their seeds, and the equations by which a front spreads."""

from emberlink.envs.fire.cache import fire_bank
from emberlink.envs.fire.generator import (
    FireConfig,
    Split,
    fire_seeds,
    load_scenario,
    make_fires,
    scenarios,
)
from emberlink.envs.fire.reaction import ReactionConfig

__all__ = [
    "FireConfig",
    "ReactionConfig",
    "Split",
    "fire_bank",
    "fire_seeds",
    "load_scenario",
    "make_fires",
    "scenarios",
]
