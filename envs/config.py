"""The constants of the environment."""

import math
from typing import Annotated, Literal

from pydantic import Field, Strict, ValidationInfo, field_validator
from pydantic.dataclasses import dataclass

from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import STRICT, Range

Number = Annotated[float, Field(ge=-1e12, le=1e12)]
"""bounded so that the square of a sum over a view cannot overflow float32"""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class RewardConfig:
    """The reward of a UAV in one step (paper, section IV.C); the defaults are the paper's."""

    new_fire: Number = 1.0
    """per cell in view that burns and was not seen before"""
    old_fire: Number = -4.0
    """per cell in view that burns and was seen before"""
    no_fire: Number = -10.0
    """per cell in view that does not burn"""
    base: Number = 0.0
    """per burnt cell new to the base, to each UAV whose messages arrive there"""
    exit: Number = -100.0
    """replaces the reward for cells and news in a step whose move would have left the box"""
    exit_axes: Literal["xyz", "xy"] = "xyz"
    """the axes on which leaving the box is tested"""
    unseen: Number = 0.0
    """times log(1 + n), added in every step, where n is the number of burning cells that no UAV has
    seen while they burned; a negative value penalises late finds"""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class RadioConfig:
    """The radios of the UAVs and of the base station."""

    range: Annotated[float, Field(ge=0)] = 10.0
    """radios at a distance below this hear each other, cells; 0 turns them off, inf is no limit"""
    loss: Annotated[float, Field(ge=0, le=1)] = 0.0
    """probability that a radio does not hear another one in a step, each direction independently"""
    burst: Annotated[float, Field(ge=1, le=1_000_000)] = 1.0
    """mean length of a spell in which a radio does not hear another one, steps; at 1, and up to
    1 / (1 - loss), losses are independent"""
    fade: bool = False
    """whether messages are lost, too, with a probability that rises with the distance"""
    delay: Annotated[int, Field(ge=0, le=1000)] = 0
    """steps from sending a message to receiving it"""
    bandwidth: Annotated[int, Field(ge=0, le=1_000_000_000)] | None = None
    """bytes that a UAV can say in a step, half of them to the base if there is one; None for no
    limit"""
    shared: bool = False
    """whether radios in range of each other share the bandwidth"""

    @property
    def packets(self) -> bool:
        """Whether messages go one link at a time, as they are late or limited."""
        return self.range > 0 and (self.delay > 0 or self.bandwidth is not None)


LARGEST_SCALE = 16
"""Cells along the side of a pixel; sums over a pixel fit into the bits of a field of `Crops`."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class MapConfig:
    """The pictures of a UAV's map, with `observation: map`."""

    pixels: Annotated[int, Field(ge=8, le=64)] = 24
    """pixels along the side of a picture"""
    scales: Annotated[
        tuple[Annotated[int, Field(ge=1, le=LARGEST_SCALE)], ...],
        Field(min_length=1, max_length=4),
        Strict(False),
    ] = (1, 5)
    """cells along the side of a pixel, in each picture"""
    spread: Annotated[int, Field(ge=0, le=16)] = 2
    """cells around known fire that may burn by now, along x and y; 0 for none"""
    position: bool = False
    """whether a UAV also observes its own x and y"""


BASE_SIDE = 30
"""Cells of the shorter side for which lengths of a fire are given."""
SIDES = (8, 256)
"""minimum and maximum cells along a side of a grid"""
_Share = Annotated[float, Field(ge=0, le=1)]
_Altitude = Annotated[float, Field(gt=0, le=256)]
_Side = Annotated[int, Field(ge=SIDES[0], le=SIDES[1])]


@dataclass(frozen=True, kw_only=True, config=STRICT)
class WildfireConfig:
    """The world and the team; the defaults are the paper's."""

    grid: Annotated[tuple[_Side, _Side], Strict(False)] = (30, 30)
    """cells along x and y"""
    num_uavs: Annotated[int, Field(ge=1, le=64)] = 6
    """UAVs in the team"""
    horizon: Annotated[int, Field(ge=1, le=1_000_000)] = 1000
    """steps of an episode"""
    altitude: Range[_Altitude] = (1.0, 4.0)
    """lowest and highest z, cells"""
    view_angle: Annotated[float, Field(gt=0, le=80)] = 30.0
    """half the opening angle of the camera, degrees"""
    sensor: Annotated[tuple[_Share, _Share], Strict(False)] = (1.0, 1.0)
    """probability that a UAV recognises a cell in view, at each look, at the lowest and the highest
    altitude, linear between; what it does not recognise counts as not in view"""
    displacement: Annotated[float, Field(gt=0, le=256)] = 1.0
    """cells per unit of action"""
    observation: Literal["vector", "window", "map"] = "vector"
    """six numbers per UAV; `window` adds the classes of the cells in view (`keys.WINDOW`); `map`:
    altitude, time and pictures of the UAV's own map (`keys.CROPS`)"""
    map: MapConfig = MapConfig()
    """the pictures of the map"""
    knowledge: Literal["team", "own"] = "team"
    """which fire is old to a UAV: what the team has seen while it burned, as in the paper, or what
    the UAV itself has; rewards and measures count what is new to the team"""
    observation_scale: Literal["raw", "box"] = "raw"
    """cells and steps as they are, or scaled: the box to [-1, 1], the horizon to [0, 1]"""
    reward: RewardConfig = RewardConfig()
    """the reward of a UAV"""
    radio: RadioConfig = RadioConfig()
    """the radios, through which UAVs hear each other and the base station"""
    base: Annotated[tuple[float, float], Strict(False)] | None = None
    """x and y of the base station on the ground, cells; None for no base station"""
    failures: Annotated[float, Field(ge=0)] = 0.0
    """expected number of UAVs that fail in an episode, each at a random step"""
    measures: Literal["paper", "all"] = "paper"
    """the measures of an episode: the paper's, or also the ages of sightings and the messages"""

    @field_validator("base")
    @classmethod
    def _check_base(cls, value: tuple[float, float] | None, info: ValidationInfo):
        grid = info.data.get("grid")
        if value is None or grid is None:
            return value
        if not all(0 <= place <= side - 1 for place, side in zip(value, grid, strict=True)):
            raise UserError(f"outside of the map, [0, 0] to [{grid[0] - 1}, {grid[1] - 1}]")
        return value

    @field_validator("failures")
    @classmethod
    def _check_failures(cls, value: float, info: ValidationInfo):
        uavs = info.data.get("num_uavs", math.inf)
        if value > uavs:
            raise UserError(f"the team has {uavs} UAVs")
        return value

    @property
    def reports(self) -> bool:
        """Whether the bytes that UAVs tell the base are counted."""
        return self.base is not None and self.measures == "all" and self.radio.packets

    @property
    def low(self) -> tuple[float, float, float]:
        """The box's corner with the smallest coordinates, cells."""
        return 0.0, 0.0, self.altitude[0]

    @property
    def high(self) -> tuple[float, float, float]:
        """The box's corner with the largest coordinates, cells."""
        return self.grid[0] - 1.0, self.grid[1] - 1.0, self.altitude[1]
