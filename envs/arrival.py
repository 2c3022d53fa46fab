"""Arrival times on a source's own cells, and how they come onto a grid."""

from dataclasses import dataclass, replace
from datetime import datetime
from typing import Literal, Protocol

import numpy as np
from scipy.ndimage import minimum_filter

from .geo import Bounds, Move, same

Units = Literal["steps", "seconds", "minutes", "hours", "days"]
SECONDS = {"seconds": 1.0, "minutes": 60.0, "hours": 3600.0, "days": 86400.0}
_EDGE = 1e-6  # cells: a centre that lies on an edge belongs to the same side whatever is rounded


@dataclass(frozen=True)
class Clock:
    """What the numbers of a source mean."""

    unit: Units
    origin: datetime | None = None
    """calendar time of 0"""

    def shown(self, time: float) -> str:
        """A time in a message."""
        if self.origin is None:
            return f"{time:g} {self.unit}"
        seconds = self.origin.timestamp() + time * SECONDS[self.unit]
        return datetime.fromtimestamp(seconds, self.origin.tzinfo).isoformat(timespec="minutes")


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

    def cells(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Which cell each point lies in; it may be outside the grid."""
        i, j = ((at - start) / self.side for at, start in ((x, self.x), (y, self.y)))
        return np.floor(i + _EDGE).astype(np.int64), np.floor(j + _EDGE).astype(np.int64)


class Source(Protocol):
    """A fire as a file has it."""

    clock: Clock
    first: float
    """earliest arrival"""
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
        rows, columns = (np.arange(count) for count in times.shape)
        edge_rows = np.concatenate([rows, rows, 0 * columns, 0 * columns + len(rows) - 1])
        edge_columns = np.concatenate([0 * rows, 0 * rows + len(columns) - 1, columns, columns])
        self.extent = self._around(edge_rows, edge_columns)

    def burnt(self, until: float) -> Bounds:
        """What the cells burnt by a time cover."""
        burnt = self.times <= until
        rows, columns = np.flatnonzero(burnt.any(1)), np.flatnonzero(burnt.any(0))
        left, right = burnt[rows].argmax(1), burnt.shape[1] - 1 - burnt[rows, ::-1].argmax(1)
        top = burnt[:, columns].argmax(0)
        low = burnt.shape[0] - 1 - burnt[::-1, columns].argmax(0)
        return self._around(
            np.concatenate([rows, rows, top, low]),
            np.concatenate([left, right, columns, columns]),
        )

    def on(self, window: Window, until: float) -> np.ndarray:
        """The earliest arrival among the cells whose centre lies in a cell of the grid.

        Where no centre does, and everywhere on a grid finer than the raster: that of the grid
        cell's centre, between the burnt cells around it; a cell that burns before those around it
        does so as a whole.
        """
        row, column = self._cell(*window.centres())
        if window.side < (1 - _EDGE) * self._side():
            return self._between(row, column)
        found = self._earliest(window)
        nearest = np.rint(row).astype(np.int64), np.rint(column).astype(np.int64)
        i, j = window.cells(*self._plane(*nearest))
        mine = np.indices(window.grid)
        empty = np.isinf(found) & ((i != mine[0]) | (j != mine[1]))
        found[empty] = self._between(row[empty], column[empty])
        return found

    def _earliest(self, window: Window) -> np.ndarray:
        """The earliest arrival among the centres in each cell of the grid."""
        found = np.full(window.grid, np.inf)
        rows, columns = np.nonzero(np.isfinite(self.times))
        i, j = window.cells(*self._plane(rows, columns))
        inside = (i >= 0) & (j >= 0) & (i < window.grid[0]) & (j < window.grid[1])
        places = i[inside], j[inside]
        np.minimum.at(found, places, self.times[rows[inside], columns[inside]])
        return found

    def _side(self) -> float:
        """The shorter side of the cell in the middle, on the plane."""
        row, column = (count // 2 for count in self.times.shape)
        x, y = self._plane(np.array([row, row + 1, row]), np.array([column, column, column + 1]))
        return float(min(np.hypot(x[k] - x[0], y[k] - y[0]) for k in (1, 2)))

    def _between(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """Bilinear among burnt cells; never where the cell that a point lies in never burns."""
        height, width = self.times.shape
        near = np.rint(row).astype(np.int64), np.rint(column).astype(np.int64)
        inside = (near[0] >= 0) & (near[1] >= 0) & (near[0] < height) & (near[1] < width)
        r, c = np.clip(near[0], 0, height - 1), np.clip(near[1], 0, width - 1)
        own = np.where(inside, self.times[r, c], np.inf)
        first = own == minimum_filter(self.times, 3)[r, c]
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
        between = total / np.where(weights > 0, weights, 1)
        return np.where(first | np.isinf(own) | (weights == 0), own, between)

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
