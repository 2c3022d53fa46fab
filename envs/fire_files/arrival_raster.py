"""Arrival times on a source's own cells, and how they come onto a grid."""

from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from typing import Literal, Protocol

import numpy as np
from scipy.ndimage import minimum_filter

from emberlink.envs.utils.errors import UserError

from .projection import Bounds, Move, same

Units = Literal["steps", "seconds", "minutes", "hours", "days"]
SECONDS = {"seconds": 1.0, "minutes": 60.0, "hours": 3600.0, "days": 86400.0}
FINE_SIDE = 180
"""A cell of the grid is looked at in its parts, of which the earliest counts: so many along the
grid's shorter side. Fires from rasters and from perimeters are looked at in the same places."""
_EDGE = 1e-6  # cells: a centre that lies on an edge belongs to the same side whatever is rounded


@dataclass(frozen=True)
class Clock:
    """What the numbers of a source mean."""

    unit: Units
    origin: datetime | None = None
    """calendar time of 0"""

    def shown(self, time: float) -> str:
        """A time in a message."""
        if self.origin is not None:
            try:
                shown = self.origin + timedelta(seconds=time * SECONDS[self.unit])
                return shown.isoformat(timespec="minutes")
            except OverflowError:  # no year of four digits
                pass
        return f"{time:g} {self.unit}"


