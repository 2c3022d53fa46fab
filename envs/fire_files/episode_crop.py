"""Crops a fire in time and space to an episode."""

import math
from typing import Any

import numpy as np
from scipy import ndimage

from emberlink.envs.config import BASE_SIDE
from emberlink.envs.fire_files.config import SECONDS, Clock, FileFireConfig, Units
from emberlink.envs.fire_files.perimeters.times import in_utc, parse_time
from emberlink.envs.fire_files.raster_source import Source, Window
from emberlink.envs.utils.errors import UserError


def on_grid(
    source: Source, config: FileFireConfig, grid: tuple[int, int], horizon: int
) -> np.ndarray:
    """Crops a fire to a grid and stretches its times over an episode.

    Args:
        source: the fire.
        config: the span of time, the margin and the ring.
        grid: (X, Y).
        horizon: steps.

    Returns:
        float32 [X, Y], steps; 0 burns from the start, inf never burns.

    Raises:
        UserError: no fire spreads in the chosen span of time.
    """
    no_span = config.start is config.end is config.minutes_per_step is None
    in_steps = no_span and source.clock.unit == "steps"
    start, end = (0.0, float(horizon)) if in_steps else _span(source, config, horizon)
    margin = None if source.whole else config.margin
    bounds = source.extent if margin is None else source.burnt(end)
    times = source.on(Window.around(bounds, grid, margin or 0), end)
    times[times > end] = np.inf
    if config.start is None and not in_steps and not (times <= start).any():
        times[times == times.min()] = start  # the first cell burns from step 0
    if config.ring_width is not None and not source.whole:
        times[_burnt_out(times, start, config.ring_width * min(grid) / BASE_SIDE)] = np.inf
    steps = (np.maximum(times, start) - start) / (end - start) * horizon
    burning = steps[np.isfinite(steps)]
    if len(burning) < 2 or (not in_steps and burning.min() == burning.max()):
        raise _no_fire(source, start, end)
    return steps.astype(np.float32)


def _no_fire(source: Source, start: float, end: float) -> UserError:
    text = source.clock.format
    return UserError(
        f"from {text(start)} to {text(end)} no fire spreads; it burns from {text(source.first)} to "
        f"{text(source.last)}"
    )


def _span(source: Source, config: FileFireConfig, horizon: int) -> tuple[float, float]:
    """Returns the times of the first and the last step, in the source's unit."""
    start = _time(config.start, "start", source, config.units)
    start = source.began if start is None else start
    end = _time(config.end, "end", source, config.units)
    if config.minutes_per_step is not None:
        if source.clock.unit == "steps":
            raise UserError(
                "fire.minutes_per_step: the file's times are in steps; expected fire.units in time"
            )
        end = start + horizon * config.minutes_per_step * 60 / SECONDS[source.clock.unit]
    end = source.last if end is None else end
    if end < source.began or start >= source.last:
        raise _no_fire(source, start, end)
    if not start < end:
        text = source.clock.format
        raise UserError(f"from {text(start)} to {text(end)}: the end must be after the start")
    return start, end


def _time(value: float | str | None, key: str, source: Source, units: Units | None) -> float | None:
    """Returns `fire.start` or `fire.end` in the source's unit."""
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
            f"{clock.format(source.first)}, or fire.units for a number"
        )
    return source.first + float(value) * SECONDS[units] / SECONDS[clock.unit]


def _calendar(text: str, key: str, clock: Clock) -> float:
    assert clock.origin is not None
    try:
        time = in_utc(parse_time(text))
    except UserError:
        raise UserError(
            f"fire.{key}={text}: not a calendar time; expected such as {clock.format(0)}"
        ) from None
    return (time - clock.origin).total_seconds() / SECONDS[clock.unit]


def _burnt_out(times: np.ndarray, start: float, width: float) -> np.ndarray:
    """Returns the mask of burnt cells that are deeper inside than the width of the ring, [X, Y].

    Depth is measured from the front at the start. A hole that never burns, such as a lake, has no
    front.
    """
    burnt = times <= start
    if not burnt.any() or math.isinf(width):
        return np.zeros_like(burnt)
    around = np.pad(burnt, 1)  # cells outside the grid have not burnt
    labelled: Any = ndimage.label(~around)
    holes = labelled[0]
    later = np.pad(np.isfinite(times) & ~burnt, 1)
    around |= ~np.isin(holes, [holes[0, 0], *holes[later]])
    depth: Any = ndimage.distance_transform_edt(around)
    return burnt & (depth[1:-1, 1:-1] - 0.5 > width)
