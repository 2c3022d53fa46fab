"""Crops a fire to the cells of a grid, and stretches its times over an episode."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import binary_propagation, distance_transform_edt, label, minimum_filter

from emberlink.envs.config import BASE_SIDE
from emberlink.envs.fire_files.config import FileFireConfig
from emberlink.envs.fire_files.plane import Bounds
from emberlink.envs.fire_files.report import SECONDS, Clock, Report, ask, counted
from emberlink.envs.fire_files.times import in_utc, parse_dates
from emberlink.envs.utils.errors import UserError

EIGHT = np.ones((3, 3))
"""A cell and the eight around it."""
_SAMPLES = 180  # points along the grid's shorter side; a cell gets the earliest of them
_EDGE = 1e-6  # cells: tolerance, so that rounding does not move a centre across an edge


@dataclass(frozen=True)
class Window:
    """A part of the plane that a grid (X, Y) covers with square cells, from a lower left corner."""

    x: float
    y: float
    side: float
    grid: tuple[int, int]

    @classmethod
    def around(cls, bounds: Bounds, grid: tuple[int, int], margin: float) -> "Window":
        """Returns the smallest window with a margin, a part of the grid, around `bounds`."""
        width, height = bounds[2] - bounds[0], bounds[3] - bounds[1]
        side = max(width / grid[0], height / grid[1]) / (1 - 2 * margin)
        x, y = (bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2
        return cls(x - side * grid[0] / 2, y - side * grid[1] / 2, side, grid)

    def samples(self) -> "Window":
        """Returns the window of the sample points, the centres of its cells."""
        (columns, rows), cuts = self.grid, max(1, round(_SAMPLES / min(self.grid)))
        return Window(self.x, self.y, self.side / cuts, (columns * cuts, rows * cuts))

    def earliest(self, samples: np.ndarray) -> np.ndarray:
        """Returns the earliest sample in each cell, [X, Y]."""
        cuts = len(samples) // self.grid[0]
        return samples.reshape(self.grid[0], cuts, self.grid[1], cuts).min((1, 3))

    def axes(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns x [X] and y [Y] of the cells' centres."""
        columns, rows = (np.arange(count) + 0.5 for count in self.grid)
        return self.x + columns * self.side, self.y + rows * self.side

    def cells(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns the indices of the cells in which points lie, and which are in the grid."""
        shares = (x - self.x) / self.side, (y - self.y) / self.side
        i, j = (np.floor(share + _EDGE).astype(np.int64) for share in shares)
        return i, j, (i >= 0) & (j >= 0) & (i < self.grid[0]) & (j < self.grid[1])


@dataclass
class Fire:
    """A fire read from a file, on a plane."""

    clock: Clock
    first: float
    """time of the first arrival"""
    last: float
    whole: bool
    """True for a map of the whole grid, which is neither cropped nor burnt out"""

    def bounds(self, until: float | None) -> Bounds:
        """Returns the bounds of the area burnt by a time; None for the whole file."""
        raise NotImplementedError

    def on(self, window: Window, until: float, report: Report) -> np.ndarray:
        """Returns the earliest arrival in each cell, float64 [X, Y]; all later ones may be inf."""
        raise NotImplementedError


def on_grid(
    fire: Fire, config: FileFireConfig, grid: tuple[int, int], horizon: int, report: Report
) -> np.ndarray:
    """Crops a fire to a grid (X, Y) and stretches its times over an episode.

    Returns:
        float32 [X, Y], steps; 0 burns from the start, inf never burns.
    """
    no_span = config.start is config.end is config.minutes_per_step is None
    in_steps = no_span and fire.clock.unit == "steps"
    start, end = (0.0, float(horizon)) if in_steps else _span(fire, config, horizon)
    margin = None if fire.whole else config.margin
    bounds = fire.bounds(None if margin is None else end)
    times = fire.on(Window.around(bounds, grid, margin or 0), end, report)
    times[times > end] = np.inf
    if config.start is None and not in_steps and not (times <= start).any():
        times[times == times.min()] = start  # the first cell burns from step 0
    if not fire.whole:
        places = _beginnings(((times - start) / (end - start)).round(2))
        report.facts.append(f"{counted(places, 'place')} where it begins")
        near: Any = distance_transform_edt(np.isinf(times))
        parts = label(near <= min(grid) / 10, EIGHT)[1]  # pyright: ignore
        if parts > 1:
            found = f"{parts} groups of parts never join and lie a fifth of the grid apart"
            report.doubts.append(f"{found}: one fire? (fire.incident)")
        if config.ring_width is not None:
            times[_burnt_out(times, start, config.ring_width * min(grid) / BASE_SIDE)] = np.inf
    steps = (np.maximum(times, start) - start) / (end - start) * horizon
    burning = steps[np.isfinite(steps)]
    if len(burning) < 2 or (not in_steps and burning.min() == burning.max()):
        raise _no_fire(fire, start, end)
    return steps.astype(np.float32)


def _span(fire: Fire, config: FileFireConfig, horizon: int) -> tuple[float, float]:
    """Returns the times of the first and last step."""
    clock, steps = fire.clock, config.minutes_per_step
    start, end = (_time(getattr(config, key), fire, config) for key in ("start", "end"))
    start = beginning(fire.clock, config, fire.first, fire.last) if start is None else start
    end = fire.last if end is None else end
    if steps is not None and clock.unit not in SECONDS:
        raise ask(f"fire.minutes_per_step: times are in {clock.unit}", "fire.units")
    if steps is not None:
        end = start + horizon * steps * 60 / SECONDS[clock.unit]
    if end < min(start, fire.first) or start >= min(fire.last, end):
        raise _no_fire(fire, start, end)
    return start, end


def beginning(clock: Clock, config: FileFireConfig, first: float, last: float) -> float:
    """Returns when a fire began: elapsed times are counted from there."""
    if clock.origin is not None or clock.unit == "day_of_year" or clock.unit not in SECONDS:
        return first
    if config.start is None and first > last - first > 0:
        seen = f"times from {clock.format(first)} to {clock.format(last)}"
        raise ask(seen, "fire.start=0 if it began at 0", f"fire.start={first:g} if it began then")
    return 0.0


def _time(value: float | str | None, fire: Fire, config: FileFireConfig) -> float | None:
    """Returns `fire.start` or `fire.end` in the clock's unit."""
    clock = fire.clock
    if value is None or (clock.origin is None and not isinstance(value, str)):
        return value
    if isinstance(value, str) and clock.origin is not None:
        date = in_utc(parse_dates([value], config.time_format, "fire.start or fire.end")[0])
        return (date - clock.origin).total_seconds() / SECONDS[clock.unit]
    if isinstance(value, str) or config.units not in SECONDS:
        seen = f"fire.start or fire.end={value}: times are such as {clock.format(fire.first)}"
        raise ask(seen, "one of these, or a number with fire.units")
    return fire.first + value * SECONDS[config.units] / SECONDS[clock.unit]


def _no_fire(fire: Fire, *span: float) -> UserError:
    start, end, first, last = map(fire.clock.format, (*span, fire.first, fire.last))
    return UserError(f"from {start} to {end} no fire spreads; it burns from {first} to {last}")


def _beginnings(times: np.ndarray) -> int:
    """Returns the number of places that burn before all cells around them."""
    burns, earliest = np.isfinite(times), times == minimum_filter(times, 3)
    # Of cells that burn at the same time, one may have an earlier neighbour: no beginning.
    later = minimum_filter(np.where(burns & ~earliest, times, np.inf), 3) == times
    places: Any = label(burns & earliest, EIGHT)
    return int(places[1] - len(np.unique(places[0][burns & earliest & later])))


def _burnt_out(times: np.ndarray, start: float, width: float) -> np.ndarray:
    """Returns the mask of burnt cells deeper behind the front than the ring's width, [X, Y]."""
    burnt = times <= start
    if not burnt.any():
        return burnt
    later = np.isfinite(times) & ~burnt
    unburnt: Any = binary_propagation(
        np.pad(later, 1, constant_values=True), mask=~np.pad(burnt, 1)
    )
    depth: Any = distance_transform_edt(~unburnt)  # gaps without cells that burn later are burnt
    return burnt & (depth[1:-1, 1:-1] - 0.5 > width)