@dataclass(frozen=True)
class Window:
    """A part of the plane that a grid covers with square cells."""

    x: float
    """of the left edge"""
    y: float
    """of the lower edge"""
    side: float
    """of a cell"""
    grid: tuple[int, int]

    @classmethod
    def around(cls, bounds: Bounds, grid: tuple[int, int], margin: float) -> "Window":
        """The smallest one that leaves a part of the grid free on each side of `bounds`."""
        width, height = bounds[2] - bounds[0], bounds[3] - bounds[1]
        side = max(width / grid[0], height / grid[1]) / (1 - 2 * margin)
        x, y = (bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2
        return cls(x - side * grid[0] / 2, y - side * grid[1] / 2, side, grid)

    @property
    def cuts(self) -> int:
        """Into how many parts along each side a cell is cut to be looked at."""
        return max(1, round(FINE_SIDE / min(self.grid)))

    def finer(self, times: int, ring: tuple[int, int]) -> "Window":
        """The same with each cell cut into times x times, and further such cells around it."""
        side = self.side / times
        grid = self.grid[0] * times + 2 * ring[0], self.grid[1] * times + 2 * ring[1]
        return replace(
            self, x=self.x - ring[0] * side, y=self.y - ring[1] * side, side=side, grid=grid
        )

    def centres(self) -> tuple[np.ndarray, np.ndarray]:
        """Of all cells, [X, Y] each."""
        x, y = (
            start + (np.arange(count) + 0.5) * self.side
            for start, count in zip((self.x, self.y), self.grid, strict=True)
        )
        return np.meshgrid(x, y, indexing="ij")

    def earliest(self, parts: np.ndarray) -> np.ndarray:
        """The least in each cell, [X, Y], of a number for each of its parts, [X cuts, Y cuts]."""
        columns, rows = self.grid
        return parts.reshape(columns, self.cuts, rows, self.cuts).min((1, 3))

    def beyond(self, bounds: Bounds) -> np.ndarray:
        """Which cells lie outside of some bounds with all of their area, bool [X, Y]."""
        outside: list[np.ndarray] = []
        for start, count, low, high in zip(
            (self.x, self.y), self.grid, bounds[:2], bounds[2:], strict=True
        ):
            edges = start + np.arange(count + 1) * self.side
            near = _EDGE * self.side
            outside.append((edges[1:] <= low + near) | (edges[:-1] >= high - near))
        return outside[0][:, None] | outside[1][None, :]

    def cells(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Which cell each point lies in; it may be outside the grid."""
        i, j = ((at - start) / self.side for at, start in ((x, self.x), (y, self.y)))
        return np.floor(i + _EDGE).astype(np.int64), np.floor(j + _EDGE).astype(np.int64)


def within(i: np.ndarray, j: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Which pairs of indices are those of a cell, bool."""
    return (i >= 0) & (j >= 0) & (i < shape[0]) & (j < shape[1])


class Source(Protocol):
    """A fire as a file has it."""

    clock: Clock
    began: float
    """when the fire began, as far as is known"""
    first: float
    """earliest arrival that was seen"""
    last: float
    """latest arrival"""
    extent: Bounds
    """of all that the file tells of, on the plane"""
    whole: bool
    """whether it is a map of the whole box in steps, to be taken as it is"""

    def burnt(self, until: float) -> Bounds:
        """What the area burnt by a time covers, on the plane."""
        ...

    def on(self, window: Window, until: float) -> np.ndarray:
        """Arrival times on a grid, float64 [X, Y], inf for never; exact up to `until`."""
        ...


class RasterSource:
    """Arrival times on a raster.

    Args:
        times: float64 [rows, columns], inf for never.
        affine: (a, b, c, d, e, f): column and row, counted from the outer corner of the first cell,
            are at x = a column + b row + c and y = d column + e row + f.
        clock: of the times.
        moves: from there to the plane, and back.
        whole: as of `Source`.
    """

    def __init__(
        self,
        times: np.ndarray,
        affine: tuple[float, ...],
        clock: Clock,
        moves: tuple[Move, Move] = (same, same),
        whole: bool = False,
    ):
        self.times, self.clock, self.whole = times.astype(np.float64), clock, whole
        self._affine, self._moves = affine, moves
        burning = times[np.isfinite(times)]
        self.first, self.last = float(burning.min()), float(burning.max())
        self.began = 0.0 if self._from_zero() else self.first
        rows, columns = (np.arange(count) for count in times.shape)
        edge_rows = np.concatenate([rows, rows, 0 * columns, 0 * columns + len(rows) - 1])
        edge_columns = np.concatenate([0 * rows, 0 * rows + len(columns) - 1, columns, columns])
        self.extent = self._around(edge_rows, edge_columns)

    def burnt(self, until: float) -> Bounds:
        """What has burnt by a time covers: to the front where it goes on, else whole cells.

        Raises:
            ValueError: a single cell has burnt.
        """
        if (self.times <= until).sum() < 2:
            raise UserError(
                f"from {self.clock.shown(self.first)} to {self.clock.shown(until)} a single cell "
                "burns: no fire spreads; expected a later end"
            )
        rows: list[np.ndarray] = []
        columns: list[np.ndarray] = []
        for times, along, across in ((self.times, columns, rows), (self.times.T, rows, columns)):
            lines = np.flatnonzero((times <= until).any(1))
            last = times.shape[1] - 1
            along += [_first(times[lines], until), last - _first(times[lines, ::-1], until)]
            across += [lines, lines]
        x, y = self._plane(np.concatenate(rows), np.concatenate(columns))
        return float(x.min()), float(y.min()), float(x.max()), float(y.max())

    def on(self, window: Window, until: float) -> np.ndarray:
        """The earliest arrival in each cell of a grid: at points in it, between the burnt cells
        around them, and at the centres of the raster's own cells.

        On a grid finer than the raster, of these centres those count that burn before all around
        them. A map of the whole box is one of cells, not of points in a field.
        """
        fine = window.side < (1 - _EDGE) * self._side()
        if self.whole or self._own(window):
            return self._cells(window, fine)
        points = self._cell(*window.finer(window.cuts, (0, 0)).centres())
        found = window.earliest(self._between(*points))
        times = self.times
        if fine:
            times = np.where(times == minimum_filter(times, 3), times, np.inf)
        return np.minimum(found, self._earliest(times, window))

    def _from_zero(self) -> bool:
        """Whether the first cell burns no later than the front crosses a cell there: the ignition
        was in it, at time 0, and not in the middle."""
        if self.whole or self.clock.unit == "steps" or self.clock.origin is not None:
            return False
        row, column = np.unravel_index(self.times.argmin(), self.times.shape)
        around = self.times[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
        later = around[np.isfinite(around) & (around > self.first)]
        return bool(0 <= self.first <= (later - self.first).max(initial=0.0))

    def _own(self, window: Window) -> bool:
        """Whether the grid's cells are the raster's."""
        at = self._cell(*window.centres())
        apart = max(np.abs(one - np.rint(one)).max() for one in at)
        return abs(window.side / self._side() - 1) < _EDGE and bool(apart < 1e-3)

    def _cells(self, window: Window, fine: bool) -> np.ndarray:
        """The earliest of the cells whose centre lies in one of the grid, else the nearest."""
        row, column = (np.rint(at).astype(np.int64) for at in self._cell(*window.centres()))
        near = self._at(row, column)
        if fine:
            return near
        found = self._earliest(self.times, window)
        i, j = window.cells(*self._plane(row, column))
        mine = np.indices(window.grid)
        return np.where(np.isinf(found) & ((i != mine[0]) | (j != mine[1])), near, found)

    def _earliest(self, times: np.ndarray, window: Window) -> np.ndarray:
        """The earliest arrival among the centres in each cell of the grid."""
        found = np.full(window.grid, np.inf)
        rows, columns = np.nonzero(np.isfinite(times))
        i, j = window.cells(*self._plane(rows, columns))
        inside = within(i, j, window.grid)
        places = i[inside], j[inside]
        np.minimum.at(found, places, times[rows[inside], columns[inside]])
        return found

    def _at(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """The times of cells; inf outside the raster."""
        height, width = self.times.shape
        near = self.times[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
        return np.where(within(row, column, self.times.shape), near, np.inf)

    def _side(self) -> float:
        """The shorter side of the cell in the middle, on the plane."""
        row, column = (count // 2 for count in self.times.shape)
        x, y = self._plane(np.array([row, row + 1, row]), np.array([column, column, column + 1]))
        return float(min(np.hypot(x[k] - x[0], y[k] - y[0]) for k in (1, 2)))

    def _between(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """Bilinear among burnt cells; never where the cell that a point lies in never burns."""
        height, width = self.times.shape
        own = self._at(np.rint(row).astype(np.int64), np.rint(column).astype(np.int64))
        total, weights = np.zeros(row.shape), np.zeros(row.shape)
        r0, c0 = np.floor(row).astype(np.int64), np.floor(column).astype(np.int64)
        for dr in (0, 1):
            for dc in (0, 1):
                r, c = np.clip(r0 + dr, 0, height - 1), np.clip(c0 + dc, 0, width - 1)
                time = self.times[r, c]
                weight = (1 - np.abs(row - r0 - dr)) * (1 - np.abs(column - c0 - dc))
                weight = np.where(np.isfinite(time), weight, 0)
                total += weight * np.where(np.isfinite(time), time, 0)
                weights += weight
        between = np.maximum(total / np.where(weights > 0, weights, 1), self.first)
        return np.where(np.isinf(own) | (weights == 0), own, between)

    def _plane(self, row: np.ndarray, column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where cells' centres are on the plane; parts of a cell are allowed."""
        a, b, c, d, e, f = self._affine
        u, v = column + 0.5, row + 0.5
        return self._moves[0](a * u + b * v + c, d * u + e * v + f)

    def _cell(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The inverse of `_plane`."""
        a, b, c, d, e, f = self._affine
        x, y = self._moves[1](x, y)
        x, y, area = x - c, y - f, a * e - b * d
        row, column = (a * y - d * x) / area - 0.5, (e * x - b * y) / area - 0.5
        # What cannot be projected lies outside.
        row, column = (np.clip(np.nan_to_num(at, nan=-9e9), -9e9, 9e9) for at in (row, column))
        return row, column

    def _around(self, rows: np.ndarray, columns: np.ndarray) -> Bounds:
        """Bounds of cells, whole."""
        x, y = self._plane(
            np.concatenate([rows - 0.5, rows - 0.5, rows + 0.5, rows + 0.5]),
            np.concatenate([columns - 0.5, columns + 0.5, columns - 0.5, columns + 0.5]),
        )
        return float(x.min()), float(y.min()), float(x.max()), float(y.max())


def _first(times: np.ndarray, until: float) -> np.ndarray:
    """Where on each line of cells what has burnt begins, cells from the first one's centre.

    Beyond the last cell that has a time the front goes on as fast as it came, if it would not have
    reached the next one; else it ends with the cell.
    """
    lines, count = np.arange(len(times)), times.shape[1]
    at = (times <= until).argmax(1)
    inner, outer = times[lines, at], times[lines, np.maximum(at - 1, 0)]
    before = times[lines, np.minimum(at + 1, count - 1)]
    goes_on = (at > 0) & np.isfinite(outer)
    step = np.where(goes_on, outer - inner, inner - before)
    left = np.where(step > 0, until - inner, 0.5) / np.where(step > 0, step, 1.0)
    return at - np.where(goes_on | (left < 1), left, 0.5)
