"""Defines the types of a scenario's keys, and the uniform draws from its ranges."""

from typing import Annotated

import torch
from pydantic import AfterValidator, Field, Strict
from torch import Tensor

from emberlink.envs.utils.counter_rng import Use, fold_in, uniform
from emberlink.envs.utils.errors import UserError


def _ordered(pair: tuple[float, float]) -> tuple[float, float]:
    if pair[0] > pair[1]:
        raise UserError(f"a range is (low, high), got {pair}")
    return pair


Ordered = AfterValidator(_ordered)
Pair = Strict(False)  # a list, as in YAML, is valid for a tuple
Degrees = Annotated[float, Field(ge=-360, le=360)]
Turn = Annotated[float, Field(ge=-3600, le=3600)]
Length = Annotated[float, Field(gt=0, le=30)]
Fraction = Annotated[float, Field(ge=0, le=1)]

TEST_FROM = 1_000_000
VALIDATION_FROM = 2_000_000
TestSeed = Annotated[int, Field(ge=TEST_FROM, lt=VALIDATION_FROM)]


def unit_draws(seeds: Tensor, field: int, count: int) -> Tensor:
    """Returns uniform draws on (0, 1) for a field of a scenario, float32 [fires, count].

    Args:
        seeds: int64 [fires].
        field: number of the field in its scenario.
    """
    key = torch.tensor([Use.FIRE_PARAMETER, field], device=seeds.device)
    return uniform(fold_in(fold_in(seeds, key[0]), key[1]), count)
