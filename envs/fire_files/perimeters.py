"""Makes a fire of perimeters over time, and interpolates the front between them."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.ndimage import binary_dilation, distance_transform_edt, label

from emberlink.envs.fire_files.areas import MANY, area_at_zero, enclosed, make_valid, polygons
from emberlink.envs.fire_files.config import Clock, FileFireConfig
from emberlink.envs.fire_files.features import choose_features
from emberlink.envs.fire_files.files import library
from emberlink.envs.fire_files.grid import Bounds, Window, far_apart, number
from emberlink.envs.fire_files.projection import Plane, choose_plane
from emberlink.envs.fire_files.times import read_times
from emberlink.envs.utils.errors import UserError

_MAX_TIMES = 500
_MAX_PARTS = 1000  # the largest, among which groups are looked for
_AROUND = np.ones((3, 3))


def read_perimeters(frame: Any, outside: Sequence[str], config: FileFireConfig) -> "Perimeters":
    """Makes a fire of a table of features; the values of columns `outside` stand beside it."""
    count, facts = len(frame), []
    frame = frame[~(frame.geometry.isna() | frame.geometry.is_empty)]
    if len(frame) < count:
        facts.append(f"{count - len(frame)} without a geometry left out")
    points = frame.geom_type.isin(("Point", "MultiPoint"))
    if config.radius is None and points.any():
        if points.all():
            raise UserError(
                f"{len(frame)} points, as of satellite detections; expected fire.radius, metres of "
                "the circle around each, such as fire.radius=375 for VIIRS"
            )
        facts.append(f"{points.sum()} points left out")
        frame = frame[~points]
    if len(frame) == 0:
        raise UserError("no feature with a geometry; expected perimeters")
    frame = choose_features(frame, config, facts)
    times = read_times(frame, config, outside)
    x0, y0, x1, y1 = (float(value) for value in frame.total_bounds)
    plane = choose_plane(frame.crs, config.crs, (x0, y0, x1, y1), None)
    if config.radius is not None:
        frame, plane = _with_circles(frame, plane, config.radius)
    distinct, sizes = np.unique(times.values, return_counts=True)
    if not 2 <= len(distinct) <= _MAX_TIMES:
        raise UserError(
            f"{len(distinct)} times in {times.column}, {times.clock.format(distinct[0])}...; "
            f"expected 2 to {_MAX_TIMES}"
        )
    shapes, names = frame.geometry.to_numpy(), frame.index.to_numpy()
    areas = [enclosed(shapes[now], names[now]) for now in (times.values == t for t in distinct)]
    source = Perimeters(_project(areas, plane), distinct, times.clock)
    each = f"{sizes.min()} to {sizes.max()}" if sizes.min() < sizes.max() else f"{sizes[0]}"
    source.facts = [
        f"perimeters of {len(distinct)} times, from {source.span}",
        f"{len(frame)} of {count} features used" + (f" ({'; '.join(facts)})" if facts else ""),
        f"{each} per time",
        *times.facts,
        plane.about,
    ]
    source.doubts = [*times.doubts, *source.doubts]
    return source


def _with_circles(frame: Any, plane: Plane, radius: float) -> tuple[Any, Plane]:
    """Returns features on the plane, with a circle for each point, and that plane."""
    if plane.unit is None:
        raise UserError("fire.radius: the unit of the coordinates is not known; expected fire.crs")
    if plane.change is not None:
        frame = frame.set_crs(plane.change[0], allow_override=True).to_crs(plane.change[1])
    points = frame.geom_type.isin(("Point", "MultiPoint"))
    circles = frame.geometry.where(~points, frame.geometry.buffer(radius / plane.unit))
    return frame.set_geometry(circles), Plane(plane.about, None, plane.unit)


def _project(areas: Sequence[Any], plane: Plane) -> list[Any]:
    """Returns areas on the plane."""
    if plane.change is None:
        return list(areas)
    source, target = plane.change
    projected = library("geopandas").GeoSeries(areas, crs=source).to_crs(target)
    if not np.isfinite(projected.total_bounds).all():
        raise UserError(f"perimeters outside {target.name}; expected another fire.crs")
    return [area if len(polygons(area)) > MANY else make_valid(area) for area in projected]


class Perimeters:
    """A fire whose burnt area is known at some times; the front is interpolated between them.

    A fire only grows: the area burnt by a time is the union of the perimeters until then.
    """

    whole = False

    def __init__(self, areas: Sequence[Any], times: np.ndarray, clock: Clock):
        self.clock, self.first, self.last = clock, float(times[0]), float(times[-1])
        self.span = f"{clock.format(self.first)} to {clock.format(self.last)}"
        self.facts: list[str] = []
        self.doubts: list[str] = []
        if clock.origin is None and self.first > self.last - self.first:
            self.doubts = [f"it begins at time 0 (fire.start={self.first:g}: at the first)"]
        parts = sorted((part for area in areas for part in polygons(area)), key=lambda p: -p.area)
        self.doubts += far_apart(np.array([part.bounds for part in parts[:_MAX_PARTS]]))
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
        """Returns arrival times at the centres of a window's cells, by the distances to fronts."""
        before = _rasterize(self._areas[0], window)
        begun, idle = int(label(before, _AROUND)[1]), 0  # pyright: ignore
        times = np.where(before, self._times[0], np.inf)
        for k in range(1, count):
            after = before | _rasterize(self._areas[k], window)
            new = after & ~before
            parts: Any = label(new, _AROUND)
            beside: Any = binary_dilation(before, _AROUND)
            reached = np.unique(parts[0][new & beside])
            begun, idle = begun + parts[1] - len(reached), idle + (not new.any())
            if new.any() and before.any():
                from_last, to_next = _depth(~before), _depth(after)
                if not window.contains(self._areas[k].bounds):
                    to_next[new] = _to_boundary(self._areas[k], window, new)
                share = from_last / (from_last + to_next)
                between = self._times[k - 1] + (self._times[k] - self._times[k - 1]) * share
                times[new] = between[new]
            times[new & np.isinf(times)] = self._times[k]  # the first front lies outside
            before = after
        self.facts.append(f"beginning at {number(begun, 'place')}")
        if idle:
            self.facts.append(f"{number(idle, 'perimeter')} within the area burnt before add none")
        return times


