"""Makes a fire of perimeters over time, and interpolates the front between them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import distance_transform_edt

from emberlink.envs.fire_files.config import Clock, FileFireConfig
from emberlink.envs.fire_files.perimeters.areas import area_at_zero, enclosed, make_valid, polygons
from emberlink.envs.fire_files.perimeters.tables import read_table
from emberlink.envs.fire_files.perimeters.times import perimeter_times
from emberlink.envs.fire_files.projection import Bounds, library, projections
from emberlink.envs.fire_files.raster_source import Window
from emberlink.envs.utils.errors import UserError

MAX_TIMES = 500
_SHRUNK = 0.75  # minimum share of the burnt area that a perimeter inside it has
_INSIDE = 0.99  # share of a perimeter inside the burnt area, from which it counts as inside


def read_perimeters(path: Path, config: FileFireConfig) -> "PerimeterSource":
    """Reads perimeters with the time of each, as a fire.

    Args:
        path: a file, or a folder of files of one fire, such as GeoMAC's file per date.
        config: the scenario.

    Raises:
        UserError: a file, a feature or a column is wrong.
    """
    frame = read_table(path, config)
    times, clock = perimeter_times(frame, config.time_field, config.units)
    distinct = np.unique(times)
    if len(distinct) > MAX_TIMES:
        raise UserError(f"{len(distinct)} times; at most {MAX_TIMES} are read")
    areas: list[Any] = []
    for time in distinct:
        part = frame[times == time]
        areas.append(enclosed(part.geometry.tolist(), part.index.tolist()))
    return PerimeterSource(_project(frame, areas, config.crs), distinct, clock)


def _project(frame: Any, areas: Sequence[Any], crs: str | None) -> list[Any]:
    """Projects areas onto a plane."""
    x0, y0, x1, y1 = (float(value) for value in frame.total_bounds)
    chosen = projections(frame.crs, crs, (x0, y0, x1, y1), None)
    if chosen is None:
        return list(areas)
    projected = library("geopandas").GeoSeries(areas, crs=chosen[0]).to_crs(chosen[1])
    if not np.isfinite(projected.total_bounds).all():
        raise UserError(
            f"coordinates from {x0, y0} to {x1, y1} cannot be projected from {chosen[0].name} to "
            f"{chosen[1].name}; expected another fire.crs"
        )
    return [make_valid(area) for area in projected]


class PerimeterSource:
    """A fire whose burnt area is known at some times. The front is interpolated between them.

    Args:
        areas: shapely polygons on a plane, one for each time.
        times: float64, ascending.
        clock: unit of the times.

    Raises:
        UserError: there are fewer than two times, or the areas shrink.
    """

    whole = False

    def __init__(self, areas: Sequence[Any], times: np.ndarray, clock: Clock):
        if len(times) < 2:
            raise UserError(
                f"one perimeter, of {clock.format(times[0])}; expected two times or more"
            )
        self.clock, self.first, self.last = clock, float(times[0]), float(times[-1])
        span = f"{clock.format(self.first)} to {clock.format(self.last)}"
        self.summary = f"perimeters of {len(times)} times, from {span}"
        self.doubts: Sequence[str] = ()
        if clock.origin is None and self.first > self.last - self.first:
            self.doubts = [
                f"the fire would begin at time 0 (fire.start={self.first:g}: at the first)"
            ]
        _check_growth(areas, times, clock)
        if clock.origin is None and times[0] > 0:
            areas, times = [area_at_zero(areas, times), *areas], np.concatenate([[0.0], times])
        self._areas, self._times, self.began = areas, times, float(times[0])
        boxes = np.array([area.bounds for area in areas])
        low, high = np.minimum.accumulate(boxes[:, :2]), np.maximum.accumulate(boxes[:, 2:])
        self._boxes = np.concatenate([low, high], axis=1)
        self.extent = self.burnt(self.last)

    def burnt(self, until: float) -> Bounds:
        """Returns the bounds of the area burnt by a time, interpolated between perimeters."""
        x0, y0, x1, y1 = (float(np.interp(until, self._times, edge)) for edge in self._boxes.T)
        return x0, y0, x1, y1

    def on(self, window: Window, until: float) -> np.ndarray:
        """Returns the earliest arrival in each cell of a grid, float64 [X, Y]."""
        count = int(min(np.searchsorted(self._times, until), len(self._times) - 1)) + 1
        # The window must contain all of the last front, to which distances are computed.
        x0, y0, x1, y1 = self._boxes[count - 1]
        right = window.x + window.grid[0] * window.side
        upper = window.y + window.grid[1] * window.side
        outside = max(window.x - x0, x1 - right), max(window.y - y0, y1 - upper)
        across, along = (
            window.cuts * min(int(np.ceil(max(past, 0) / window.side)) + 1, 2 * cells)
            for past, cells in zip(outside, window.grid, strict=True)
        )
        times = self._interpolate(window.samples((across, along)), count)
        return window.earliest(times[across:-across, along:-along])

    def _interpolate(self, window: Window, count: int) -> np.ndarray:
        """Returns the arrival times of the first perimeters at the centres of a window's cells.

        Times between two fronts are interpolated by the distances to both.
        """
        before = _rasterize(self._areas[0], window)
        times = np.where(before, self._times[0], np.inf)
        for k in range(1, count):
            after = before | _rasterize(self._areas[k], window)
            new = after & ~before
            if new.any() and before.any():
                from_last, to_next = _depth(~before), _depth(after)
                if not window.contains(self._areas[k].bounds):
                    to_next[new] = _to_boundary(self._areas[k], window, new)
                share = from_last / (from_last + to_next)
                between = self._times[k - 1] + (self._times[k] - self._times[k - 1]) * share
                times[new] = between[new]
            times[new & np.isinf(times)] = self._times[k]  # the first front lies outside
            before = after
        return times


def _check_growth(areas: Sequence[Any], times: np.ndarray, clock: Clock) -> None:
    """Checks that areas do not shrink, as they do if times go backwards or fires are mixed."""
    shapely = library("shapely")
    burnt, united, largest = areas[0], 1, areas[0].area
    for k in range(1, len(areas)):
        area = areas[k]
        largest = max(largest, area.area)
        if area.area >= _SHRUNK * max(largest, burnt.area):
            continue
        burnt, united = shapely.union_all([burnt, *areas[united:k]]), k
        inside = area.intersection(burnt).area >= _INSIDE * area.area
        if inside and area.area < _SHRUNK * burnt.area:
            raise UserError(
                f"the perimeter of {clock.format(times[k])} lies inside the area burnt before and "
                f"is {100 * area.area / burnt.area:.0f} % of it: times go backwards; expected "
                "areas that grow"
            )


def _depth(area: np.ndarray) -> np.ndarray:
    """Returns the distance from each cell's centre to the edge of the area, in cells."""
    distance: Any = distance_transform_edt(area)
    return distance - 0.5


def _to_boundary(area: Any, window: Window, cells: np.ndarray) -> np.ndarray:
    """Returns the distance from the centres of cells to the boundary of an area, in cells."""
    shapely = library("shapely")
    x, y = np.meshgrid(*window.centres(), indexing="ij")
    boundary = area.boundary
    shapely.prepare(boundary)
    return shapely.distance(boundary, shapely.points(x[cells], y[cells])) / window.side


def _rasterize(area: Any, window: Window) -> np.ndarray:
    """Returns the mask of cells whose centre lies in an area, bool [X, Y].

    A polygon that covers no centre gets the cell of a point inside it, so that it is not lost.
    """
    features = library("rasterio.features")
    shapely = library("shapely")
    affine = library("rasterio.transform").from_origin(
        window.x, window.y + window.grid[1] * window.side, window.side, window.side
    )
    about = {"out_shape": window.grid[::-1], "transform": affine, "dtype": "uint8"}
    inside = features.rasterize([area], **about)[::-1].T.astype(bool)
    i, j = window.cells(*shapely.get_coordinates(shapely.point_on_surface(polygons(area))).T)
    there = (i >= 0) & (j >= 0) & (i < window.grid[0]) & (j < window.grid[1])
    inside[i[there], j[there]] = True
    return inside
