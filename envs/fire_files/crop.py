"""Crops a fire in time and space to an episode."""

import math
from typing import Any

import numpy as np
from scipy import ndimage

from emberlink.envs.config import BASE_SIDE
from emberlink.envs.fire_files.config import SECONDS, Clock, FileFireConfig
from emberlink.envs.fire_files.dates import in_utc, parse_dates
from emberlink.envs.fire_files.grid import Raster, Window
from emberlink.envs.utils.errors import UserError


def on_grid(
    source: Raster, config: FileFireConfig, grid: tuple[int, int], horizon: int
) -> np.ndarray:
    """Crops a fire to a grid (X, Y) and stretches its times over an episode.

    Returns:
        float32 [X, Y], steps; 0 burns from the start, inf never burns.
    """
    no_span = config.start is config.end is config.minutes_per_step is None
    in_steps = no_span and source.clock.unit == "steps"
    burns = source.first, source.last
    if in_steps:
        start, end = 0.0, float(horizon)
    else:
        began = source.first if source.began is None else source.began
        start, end = span(source.clock, burns, began, config, horizon)
    margin = None if source.whole else config.margin
    window = source.window
    if window is None:
        window = Window.around(source.bounds(None if margin is None else end), grid, margin or 0)
    times = source.on(window)
    times[times > end] = np.inf
    if config.start is None and not in_steps and not (times <= start).any():
        times[times == times.min()] = start  # the first cell burns from step 0
    if config.ring_width is not None and not source.whole:
        times[_burnt_out(times, start, config.ring_width * min(grid) / BASE_SIDE)] = np.inf
    steps = (np.maximum(times, start) - start) / (end - start) * horizon
    burning = steps[np.isfinite(steps)]
    if len(burning) < 2 or (not in_steps and burning.min() == burning.max()):
        raise _no_fire(source.clock, (start, end), burns)
    return steps.astype(np.float32)


def span(
    clock: Clock, burns: tuple[float, float], began: float, config: FileFireConfig, horizon: int
) -> tuple[float, float]:
    """Returns the times of the first and the last step, in the clock's unit.

    Args:
        clock: of the file.
        burns: first and last arrival in the file.
        began: time of ignition.
    """
    given = {"start": config.start, "end": config.end}
    values = {key: _time(value, key, clock, burns[0], config) for key, value in given.items()}
    start, end = values["start"], values["end"]
    start, end = began if start is None else start, burns[1] if end is None else end
    if config.minutes_per_step is not None:
        if clock.unit not in SECONDS:
            raise UserError(
                f"fire.minutes_per_step: the file's times are in {clock.unit}; expected fire.units "
                "in time"
            )
        end = start + horizon * config.minutes_per_step * 60 / SECONDS[clock.unit]
    if end < began or start >= burns[1]:
        raise _no_fire(clock, (start, end), burns)
    if not start < end:
        text = clock.format
        raise UserError(f"from {text(start)} to {text(end)}: the end must be after the start")
    return start, end


def _no_fire(clock: Clock, span: tuple[float, float], burns: tuple[float, float]) -> UserError:
    start, end, first, last = map(clock.format, (*span, *burns))
    return UserError(f"from {start} to {end} no fire spreads; it burns from {first} to {last}")


def _time(
    value: float | str | None, key: str, clock: Clock, first: float, config: FileFireConfig
) -> float | None:
    """Returns `fire.start` or `fire.end` in the clock's unit."""
    if value is None or (clock.origin is None and not isinstance(value, str)):
        return value
    if clock.origin is None:
        raise UserError(
            f"fire.{key}={value}: the file's times are {clock.unit}; expected a number of them"
        )
    if isinstance(value, str):
        date = in_utc(parse_dates([value], config.time_format, f"fire.{key}")[0])
        return (date - clock.origin).total_seconds() / SECONDS[clock.unit]
    if config.units not in SECONDS:
        raise UserError(
            f"fire.{key}={value:g}: the file's times are dates; expected such as "
            f"{clock.format(first)}, or fire.units for a number"
        )
    return first + value * SECONDS[config.units] / SECONDS[clock.unit]


def _burnt_out(times: np.ndarray, start: float, width: float) -> np.ndarray:
    """Returns the mask of burnt cells deeper behind the front than the ring's width, [X, Y]."""
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
