"""The part of a fire, in time and space, that an episode shows."""

import math
from typing import Any, Protocol

import numpy as np
from scipy import ndimage

from emberlink.envs.utils.errors import UserError

from .arrival_raster import SECONDS, Clock, Source, Units, Window
from .perimeter_times import parse_time

BASE_SIDE = 30
"""cells of the side that `ring_width` is told for"""


class Choices(Protocol):
    """What a user chooses of it; see `FileFireConfig`."""

    @property
    def units(self) -> Units | None: ...
    @property
    def start(self) -> float | str | None: ...
    @property
    def end(self) -> float | str | None: ...
    @property
    def minutes_per_step(self) -> float | None: ...
    @property
    def margin(self) -> float | None: ...
    @property
    def ring_width(self) -> float | None: ...


def on_grid(source: Source, choices: Choices, grid: tuple[int, int], horizon: int) -> np.ndarray:
    """A fire on the grid and in the steps of an episode.

    Args:
        source: the fire.
        choices: of the user.
        grid: (X, Y).
        horizon: steps.

    Returns:
        float32 [X, Y], steps; 0 burns from the start, inf never burns.

    Raises:
        ValueError: the chosen span of time or place shows no fire that spreads.
    """
    untouched = choices.start is choices.end is choices.minutes_per_step is None
    as_it_is = untouched and source.clock.unit == "steps"
    start, end = (0.0, float(horizon)) if as_it_is else _span(source, choices, horizon)
    margin = None if source.whole else choices.margin
    bounds = source.extent if margin is None else source.burnt(end)
    window = Window.around(bounds, grid, margin or 0)
    times = source.on(window, end)
    times[(times > end) | window.beyond(bounds)] = np.inf
    if choices.start is None and not as_it_is and not (times <= start).any():
        times[times == times.min()] = start  # the first cell burns from the beginning
    if choices.ring_width is not None and not (source.whole and as_it_is):
        times[_burnt_out(times, start, choices.ring_width * min(grid) / BASE_SIDE)] = np.inf
    steps = (np.maximum(times, start) - start) / (end - start) * horizon
    burning = steps[np.isfinite(steps)]
    if len(burning) < 2 or (not as_it_is and burning.min() == burning.max()):
        shown = source.clock.shown
        raise UserError(
            f"from {shown(start)} to {shown(end)} no fire spreads; it burns from "
            f"{shown(source.first)} to {shown(source.last)}"
        )
    return steps.astype(np.float32)


def _span(source: Source, choices: Choices, horizon: int) -> tuple[float, float]:
    """First and last moment of the episode, in the source's time."""
    start = _moment(choices.start, "start", source, choices.units)
    start = source.began if start is None else start
    end = _moment(choices.end, "end", source, choices.units)
    if choices.minutes_per_step is not None:
        if source.clock.unit == "steps":
            raise UserError(
                "fire.minutes_per_step: the file's times are in steps; expected fire.units in time"
            )
        end = start + horizon * choices.minutes_per_step * 60 / SECONDS[source.clock.unit]
    end = source.last if end is None else end
    shown = source.clock.shown
    if end < source.first or start >= source.last:
        raise UserError(
            f"from {shown(start)} to {shown(end)} no fire spreads; it burns from "
            f"{shown(source.first)} to {shown(source.last)}"
        )
    if not start < end:
        raise UserError(f"from {shown(start)} to {shown(end)}: the end must be after the start")
    return start, end


def _moment(
    value: float | str | None, key: str, source: Source, units: Units | None
) -> float | None:
    """`fire.start` or `fire.end` in the source's time."""
    clock = source.clock
    if value is None:
        return None
    if isinstance(value, str):
        if clock.origin is None:
            raise UserError(
                f"fire.{key}={value}: the file's times are {clock.unit}; expected a number of them"
            )
        return _calendar(value, key, clock)
    if clock.origin is None:
        return float(value)
    if units is None or units == "steps":
        raise UserError(
            f"fire.{key}={value:g}: the file's times are dates; expected such as "
            f"{clock.shown(source.first)}, or fire.units for a number"
        )
    return source.first + float(value) * SECONDS[units] / SECONDS[clock.unit]


def _calendar(text: str, key: str, clock: Clock) -> float:
    assert clock.origin is not None
    try:
        moment = parse_time(text)
    except ValueError:
        raise UserError(
            f"fire.{key}={text[:40]}: no calendar time; expected such as {clock.shown(0)}"
        ) from None
    moment = moment if moment.tzinfo else moment.replace(tzinfo=clock.origin.tzinfo)
    return (moment - clock.origin).total_seconds() / SECONDS[clock.unit]


def _burnt_out(times: np.ndarray, start: float, width: float) -> np.ndarray:
    """What lies deeper within the area burnt at the start than the ring, bool [X, Y].

    A hole in it that never burns, such as a lake or a core burnt out before, has no front.
    """
    burnt = times <= start
    if not burnt.any() or math.isinf(width):
        return np.zeros_like(burnt)
    around = np.pad(burnt, 1)  # what lies beyond the grid has not burnt
    labelled: Any = ndimage.label(~around)
    holes = labelled[0]
    later = np.pad(np.isfinite(times) & ~burnt, 1)
    around |= ~np.isin(holes, [holes[0, 0], *holes[later]])
    depth: Any = ndimage.distance_transform_edt(around)
    return burnt & (depth[1:-1, 1:-1] - 0.5 > width)
