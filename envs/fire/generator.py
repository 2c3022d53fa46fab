"""Generates fires. A scenario is a set of ranges, from which a seed draws one fire.

A fire is an arrival time per cell, in steps; a cell burns once `step >= arrival_time`. It starts as
a ring, the edge of a disc whose inside is burnt out and never counts as fire, and spreads by the
level set of `level_set`, or by the heat equation of `reaction`. Other waves, such as oil on water,
are scenarios as well.
Lengths of a scenario are in cells. With `lengths: scaled`, they are for a grid whose shorter side
has 30 cells (`BASE_SIDE`); on another grid lengths and rates are scaled by min(X, Y)/30.
"""

import math
from collections.abc import Callable, Mapping
from typing import Annotated, Any, ClassVar, Literal

import torch
from pydantic import Field
from pydantic.dataclasses import dataclass
from torch import Tensor

from emberlink.envs.config import BASE_SIDE
from emberlink.envs.fire.level_set import MAX_LENGTH_TO_BREADTH, arrival_times, disc
from emberlink.envs.fire.ranges import (
    TEST_FROM,
    VALIDATION_FROM,
    Degrees,
    FireRanges,
    Fraction,
    Length,
)
from emberlink.envs.fire.reaction import ReactionConfig, reaction_fires
from emberlink.envs.utils.config_files import known, read
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import STRICT, Range, from_plain

Split = Literal["train", "validation", "test"]

_MIN_NODES = 60  # along the shorter side: twice the resolution of 30 cells
_MAX_NODES = 200_000  # computed together, so that the data fits in the processor's cache
_STEPS_PER_TIDE = 32  # at least, so that a time step resolves a tide
_MIN_RADIUS = 1e-6  # of a patch, cells, so that its square does not underflow

_Signed = Annotated[float, Field(ge=-30, le=30)]
_Rate = Annotated[float, Field(gt=0, le=1)]
_Ratio = Annotated[float, Field(ge=1, le=MAX_LENGTH_TO_BREADTH)]
_Drift = Annotated[float, Field(ge=0, le=1)]
_Reach = Annotated[float, Field(ge=0, le=30)]
_Period = Annotated[float, Field(ge=100, le=1e6)]
_Count = Annotated[int, Field(ge=0, le=32)]


@dataclass(frozen=True, kw_only=True, config=STRICT)
class FireConfig(FireRanges):
    """A distribution of fires: each pair (low, high) is the range of a uniform draw."""

    drawn: ClassVar[tuple[str, ...]] = (
        *("head_ros", "length_to_breadth", "azimuth", "wind_shift"),
        *("centre_x", "centre_y", "core_radius", "ring_width"),
        *("fuel_patches", "patch_bearing", "patch_distance", "patch_radius", "patch_rate"),
        *("drift_rate", "tide_reach", "tide_period", "tide_phase", "tide_bearing"),
    )
    head_ros: Range[_Rate]
    """Rate of spread of the head, cells per step."""
    length_to_breadth: Range[_Ratio]
    """Length-to-breadth ratio of the elliptical wavelet, 1 without wind."""
    fuel_patches: Range[_Count]
    """Number of patches of slow fuel."""
    patch_bearing: Range[Degrees]
    """Direction of a patch from the disc's centre, degrees from the initial azimuth."""
    patch_distance: Range[_Signed]
    """Distance of a patch's centre from the initial disc, cells, negative inside."""
    patch_radius: Range[Length]
    """Distance from a patch's centre at which its effect has fallen to 1/e, cells."""
    patch_rate: Range[Fraction]
    """Multiplier of the rate of spread at a patch's centre; 1 is no effect."""
    drift_rate: Range[_Drift] = (0.0, 0.0)
    """Steady drift of the medium towards the azimuth, cells per step."""
    tide_reach: Range[_Reach] = (0.0, 0.0)
    """Distance that the tide moves the medium between two turns, cells."""
    tide_period: Range[_Period] = (1000.0, 1000.0)
    """Period of the tide, steps."""
    tide_phase: Range[Degrees] = (0.0, 0.0)
    """Phase of the tide at step 0, degrees; the speed is greatest at 0."""
    tide_bearing: Range[Degrees] = (0.0, 0.0)
    """Direction of the tide at phase 0, degrees counter-clockwise from +x."""
    two_sided: bool = False
    """Whether the back of the wavelet is as fast as its head."""
    burn_time: Annotated[float, Field(ge=1)] = math.inf
    """Steps for which a cell burns; inf for ever."""
    lengths: Literal["scaled", "cells"] = "scaled"
    """Whether lengths and rates are for a 30-cell side and scaled to the grid, or in its cells."""


