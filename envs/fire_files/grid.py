"""The grid laid over a fire, and rasters of arrival times sampled at its cells."""

import functools
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from scipy.ndimage import label, map_coordinates, minimum_filter
from scipy.sparse.csgraph import connected_components

from emberlink.envs.fire_files.config import Clock
from emberlink.envs.fire_files.files import library
from emberlink.envs.utils.errors import UserError

Bounds = tuple[float, float, float, float]
"""Minimum x, minimum y, maximum x, maximum y."""
SAMPLES = 180
"""Sample points along the grid's shorter side. A cell of the grid gets the earliest of its samples.
Rasters and perimeters are sampled at the same points."""
_EDGE = 1e-6  # cells: tolerance, so that rounding does not move a centre across an edge


@dataclass(frozen=True)
class Window:
    """A part of the plane that a grid covers with square cells."""

    x: float
    """coordinate of the left edge"""
    y: float
    """coordinate of the lower edge"""
    side: float
    """side of a cell"""
    grid: tuple[int, int]

    @classmethod
    def around(cls, bounds: Bounds, grid: tuple[int, int], margin: float) -> "Window":
        """Returns the smallest window with a margin, a part of the grid, around `bounds`."""
        width, height = bounds[2] - bounds[0], bounds[3] - bounds[1]
        side = max(width / grid[0], height / grid[1]) / (1 - 2 * margin)
        x, y = (bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2
        return cls(x - side * grid[0] / 2, y - side * grid[1] / 2, side, grid)

    @property
    def cuts(self) -> int:
        """Sample points along each side of a cell."""
        return max(1, round(SAMPLES / min(self.grid)))

    def samples(self, border: tuple[int, int] = (0, 0)) -> "Window":
        """Returns the window of the sample points: cuts x cuts per cell, and a border of points."""
        side, (columns, rows) = self.side / self.cuts, self.grid
        grid = columns * self.cuts + 2 * border[0], rows * self.cuts + 2 * border[1]
        x, y = self.x - border[0] * side, self.y - border[1] * side
        return replace(self, x=x, y=y, side=side, grid=grid)

    def contains(self, bounds: Bounds) -> bool:
        """Returns whether all of an area with some bounds is within the window."""
        right, upper = self.x + self.grid[0] * self.side, self.y + self.grid[1] * self.side
        x0, y0, x1, y1 = bounds
        return self.x <= x0 and self.y <= y0 and x1 <= right and y1 <= upper

    def axes(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns x [X] and y [Y] of the cells' centres."""
        columns, rows = (np.arange(count) + 0.5 for count in self.grid)
        return self.x + columns * self.side, self.y + rows * self.side

    def centres(self) -> Any:
        """Returns x and y of each cell's centre, [X, Y]."""
        return np.meshgrid(*self.axes(), indexing="ij")

    @functools.cache  # noqa: B019
    def tree(self) -> Any:
        """Returns a tree of the cells' centres, in C order."""
        shapely = library("shapely")
        return shapely.STRtree(shapely.points(*(at.ravel() for at in self.centres())))

    def earliest(self, samples: np.ndarray) -> np.ndarray:
        """Returns the minimum in each cell, [X, Y], of samples [X cuts, Y cuts]."""
        columns, rows = self.grid
        return samples.reshape(columns, self.cuts, rows, self.cuts).min((1, 3))

    def cells(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the indices of the cells in which points lie; they may lie outside the grid."""
        i, j = (x - self.x) / self.side, (y - self.y) / self.side
        return np.floor(i + _EDGE).astype(np.int64), np.floor(j + _EDGE).astype(np.int64)


class Source(Protocol):
    """A fire read from a file, on a plane."""

    clock: Clock
    began: float
    """time of ignition; the first arrival where it is unknown"""
    first: float
    """earliest arrival in the file"""
    last: float
    """latest arrival in the file"""
    extent: Bounds
    whole: bool
    """True for a map of the whole grid, which is neither cropped nor burnt out"""
    facts: list[str]
    """findings about the file, for the user"""
    doubts: list[str]
    """signs of a misreading, for the user"""

    def burnt(self, until: float) -> Bounds:
        """Returns the bounds of the area burnt by a time."""
        ...

    def on(self, window: Window, until: float) -> np.ndarray:
        """Returns arrival times, float64 [X, Y], inf for never. Times after `until` may be late."""
        ...


@dataclass
class Raster:
    """Samples arrival times on a raster whose rows run from north to south."""

    times: np.ndarray
    """float64 [rows, columns], inf for never"""
    corner: tuple[float, float]
    """x and y of the upper left corner of the raster"""
    cell: tuple[float, float]
    """width and height of a cell"""
    clock: Clock
    whole: bool = False
    facts: list[str] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.times = self.times.astype(np.float64)
        rows, columns = self.times.shape
        (x, y), (width, height) = self.corner, self.cell
        self.extent: Bounds = x, y - rows * height, x + columns * width, y
        burning = self.times[np.isfinite(self.times)]
        self.first, self.last = float(burning.min()), float(burning.max())
        self.began = self.first

    def burnt(self, until: float) -> Bounds:
        """Returns the bounds of the area burnt by a time: to the front, or to edges of cells."""
        times = self.times
        if (times <= until).sum() < 2:
            raise UserError(
                f"until {self.clock.format(until)} a single cell burns: no fire spreads"
            )
        rows, columns = times.shape
        left, right = _front(times, until), columns - _front(times[:, ::-1], until)
        top, bottom = _front(times.T, until), rows - _front(times.T[:, ::-1], until)
        (x, y), (width, height) = self.corner, self.cell
        return x + left * width, y - bottom * height, x + right * width, y - top * height

    def on(self, window: Window, until: float) -> np.ndarray:
        """Returns the earliest arrival in each cell of a grid.

        Candidates are the bilinear sample points in the cell and the centres of the raster's cells
        (on a finer grid, only centres that burn before all their neighbours). A map of the whole
        grid, and a raster with the grid's cells, are not interpolated.
        """
        fine = window.side < (1 - _EDGE) * min(self.cell)
        if self.whole or self._is_aligned(window):
            near = self._at(*(np.rint(at).astype(np.int64) for at in self._indices(window)))
            if fine:
                return near
            without = np.isinf(self._earliest(np.zeros_like(self.times), window))
            return np.where(without, near, self._earliest(self.times, window))
        samples = window.earliest(self._interpolate(*self._indices(window.samples())))
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
        i, j = window.cells(x + (columns + 0.5) * width, y - (rows + 0.5) * height)
        inside = (i >= 0) & (j >= 0) & (i < window.grid[0]) & (j < window.grid[1])
        np.minimum.at(earliest, (i[inside], j[inside]), times[rows[inside], columns[inside]])
        return earliest

    def _at(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Returns the times of rows [Y] and columns [X], [X, Y]; inf outside the raster."""
        height, width = self.times.shape
        times = self.times[np.ix_(np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1))].T
        times[:, (rows < 0) | (rows >= height)] = np.inf
        times[(columns < 0) | (columns >= width)] = np.inf
        return times

    def _interpolate(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Interpolates bilinearly between burnt cells, [X, Y]; inf in a cell that never burns."""
        inside = self._at(np.rint(rows).astype(np.int64), np.rint(columns).astype(np.int64))
        burns = np.isfinite(self.times)
        at = np.meshgrid(rows, columns)
        weights = map_coordinates(burns.astype(np.float64), at, order=1, mode="nearest")
        total = map_coordinates(np.where(burns, self.times, 0), at, order=1, mode="nearest")
        times = np.maximum(total / np.where(weights > 0, weights, 1), self.first)
        return np.where(np.isinf(inside) | (weights == 0), inside, times)


def beginnings(times: np.ndarray) -> int:
    """Returns the number of places that burn before all cells around them."""
    burns, earliest = np.isfinite(times), times == minimum_filter(times, 3)
    # Of cells that burn at the same time, one may have an earlier neighbour: no beginning.
    later = minimum_filter(np.where(burns & ~earliest, times, np.inf), 3) == times
    places: Any = label(burns & earliest, np.ones((3, 3)))
    return int(places[1] - len(np.unique(places[0][burns & earliest & later])))


def far_apart(boxes: np.ndarray) -> list[str]:
    """Returns whether parts with some boxes, [parts, 4], lie farther apart than they are long."""
    size, longest, between = len(boxes) + 1, 0.0, np.zeros(1)
    while len(boxes) < size:
        size, low, high = len(boxes), boxes[:, :2], boxes[:, 2:]
        longest = (high - low).max()
        between = np.maximum(low[:, None] - high[None], low[None] - high[:, None]).max(2)
        count, of = connected_components(between <= 1.5 * longest)
        groups = [boxes[of == k] for k in range(count)]
        boxes = np.array([[*g[:, :2].min(0), *g[:, 2:].max(0)] for g in groups])
    if size == 1:
        return []
    gap = between.max()
    return [f"{size} groups of parts never join and lie {gap:g} apart, {longest:g} long: one fire?"]


def number(count: int, noun: str) -> str:
    """Returns a count with its noun, such as `2 places`."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


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