def _depth(area: np.ndarray) -> np.ndarray:
    """Returns the distance from each cell's centre to the edge of the area, in cells."""
    distance: Any = distance_transform_edt(area)
    return distance - 0.5


def _to_boundary(area: Any, window: Window, cells: np.ndarray) -> np.ndarray:
    """Returns the distance from the centres of cells to the boundary of an area, in cells."""
    shapely = library("shapely")
    x, y = window.centres()
    boundary = make_valid(area).boundary
    shapely.prepare(boundary)
    return shapely.distance(boundary, shapely.points(x[cells], y[cells])) / window.side


def _rasterize(area: Any, window: Window) -> np.ndarray:
    """Returns the mask of cells centred in an area, at least one per part, bool [X, Y]."""
    shapely, parts = library("shapely"), polygons(area)
    if len(parts) > MANY:  # they may overlap
        inside = np.zeros(window.grid, bool)
        inside.flat[window.tree().query(parts, predicate="intersects")[1]] = True
    else:
        affine = library("rasterio.transform").from_origin(
            window.x, window.y + window.grid[1] * window.side, window.side, window.side
        )
        about = {"out_shape": window.grid[::-1], "transform": affine, "dtype": "uint8"}
        inside = library("rasterio.features").rasterize([area], **about)[::-1].T.astype(bool)
    i, j = window.cells(*shapely.get_coordinates(shapely.point_on_surface(parts)).T)
    there = (i >= 0) & (j >= 0) & (i < window.grid[0]) & (j < window.grid[1])
    inside[i[there], j[there]] = True
    return inside
