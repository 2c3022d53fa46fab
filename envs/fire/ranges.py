"""Defines what all scenarios of generated fires have: keys, their types, and uniform draws."""

from typing import Annotated, ClassVar

import torch
from pydantic import Field
from pydantic.dataclasses import dataclass
from torch import Tensor

from emberlink.envs.utils.counter_rng import Use, fold_in, uniform
from emberlink.envs.utils.validation import STRICT, Name, Range

Degrees = Annotated[float, Field(ge=-360, le=360)]
Turn = Annotated[float, Field(ge=-3600, le=3600)]
Length = Annotated[float, Field(gt=0, le=30)]
Fraction = Annotated[float, Field(ge=0, le=1)]

TEST_FROM = 1_000_000
VALIDATION_FROM = 2_000_000


@dataclass(frozen=True, kw_only=True, config=STRICT)
class FireRanges:
    """Where generated fires begin, and their wind: a pair is the range of a uniform draw."""

    drawn: ClassVar[tuple[str, ...]]
    """fields that are drawn; the place is part of a draw's key: append new ones, never reorder"""
    name: Name
    """Name of the scenario and its file."""
    num_train_fires: Annotated[int, Field(ge=1, lt=TEST_FROM)]
    """Number of fires to train on."""
    azimuth: Range[Degrees]
    """Direction in which the head moves at step 0, with the wind, degrees counter-clockwise from
    +x."""
    wind_shift: Range[Turn]
    """Steady turning of that direction, degrees per 1000 steps, counter-clockwise."""
    centre_x: Range[Fraction]
    """Centre of the initial disc along x, as a fraction of the box (0 to X - 1)."""
    centre_y: Range[Fraction]
    """Centre of the initial disc along y, as a fraction of the box (0 to Y - 1)."""
    core_radius: Range[Length]
    """Radius of the initial disc, cells."""
    ring_width: Range[Length]
    """Width of the part of the disc that burns at step 0, cells; the rest is burnt out."""
    test_seed: Annotated[int, Field(ge=TEST_FROM, lt=VALIDATION_FROM)] = TEST_FROM
    """Seed of the first test fire."""

    def draw(self, field: str, seeds: Tensor, count: int = 1) -> Tensor:
        """Returns uniform draws from the range of a field, float32 [fires, count]."""
        low, high = getattr(self, field)
        return low + (high - low) * self.unit_draws(field, seeds, count)

    def unit_draws(self, field: str, seeds: Tensor, count: int = 1) -> Tensor:
        """Returns uniform draws on (0, 1) for a field, float32 [fires, count]."""
        key = torch.tensor([Use.FIRE_PARAMETER, self.drawn.index(field)], device=seeds.device)
        return uniform(fold_in(fold_in(seeds, key[0]), key[1]), count)
