"""Derives the worlds of a sweep from one world: fire speed x grid x team x radio range."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

from emberlink.envs.fire.generator import FireConfig
from emberlink.envs.utils.errors import UserError
from emberlink.trainers.config.compose import override
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.worlds.play import world_config

_OPTIONS = {
    "fire.head_ros": "--speeds",
    "env.grid": "--grids",
    "env.num_uavs": "--teams",
    "env.radio.range": "--ranges",
}
"""key -> option that gives its values"""


class World(NamedTuple):
    """The values by which a world of a sweep differs from the others."""

    speed: float
    """multiple of the fire's speed in the base world"""
    grid: int
    """cells along each side"""
    uavs: int
    range: float
    """range of the radio, cells"""


@dataclass(frozen=True)
class Axes:
    """The values of a sweep; each list is in ascending order."""

    speeds: Sequence[float]
    grids: Sequence[int]
    teams: Sequence[int]
    ranges: Sequence[float]

    def worlds(self) -> Iterator[World]:
        """Yields every combination; the range changes fastest, then the team."""
        yield from map(World._make, product(self.speeds, self.grids, self.teams, self.ranges))


def base_config(overrides: Sequence[str]) -> RunConfig:
    """Returns the world from which those of a sweep are derived; `front` by default.

    Raises:
        UserError: a key or value is wrong, a key is an axis of the sweep, the fires have no
            `fire.head_ros`, or there is a base.
    """
    for text in overrides:
        key = text.partition("=")[0]
        if key in _OPTIONS:
            raise UserError(f"{key} is an axis of the sweep; give its values with {_OPTIONS[key]}")
    config = world_config(["world=front", *overrides])
    if not isinstance(config.fire, FireConfig):
        raise UserError(f"fire={config.fire.name}: a sweep needs fires with fire.head_ros")
    if config.env.base is not None:
        raise UserError(f"env.base={list(config.env.base)}: a sweep needs a world without a base")
    return config


def derived(base: RunConfig, world: World) -> RunConfig:
    """Returns the configuration of a world of a sweep.

    Raises:
        UserError: a value is out of its range; the message names it.
    """
    assert isinstance(base.fire, FireConfig)
    low, high = (rate * world.speed for rate in base.fire.head_ros)
    keys = (
        f"fire.head_ros=[{low},{high}]",
        f"env.grid=[{world.grid},{world.grid}]",
        f"env.num_uavs={world.uavs}",
        f"env.radio.range={float(world.range)}",
    )
    return override(base, keys)