GeneratedConfig = FireConfig | ReactionConfig
"""a scenario whose fires are made from seeds"""


def scenarios() -> list[str]:
    """Returns the names of the generated scenarios in `configs/fire`."""
    return [name for name in known("fire") if _is_generated(read("fire", name))]


def _is_generated(values: dict[str, Any]) -> bool:
    return values.get("kind") in (None, "reaction")


def load_scenario(name: str) -> GeneratedConfig:
    """Returns the scenario in `configs/fire/<name>.yaml`.

    Raises:
        UserError: there is no such file, or a value in it is not valid.
    """
    values = read("fire", name)
    if not _is_generated(values):
        raise UserError(f"fire {name!r} is not generated; known: {', '.join(scenarios())}")
    return from_plain(ReactionConfig if "kind" in values else FireConfig, values, "fire")


def fire_seeds(split: Split, count: int, test_seed: int = TEST_FROM) -> Tensor:
    """Returns the seeds of the first `count` fires of a split, int64 [count].

    Training seeds are 0 to 999,999, test seeds 1,000,000 to 1,999,999 and validation seeds
    2,000,000 to 2,999,999, so the three sets are disjoint. The first test seed is `test_seed`.

    Raises:
        UserError: the seeds would not lie in the interval of the split.
    """
    first = {"train": 0, "test": test_seed, "validation": VALIDATION_FROM}[split]
    most = TEST_FROM - first % TEST_FROM
    if not 1 <= count <= most:
        raise UserError(f"expected a count of 1 to {most} seeds, got {count}")
    return torch.arange(first, first + count)


