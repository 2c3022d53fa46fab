"""Generated fires: scenarios, their seeds, and the level set by which a front spreads."""

from .cache import fire_bank
from .generator import (
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
