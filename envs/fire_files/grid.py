"""Samples arrival times at the cells of a grid, crops them, and stretches them over an episode."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import (
    binary_propagation,
    distance_transform_edt,
    find_objects,
    label,
    map_coordinates,
    minimum_filter,
)

from emberlink.envs.config import BASE_SIDE
from emberlink.envs.fire_files.config import FileFireConfig
from emberlink.envs.fire_files.plane import Bounds
from emberlink.envs.fire_files.report import SECONDS, Clock, Report, ask
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

    def samples(self) -> tuple["Window", int]:
        """Returns the window of the sample points, and their number along each side of a cell."""
        (columns, rows), cuts = self.grid, max(1, round(_SAMPLES / min(self.grid)))
        return Window(self.x, self.y, self.side / cuts, (columns * cuts, rows * cuts)), cuts

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
class Raster:
    """A fire read from a file: arrival times on a plane, rows from north to south."""

    times: np.ndarray
    """float64 [rows, columns], inf for never"""
    corner: tuple[float, float]
    """x and y of the upper left corner of the raster"""
    cell: tuple[float, float]
    """width and height of a cell"""
    clock: Clock
    whole: bool = False
    """True for a map of the whole grid, which is neither cropped nor burnt out"""
    window: Window | None = None
    """the crop for whose samples perimeters were drawn; None for the bounds of the burnt area"""
    began: float | None = None
    """time of ignition; None for the first arrival"""

    def __post_init__(self) -> None:
        self.times = self.times.astype(np.float64)
        burning = self.times[np.isfinite(self.times)]
        self.first, self.last = float(burning.min()), float(burning.max())

    def bounds(self, until: float | None = None) -> Bounds:
        """Returns the bounds of the raster, or of the area burnt by a time, up to the front."""
        times, (rows, columns) = self.times, self.times.shape
        left, right, top, bottom = 0.0, float(columns), 0.0, float(rows)
        if until is not None:
            if (times <= until).sum() < 2:
                raise UserError(f"until {self.clock.format(until)} no fire spreads: a single cell")
            left, right = _front(times, until), columns - _front(times[:, ::-1], until)
            top, bottom = _front(times.T, until), rows - _front(times.T[:, ::-1], until)
        (x, y), (width, height) = self.corner, self.cell
        return x + left * width, y - bottom * height, x + right * width, y - top * height

    def on(self, window: Window) -> np.ndarray:
        """Returns the earliest arrival in each cell of a grid, float64 [X, Y], inf for never.

        Candidates are the bilinear sample points in the cell and the centres of the raster's cells
        (on a finer grid, only centres that burn before all their neighbours). A map of the whole
        grid, and a raster with the grid's cells, are not interpolated.
        """
        fine = window.side < (1 - _EDGE) * min(self.cell)
        if self.whole or self._is_aligned(window):
            near = self._at(*self._indices(window))
            centres = self._earliest(self.times, window)
            has_centre = np.isfinite(self._earliest(np.zeros_like(self.times), window))
            return near if fine else np.where(has_centre, centres, near)
        (columns, rows), (points, cuts) = window.grid, window.samples()
        samples = self._interpolate(*self._indices(points))
        samples = samples.reshape(columns, cuts, rows, cuts).min((1, 3))
        first = self.times == minimum_filter(self.times, 3)
        times = np.where(first, self.times, np.inf) if fine else self.times
        return np.minimum(samples, self._earliest(times, window))

    def _indices(self, window: Window) -> tuple[np.ndarray, np.ndarray]:
        """Returns the fractional rows [Y] and columns [X] of the centres of a window's cells."""
        (left, top), (width, height) = self.corner, self.cell
        x, y = window.axes()
        return (top - y) / height - 0.5, (x - left) / width - 0.5

    def _is_aligned(self, window: Window) -> bool:
        """Tells whether the cells of the grid are cells of the raster."""
        apart = [np.abs(at - np.rint(at)).max() for at in self._indices(window)]
        same = all(abs(window.side / side - 1) < _EDGE for side in self.cell)
        return same and max(apart) < 1e-3

    def _earliest(self, times: np.ndarray, window: Window) -> np.ndarray:
        """Returns the earliest arrival among the raster's centres in each cell of a grid."""
        earliest = np.full(window.grid, np.inf)
        rows, columns = np.nonzero(np.isfinite(times))
        (x, y), (width, height) = self.corner, self.cell
        i, j, inside = window.cells(x + (columns + 0.5) * width, y - (rows + 0.5) * height)
        np.minimum.at(earliest, (i[inside], j[inside]), times[rows[inside], columns[inside]])
        return earliest

    def _at(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Returns the times of the nearest rows [Y] and columns [X], [X, Y]; inf outside."""
        padded = np.pad(self.times, 1, constant_values=np.inf)
        inner = [
            np.clip(np.rint(at).astype(np.int64) + 1, 0, size + 1)
            for at, size in zip((rows, columns), self.times.shape, strict=True)
        ]
        return padded[np.ix_(*inner)].T

    def _interpolate(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Interpolates bilinearly between burnt cells, [X, Y]; inf in a cell that never burns."""
        burns, at = np.isfinite(self.times), np.meshgrid(rows, columns)
        weights = map_coordinates(burns.astype(np.float64), at, order=1, mode="nearest")
        total = map_coordinates(np.where(burns, self.times, 0), at, order=1, mode="nearest")
        times = np.maximum(total / np.where(weights > 0, weights, 1), self.first)
        return np.where(np.isinf(self._at(rows, columns)) | (weights == 0), np.inf, times)


def _front(times: np.ndarray, until: float) -> float:
    """Returns the front along lines of cells, in cells, extrapolated beyond the first cell."""
    times = times[(times <= until).any(1)]
    lines, last = np.arange(len(times)), times.shape[1] - 1
    at = (times <= until).argmax(1)
    inner, outer = times[lines, at], times[lines, np.maximum(at - 1, 0)]
    before = times[lines, np.minimum(at + 1, last)]
    between = (at > 0) & np.isfinite(outer)
    step = np.where(between, outer - inner, inner - before)
    share = np.where(step > 0, until - inner, 0.5) / np.where(step > 0, step, 1.0)
    return float((at + 0.5 - np.where(between | (share < 1), share, 0.5)).min())


def beginnings(times: np.ndarray) -> int:
    """Returns the number of places that burn before all cells around them."""
    burns, earliest = np.isfinite(times), times == minimum_filter(times, 3)
    # Of cells that burn at the same time, one may have an earlier neighbour: no beginning.
    later = minimum_filter(np.where(burns & ~earliest, times, np.inf), 3) == times
    places: Any = label(burns & earliest, EIGHT)
    return int(places[1] - len(np.unique(places[0][burns & earliest & later])))


def far_apart(burns: np.ndarray) -> list[str]:
    """Returns a doubt if parts of a fire never join and lie farther apart than they are long."""
    near: Any = distance_transform_edt(~burns)
    reach, longest, parts = -1.0, 0.0, 0
    while longest > reach:
        reach = longest
        groups, parts = label(near <= 0.75 * reach, EIGHT)  # pyright: ignore
        if parts < 2:
            return []
        boxes = find_objects(np.where(burns, groups, 0))
        longest = max(float(axis.stop - axis.start) for box in boxes for axis in box)
    return [f"{parts} groups of parts never join, and lie far apart: one fire? (fire.incident)"]


def on_grid(
    source: Raster, config: FileFireConfig, grid: tuple[int, int], horizon: int, report: Report
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
    if not source.whole and np.isfinite(times).any():
        report.doubts += far_apart(np.isfinite(times))
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
    """Returns the times of the first and last step; a fire `burns` from and to, and `began`."""
    start, end = (_time(key, clock, burns[0], config) for key in ("start", "end"))
    start, end = began if start is None else start, burns[1] if end is None else end
    if config.minutes_per_step is not None:
        if clock.unit not in SECONDS:
            raise ask(f"fire.minutes_per_step: times are in {clock.unit}", "fire.units in time")
        end = start + horizon * config.minutes_per_step * 60 / SECONDS[clock.unit]
    if end < began or start >= burns[1] or start >= end:
        raise _no_fire(clock, (start, end), burns)
    return start, end


def _no_fire(clock: Clock, span: tuple[float, float], burns: tuple[float, float]) -> UserError:
    start, end, first, last = map(clock.format, (*span, *burns))
    return UserError(f"from {start} to {end} no fire spreads; it burns from {first} to {last}")


def _time(key: str, clock: Clock, first: float, config: FileFireConfig) -> float | None:
    """Returns `fire.start` or `fire.end` in the clock's unit."""
    value = getattr(config, key)
    if value is None or (clock.origin is None and not isinstance(value, str)):
        return value
    if clock.origin is None:
        raise ask(f"fire.{key}={value}: the file's times are {clock.unit}", "a number of them")
    if isinstance(value, str):
        date = in_utc(parse_dates([value], config.time_format, f"fire.{key}")[0])
        return (date - clock.origin).total_seconds() / SECONDS[clock.unit]
    if config.units not in SECONDS:
        seen = f"fire.{key}={value:g}: the file's times are dates"
        raise ask(seen, f"such as {clock.format(first)}", "fire.units for a number")
    return first + value * SECONDS[config.units] / SECONDS[clock.unit]


def _burnt_out(times: np.ndarray, start: float, width: float) -> np.ndarray:
    """Returns the mask of burnt cells deeper behind the front than the ring's width, [X, Y]."""
    burnt = times <= start
    if not burnt.any() or math.isinf(width):
        return np.zeros_like(burnt)
    later = np.isfinite(times) & ~burnt
    unburnt: Any = binary_propagation(
        np.pad(later, 1, constant_values=True), mask=~np.pad(burnt, 1)
    )
    depth: Any = distance_transform_edt(~unburnt)  # gaps without cells that burn later are burnt
    return burnt & (depth[1:-1, 1:-1] - 0.5 > width)