def make_fires(
    config: GeneratedConfig, seeds: Tensor, grid: tuple[int, int], horizon: int
) -> Tensor:
    """Returns the times of one fire per seed. A fire depends on its seed alone.

    Args:
        seeds: int64 [fires], on the device where to compute.
        grid: (X, Y), each 8 to 256 cells.
        horizon: steps. Later arrivals are inf. A longer horizon continues the same fires.

    Returns:
        Arrival times in steps, float32 [fires, X, Y]: 0 burns from the start, inf never burns. Of a
        `ReactionConfig` arrival and burn-out times, float32 [fires, 2, X, Y].
    """
    if isinstance(config, ReactionConfig):
        return reaction_fires(config, seeds, grid, horizon)
    refine = math.ceil(_MIN_NODES / min(grid))
    sides = (side + 2 * _margin(config, grid) for side in grid)
    chunk = max(1, _MAX_NODES // (math.prod(sides) * refine**2))
    parts = [_spread(config, part, grid, horizon, refine) for part in seeds.split(chunk)]
    return torch.cat(parts)


def _margin(config: FireConfig, grid: tuple[int, int]) -> int:
    """Returns the cells around the grid from which a tide can carry the front back."""
    return math.ceil(config.tide_reach[1] * _scale(config, grid))


def _scale(config: FireConfig, grid: tuple[int, int]) -> float:
    """Returns the cells of a grid per cell of the scenario's lengths."""
    return min(grid) / BASE_SIDE if config.lengths == "scaled" else 1.0


def _spread(
    config: FireConfig, seeds: Tensor, grid: tuple[int, int], horizon: int, refine: int
) -> Tensor:
    """Computes the fires of some seeds together; see `make_fires`."""
    scale = _scale(config, grid)
    draw = {name: config.draw(name, seeds)[:, 0] for name in config.drawn if "patch" not in name}
    fractions = torch.stack([draw["centre_x"], draw["centre_y"]], 1)
    centre = fractions * (torch.tensor(grid, device=seeds.device) - 1)
    distance = disc(centre, draw["core_radius"] * scale)
    start, turning = draw["azimuth"].deg2rad(), draw["wind_shift"].deg2rad()

    def azimuth(time: float) -> Tensor:
        return start + turning * (time / 1000)

    fastest = config.drift_rate[1] + math.pi * config.tide_reach[1] / config.tide_period[0]
    arrival = arrival_times(
        distance,
        grid,
        draw["head_ros"] * scale,
        draw["length_to_breadth"],
        azimuth,
        horizon=horizon,
        two_sided=config.two_sided,
        drift=current(draw, azimuth, scale) if fastest > 0 else None,
        margin=_margin(config, grid),
        max_step=config.tide_period[0] / _STEPS_PER_TIDE if config.tide_reach[1] > 0 else math.inf,
        refine=refine,
        rate_field=_fuel(config, seeds, centre, draw["core_radius"], start, grid),
        max_rate=(config.head_ros[1] + fastest) * scale,
    )
    depth = -distance(*_axes(grid, seeds.device))
    return arrival.masked_fill(depth > draw["ring_width"][:, None, None] * scale, math.inf)


def _axes(grid: tuple[int, int], device: torch.device) -> tuple[Tensor, Tensor]:
    x, y = (torch.arange(side, dtype=torch.float32, device=device) for side in grid)
    return x[None, :, None], y[None, None, :]


def _fuel(
    config: FireConfig,
    seeds: Tensor,
    centre: Tensor,
    radius: Tensor,
    azimuth: Tensor,
    grid: tuple[int, int],
) -> Tensor | None:
    """Returns the multiplier of the rates, [fires, X, Y]: a product of smooth round patches."""
    maximum = config.fuel_patches[1]
    if maximum == 0:
        return None
    scale = _scale(config, grid)
    low = config.fuel_patches[0]
    count = low + (config.unit_draws("fuel_patches", seeds) * (maximum - low + 1)).floor()
    bearing, distance, width, rate = (
        config.draw(f"patch_{part}", seeds, maximum)
        for part in ("bearing", "distance", "radius", "rate")
    )
    angle = azimuth[:, None] + bearing.deg2rad()
    reach = (radius[:, None] + distance) * scale
    px = (centre[:, :1] + reach * angle.cos())[..., None, None]
    py = (centre[:, 1:] + reach * angle.sin())[..., None, None]
    loss = (1 - rate) * (torch.arange(maximum, device=seeds.device) < count)
    x, y = _axes(grid, seeds.device)
    wide = (width * scale).clamp_min(_MIN_RADIUS)[..., None, None]
    apart = ((x - px) ** 2 + (y - py) ** 2) / wide**2
    return (1 - loss[..., None, None] * torch.exp(-apart)).prod(1)


def current(
    draw: Mapping[str, Tensor], azimuth: Callable[[float], Tensor], scale: float
) -> Callable[[float], Tensor]:
    """Returns the velocity of the medium as a function of time.

    u(t) = `drift_rate` · w(t) + s · cos(2π t / `tide_period` + `tide_phase`) · v, with w and v the
    unit vectors along the azimuth and `tide_bearing` and s = π `tide_reach` / `tide_period`.

    Args:
        draw: the fields of a `FireConfig` named above, float [fires] each, in its units.
        azimuth: from the time in steps to radians [fires].
        scale: cells of the grid per cell of the scenario.

    Returns:
        From the time in steps to cells of the grid per step, [fires, 2].
    """
    steady = draw["drift_rate"] * scale
    strength = math.pi * draw["tide_reach"] / draw["tide_period"] * scale
    phase, bearing = draw["tide_phase"].deg2rad(), draw["tide_bearing"].deg2rad()

    def velocity(time: float) -> Tensor:
        along = azimuth(time)
        tide = strength * torch.cos(2 * math.pi * time / draw["tide_period"] + phase)
        x = steady * along.cos() + tide * bearing.cos()
        return torch.stack([x, steady * along.sin() + tide * bearing.sin()], 1)

    return velocity
