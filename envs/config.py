"""The constants of the environment."""

import json
from collections.abc import Mapping
from importlib.resources import files
from typing import Annotated, Any, Literal, TypeVar

from pydantic import ConfigDict, Field, Strict, TypeAdapter, model_validator
from pydantic.dataclasses import dataclass

from .reward import RewardConfig

T = TypeVar("T")


@dataclass(frozen=True, kw_only=True, config=ConfigDict(extra="forbid", strict=True))
class WildfireConfig:
    """The world and the team; the defaults are the paper's text."""

    grid: Annotated[
        tuple[Annotated[int, Field(ge=8, le=256)], Annotated[int, Field(ge=8, le=256)]],
        Strict(False),
    ] = (30, 30)
    """cells along x and y"""
    num_uavs: Annotated[int, Field(ge=1, le=64)] = 6
    """UAVs in the team"""
    horizon: Annotated[int, Field(ge=1, le=1_000_000)] = 1000
    """steps of an episode"""
    altitude: Annotated[
        tuple[Annotated[float, Field(gt=0, le=256)], Annotated[float, Field(gt=0, le=256)]],
        Strict(False),
    ] = (1.0, 4.0)
    """lowest and highest z, cells"""
    view_angle: Annotated[float, Field(gt=0, le=80)] = 30.0
    """half the opening angle of the camera, degrees"""
    displacement: Annotated[float, Field(gt=0, le=256)] = 1.0
    """cells per unit of action"""
    observation: Literal["raw", "box"] = "raw"
    """cells and steps as they are, or scaled: the box to [-1, 1], the horizon to [0, 1]"""
    reward: RewardConfig = RewardConfig()
    """what a UAV earns"""

    @model_validator(mode="after")
    def _altitudes_in_order(self) -> "WildfireConfig":
        if self.altitude[0] > self.altitude[1]:
            raise ValueError(f"altitude {self.altitude}: the lowest is above the highest")
        return self

    @property
    def low(self) -> tuple[float, float, float]:
        """The box's corner with the smallest coordinates, cells."""
        return 0.0, 0.0, self.altitude[0]

    @property
    def high(self) -> tuple[float, float, float]:
        """The box's corner with the largest coordinates, cells."""
        return self.grid[0] - 1.0, self.grid[1] - 1.0, self.altitude[1]


def known(group: str) -> list[str]:
    """The choices of a config group ("method", "setup" or "fire"), in alphabetical order."""
    names = (entry.name for entry in files("emberlink.configs").joinpath(group).iterdir())
    return sorted(name.removesuffix(".yaml") for name in names if name.endswith(".yaml"))


def from_plain(config_type: type[T], values: Mapping[str, Any]) -> T:
    """A configuration from plain values as YAML has them: nothing unknown, nothing coerced.

    Raises:
        pydantic.ValidationError: a ValueError that names what is wrong.
    """
    # Through JSON, whose lists and mappings strict validation takes for tuples and dataclasses.
    return TypeAdapter(config_type).validate_json(json.dumps(values))
