"""The constants of the environment."""

import json
import reprlib
from collections.abc import Mapping
from importlib.resources import files
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import ConfigDict, Field, Strict, TypeAdapter, ValidationError, model_validator
from pydantic.dataclasses import dataclass

from .reward import RewardConfig

T = TypeVar("T")

SIDES = (8, 256)
"""least and most cells along a side of a grid"""
_Side = Annotated[int, Field(ge=SIDES[0], le=SIDES[1])]

TAG = "kind:"
"""begins the name of one of several types that a value may be of; no part of its key"""
Name = Annotated[str, Field(pattern=r"^\w[\w.+-]*$", max_length=100)]
"""what may be part of a file's name, and of a measure's"""


@dataclass(frozen=True, kw_only=True, config=ConfigDict(extra="forbid", strict=True))
class WildfireConfig:
    """The world and the team; the defaults are the paper's text."""

    grid: Annotated[tuple[_Side, _Side], Strict(False)] = (30, 30)
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


def check_grid(grid: tuple[int, int]) -> None:
    """That a map has as many cells along each side as fires are made and read for.

    Raises:
        ValueError: it has not.
    """
    if not all(SIDES[0] <= side <= SIDES[1] for side in grid):
        raise ValueError(f"grid must have {SIDES[0]} to {SIDES[1]} cells a side, got {grid}")


def known(group: str) -> list[str]:
    """The choices of a config group ("method", "setup" or "fire"), in alphabetical order."""
    names = (entry.name for entry in files("emberlink.configs").joinpath(group).iterdir())
    return sorted(name.removesuffix(".yaml") for name in names if name.endswith(".yaml"))


def from_plain(config_type: type[T], values: Mapping[str, Any]) -> T:
    """A configuration from plain values as YAML has them: nothing unknown, nothing coerced.

    Raises:
        pydantic.ValidationError: a ValueError that names what is wrong.
        ValueError: a value that no YAML of ours holds, such as bytes, or a list within itself.
    """
    # Through JSON, whose lists and mappings strict validation takes for tuples and dataclasses.
    return TypeAdapter(config_type).validate_json(json.dumps(plain(values)))


def plain(value: Any, key: str = "", deepest: int = 16) -> Any:
    """The value as JSON can hold it; numpy's numbers and arrays become Python's.

    Args:
        value: mappings, lists and tuples of text, numbers, bool and None.
        key: where it stands, for messages.
        deepest: levels that may be below it.

    Raises:
        ValueError: it holds something else; one line that names the key.
    """
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if isinstance(value, Mapping | list | tuple) and deepest == 0:
        raise ValueError(f"{key[:60]}: lists or mappings within each other, too many levels")
    if isinstance(value, Mapping):
        for name in value:
            if not isinstance(name, str) or not name.isprintable():
                raise ValueError(f"key {shown(name)} in {key or 'the configuration'} is no name")
        prefix = f"{key}." if key else ""
        return {name: plain(item, prefix + name, deepest - 1) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item, f"{key}.{place}", deepest - 1) for place, item in enumerate(value)]
    if isinstance(value, str) and not value.isprintable():
        raise ValueError(f"{key}={shown(value)}: holds characters that cannot be printed")
    if isinstance(value, int) and value.bit_length() > 1024:
        raise ValueError(f"{key}: a whole number of {value.bit_length()} bits is too large")
    if not isinstance(value, str | int | float | None):
        raise ValueError(f"{key}={shown(value)}: {type(value).__name__} is no number, text or list")
    return value


def shown(value: Any) -> str:
    """A value in a message: as it is where it is short and can be printed, else cut and escaped."""
    text = value if isinstance(value, str) else reprlib.repr(value)
    return printable(text if len(text) <= 100 else f"{text[:60]}...{text[-20:]}")


def printable(text: str) -> str:
    """The text on one line, what cannot be printed escaped."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def describe(error: ValidationError, prefix: str = "") -> str:
    """One line for what pydantic found first: the key, the value, and what was expected."""
    first = error.errors()[0]
    parts = [str(part) for part in first["loc"] if not str(part).startswith(TAG)]
    key = ".".join([prefix, *parts] if prefix else parts)
    if isinstance(cause := first.get("ctx", {}).get("error"), ValidationError):
        return describe(cause, key)
    message = first["msg"].removeprefix("Value error, ").replace("Input should", "should", 1)
    if first["type"] in ("missing", "unexpected_keyword_argument"):
        wrong = "missing" if first["type"] == "missing" else "not known"
        return f"key {shown(key)!r} is {wrong}"
    if message.startswith((f"{key}=", f"{key}.")):
        return message
    value = "" if isinstance(first["input"], dict) else f"={shown(first['input'])}"
    return f"{key}{value}: {message}"
