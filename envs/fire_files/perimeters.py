"""Perimeters over time: shapefile, GeoJSON, GeoPackage."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import distance_transform_edt

from emberlink.envs.utils.errors import UserError

from .arrival_raster import Clock, Units, Window, within
from .perimeter_polygons import enclosed, ignition, polygons
from .perimeter_times import perimeter_times
from .projection import Bounds, check_projection, first_line, library, to_plane

MOST_TIMES = 500
_SURVEY = 256  # cells along the longer side where only the extent is asked for
_WITHIN, _SHRUNK = 0.99, 0.75  # see `_check_order`


def read_perimeters(
    path: Path,
    unit: Units | None,
    crs: str | None,
    time_field: str | None = None,
    layer: str | None = None,
) -> "PerimeterSource":
    """Perimeters with the time of each, as a fire.

    Args:
        path: a .shp, .geojson or .gpkg.
        unit: of elapsed times.
        crs: `fire.crs`.
        time_field: column of the times; None to look for one that is known.
        layer: of a GeoPackage that has several.

    Raises:
        ValueError: one line that names the feature or column that is wrong.
    """
    pyogrio = library("pyogrio", "perimeters")
    library("geopandas", "perimeters")
    json = path.suffix.lower() in (".geojson", ".json")
    # As text: of dates in GeoJSON, GDAL loses some zones where not all are the same.
    options = {"DATE_AS_STRING": "YES"} if json else {}
    try:
        layer = _layer(pyogrio, path, layer)
        frame = pyogrio.read_dataframe(
            path.absolute(), layer=layer, datetime_as_string=True, **options
        )
    except ValueError:
        raise
    except Exception as error:  # of GDAL, of text that is none, of geometries that are none
        if isinstance(error, pyogrio.errors.CRSError):
            check_projection(path, None)
        raise UserError(f"{first_line(error)}; expected perimeters") from None
    if not hasattr(frame, "geometry") or len(frame) == 0:
        raise UserError("no feature with a geometry; expected perimeters")
    missing = np.flatnonzero((frame.geometry.isna() | frame.geometry.is_empty).to_numpy())
    if len(missing):
        raise UserError(f"feature {missing[0]} has no geometry; expected a perimeter in each")
    if not json:
        check_projection(path, frame.crs)
    times = perimeter_times(frame, time_field, unit)
    source_crs = frame.crs
    x0, y0, x1, y1 = (float(value) for value in frame.total_bounds)
    bounds = x0, y0, x1, y1
    if json and source_crs is not None and source_crs.is_geographic and _too_large(bounds):
        source_crs = None  # GeoJSON that names no projection is taken for degrees
    project, _ = to_plane(source_crs, crs, bounds, None)
    moments = np.unique(times.values)
    if len(moments) > MOST_TIMES:
        raise UserError(f"{len(moments)} times; at most {MOST_TIMES} are read")
    shapely = library("shapely", "perimeters")
    areas: list[Any] = []
    for moment in moments:
        which = np.flatnonzero(times.values == moment).tolist()
        area = enclosed(frame.geometry.iloc[which], which)
        area = shapely.transform(area, lambda at: np.stack(project(at[:, 0], at[:, 1]), 1))
        areas.append(_valid(shapely, area))
    return PerimeterSource(areas, moments, times.clock)


def _layer(pyogrio: Any, path: Path, wanted: str | None) -> str:
    """The layer to read: the one named, or the only one with geometries."""
    layers = [str(name) for name, kind in pyogrio.list_layers(path.absolute()) if kind is not None]
    if wanted is None and len(layers) == 1:
        return layers[0]
    if wanted in layers:
        return str(wanted)
    listed = ", ".join(layers[:30])
    if not layers:
        raise UserError("no layer has geometries; expected perimeters")
    if wanted is None:
        raise UserError(f"{len(layers)} layers; expected fire.layer, one of {listed}")
    raise UserError(f"no layer {wanted!r} (fire.layer); there are {listed}")


def _too_large(bounds: Bounds) -> bool:
    return max(map(abs, bounds)) > 360


class PerimeterSource:
    """A fire of which the burnt area is known at some times; between them fronts are interpolated.

    Perimeters that were observed do not contain each other: what burnt once stays burnt. Of elapsed
    times, the fire before the first perimeter is taken back to 0: the edges of the box around it
    moved as fast as from the first to the second, from a point at most.

    Args:
        areas: shapely's, on the plane, one for each time.
        times: float64, ascending.
        clock: of the times.
    """

    whole = False

    def __init__(self, areas: Sequence[Any], times: np.ndarray, clock: Clock):
        if len(times) < 2:
            raise UserError(
                f"one perimeter, of {clock.shown(times[0])}; expected two times or more"
            )
        self.clock, self.first, self.last = clock, float(times[0]), float(times[-1])
        if clock.origin is None and times[0] > 0:
            areas, times = [_began(areas, times), *areas], np.concatenate([[0.0], times])
        self._areas, self._times, self.began = areas, times, float(times[0])
        boxes = np.array([area.bounds for area in areas])
        low, high = np.minimum.accumulate(boxes[:, :2]), np.maximum.accumulate(boxes[:, 2:])
        self._boxes = np.concatenate([low, high], axis=1)
        x0, y0, x1, y1 = (float(value) for value in self._boxes[-1])
        self.extent = x0, y0, x1, y1
        side = max(x1 - x0, y1 - y0) / _SURVEY
        counts = int(np.ceil((x1 - x0) / side)), int(np.ceil((y1 - y0) / side))
        self._window = Window(x0, y0, side, counts).finer(1, (1, 1))
        self._check_order()
        self._survey = self._interpolated(self._window, len(times))

    def burnt(self, until: float) -> Bounds:
        """What the area burnt by a time covers."""
        if until >= self.last:
            return self.extent
        burnt = self._survey <= until
        i, j = np.flatnonzero(burnt.any(1)), np.flatnonzero(burnt.any(0))
        at = self._window
        return (
            float(at.x + i[0] * at.side),
            float(at.y + j[0] * at.side),
            float(at.x + (i[-1] + 1) * at.side),
            float(at.y + (j[-1] + 1) * at.side),
        )

    def on(self, window: Window, until: float) -> np.ndarray:
        """The earliest arrival within each cell of a grid."""
        count = int(min(np.searchsorted(self._times, until), len(self._times) - 1)) + 1
        # All of the last front that is looked at, as the distance to it is needed.
        x0, y0, x1, y1 = self._boxes[count - 1]
        right = window.x + window.grid[0] * window.side
        upper = window.y + window.grid[1] * window.side
        beyond = max(window.x - x0, x1 - right), max(window.y - y0, y1 - upper)
        cuts = window.cuts
        around: list[int] = []
        for past, cells in zip(beyond, window.grid, strict=True):
            needed = int(np.ceil(max(past, 0) / window.side)) + 1
            around.append(cuts * min(needed, 2 * cells))
        fine = window.finer(cuts, (around[0], around[1]))
        inner = self._interpolated(fine, count)[around[0] : -around[0], around[1] : -around[1]]
        return window.earliest(inner)

    def _interpolated(self, window: Window, count: int) -> np.ndarray:
        """Arrival times of the first perimeters: between two fronts by how near each of them is."""
        before = _inside(self._areas[0], window)
        times = np.where(before, self._times[0], np.inf)
        for k in range(1, count):
            after = before | _inside(self._areas[k], window)
            new = after & ~before
            if new.any() and before.any():
                from_last, to_next = _depth(~before), _depth(after)
                share = from_last / (from_last + to_next)
                between = self._times[k - 1] + (self._times[k] - self._times[k - 1]) * share
                times[new] = between[new]
            times[new & np.isinf(times)] = self._times[k]  # of a first front outside the window
            before = after
        return times

    def _check_order(self) -> None:
        """That areas do not shrink: then times go backwards, or are of another fire."""
        burnt = first = _inside(self._areas[0], self._window)
        largest = self._areas[0].area
        for k in range(1, len(self._areas)):
            area, exact = _inside(self._areas[k], self._window), self._areas[k].area
            # By cells at first: areas of many perimeters take long to unite.
            if area.sum() < _SHRUNK * burnt.sum() or exact < _SHRUNK * largest:
                self._check_shrinks(k)
            burnt, largest = burnt | area, max(largest, exact)
        if first.sum() == burnt.sum():
            raise UserError("all cells burn at once: no perimeter adds to the first; expected two")

    def _check_shrinks(self, k: int) -> None:
        """That a perimeter is not but a part of what had burnt before."""
        shapely = library("shapely", "perimeters")
        area, before = self._areas[k], shapely.union_all(self._areas[:k])
        within = area.intersection(before).area >= _WITHIN * area.area
        if within and area.area < _SHRUNK * before.area:
            raise UserError(
                f"the perimeter of {self.clock.shown(self._times[k])} lies within what had "
                f"burnt before and is {100 * area.area / before.area:.0f} % of it: times go "
                "backwards; expected areas that grow"
            )


def _began(areas: Sequence[Any], times: np.ndarray) -> Any:
    """The area that burnt at time 0."""
    first, second = (np.array(area.bounds) for area in areas[:2])
    grown = np.concatenate([np.minimum(second - first, 0)[:2], np.maximum(second - first, 0)[2:]])
    speed = grown / (times[1] - times[0])
    width, spread = ((at[2:] - at[:2]).sum() for at in (first, speed))
    back = min(times[0], width / spread) if spread > 0 else 0.0  # then it is a point
    return ignition(areas[0], speed * back)


def _valid(shapely: Any, area: Any) -> Any:
    """An area that still does not cross itself after it was projected."""
    return area if area.is_valid else shapely.make_valid(area)


def _depth(area: np.ndarray) -> np.ndarray:
    """How far each cell's centre is from the edge of the area that it lies in, cells."""
    distance: Any = distance_transform_edt(area)
    return distance - 0.5


def _inside(area: Any, window: Window) -> np.ndarray:
    """Whether each cell's centre lies in an area, bool [X, Y]."""
    features = library("rasterio.features", "perimeters")
    affine = library("rasterio.transform", "perimeters").from_origin(
        window.x, window.y + window.grid[1] * window.side, window.side, window.side
    )
    about = {"out_shape": window.grid[::-1], "transform": affine, "dtype": "uint8"}
    inside = features.rasterize([area], **about)[::-1].T.astype(bool)
    # A polygon that covers no cell's centre is not to be lost.
    shapely = library("shapely", "perimeters")
    i, j = window.cells(*shapely.get_coordinates(shapely.point_on_surface(polygons(area))).T)
    there = within(i, j, window.grid)
    inside[i[there], j[there]] = True
    return inside
