"""Generated fires: scenarios, their seeds, and the level set by which a front spreads."""

from emberlink.envs.fire.cache import fire_bank
from emberlink.envs.fire.generator import (
    FireConfig,
    Split,
    fire_seeds,
    load_scenario,
    make_fires,
    scenarios,
)

__all__ = [
    "FireConfig",
    "Split",
    "fire_bank",
    "fire_seeds",
    "load_scenario",
    "make_fires",
    "scenarios",
]
