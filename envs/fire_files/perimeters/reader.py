"""Reads perimeters over time: shapefile, GeoJSON, GeoPackage, KML."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import distance_transform_edt

from emberlink.envs.fire_files.config import Clock, FileFireConfig
from emberlink.envs.fire_files.formats import (
    GEOJSON,
    KML,
    KMZ,
    PERIMETERS,
    find_format,
    perimeter_files,
)
from emberlink.envs.fire_files.kmz import for_gdal
from emberlink.envs.fire_files.perimeters.areas import area_at_zero, enclosed, make_valid, polygons
from emberlink.envs.fire_files.perimeters.kml_times import with_one_time
from emberlink.envs.fire_files.perimeters.times import known_columns, perimeter_times
from emberlink.envs.fire_files.projection import (
    Bounds,
    check_projection,
    first_line,
    library,
    projections,
)
from emberlink.envs.fire_files.raster_source import Window
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import as_argument, unknown

MAX_TIMES = 500
_INCIDENTS = ("poly_incidentname", "attr_incidentname", "incidentname", "incident", "fire_name")
_INCIDENTS += ("firename", "fire_nm")
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
    frame = _choose_incident(_read_tables(path, config), config.incident)
    times, clock = perimeter_times(frame, config.time_field, config.units)
    distinct = np.unique(times)
    if len(distinct) > MAX_TIMES:
        raise UserError(f"{len(distinct)} times; at most {MAX_TIMES} are read")
    areas: list[Any] = []
    for time in distinct:
        part = frame[times == time]
        areas.append(enclosed(part.geometry.tolist(), part.index.tolist()))
    return PerimeterSource(_project(frame, areas, config.crs), distinct, clock)


def _read_tables(path: Path, config: FileFireConfig) -> Any:
    """Reads the features of a file, or of all files in a folder.

    The index of the table names the features in messages.
    """
    if not path.is_dir():
        return _read_table(path, config).rename(index="feature {}".format)
    names, frames = [], []
    for part in perimeter_files(path):
        try:
            if find_format(part) not in PERIMETERS:
                raise UserError("expected perimeters")
            frame = _read_table(part, config).rename(columns=str.lower)
        except UserError as error:
            raise UserError(f"{part.name}: {error}") from None
        names.append(part.name)
        frames.append(frame.rename(index=f"{part.name}: feature {{}}".format))
    for name, frame in zip(names, frames, strict=True):
        if (frame.crs is None) != (frames[0].crs is None):
            without, other = (name, names[0]) if frame.crs is None else (names[0], name)
            raise UserError(f"{without}: no projection, which {other} has; expected one in each")
    return _join(frames)


def _join(frames: Sequence[Any]) -> Any:
    """Joins tables, in the projection of the first."""
    crs = frames[0].crs
    same = [frame if frame.crs == crs else frame.to_crs(crs) for frame in frames]
    return library("pandas").concat(same)


def _read_table(path: Path, config: FileFireConfig) -> Any:
    """Reads the features of a file, each of which has a geometry."""
    pyogrio = library("pyogrio")
    library("geopandas")
    suffix = path.suffix.lower()
    is_json, is_kml = suffix in GEOJSON.suffixes, suffix in (*KML.suffixes, *KMZ.suffixes)
    # Dates in GeoJSON as text, because GDAL loses zones that differ.
    options: dict[str, Any] = {"DATE_AS_STRING": "YES"} if is_json else {}
    try:
        with for_gdal(path) as source:
            layers = _choose_layers(pyogrio.list_layers(source), config.layer, several=is_kml)
            options["datetime_as_string"] = True
            parts = [pyogrio.read_dataframe(source, layer=name, **options) for name in layers]
        frame = _join(parts).reset_index(drop=True)
    except UserError:
        raise
    except Exception as error:  # GDAL, text and geometries raise many types
        if isinstance(error, pyogrio.errors.CRSError):
            check_projection(path, None)
        raise UserError(f"{first_line(error)}; expected perimeters") from None
    if is_kml:  # without hot spots, and without the columns of KML that are empty
        frame = frame[frame.geom_type != "Point"].dropna(axis="columns", how="all")
        frame = with_one_time(frame) if config.time_field is None else frame
    if not hasattr(frame, "geometry") or len(frame) == 0:
        raise UserError("no feature with a geometry; expected perimeters")
    missing = frame.index[frame.geometry.isna() | frame.geometry.is_empty]
    if len(missing):
        raise UserError(f"feature {missing[0]} has no geometry; expected a perimeter in each")
    if not is_json:
        check_projection(path, frame.crs)
    elif frame.crs is not None and frame.crs.is_geographic and abs(frame.total_bounds).max() > 360:
        return frame.set_crs(None, allow_override=True)  # GDAL assumes degrees
    return frame


def _choose_layers(layers: Sequence[Any], wanted: str | None, *, several: bool) -> list[str]:
    """Returns the layer `wanted`, or the only layer with geometries, or all if `several`."""
    names = [str(name) for name, kind in layers if kind is not None]
    if wanted in names:
        return [str(wanted)]
    known = ", ".join(names[:30]) or "none"
    if wanted is not None:
        raise UserError(f"no layer {wanted!r} (fire.layer); there are {known}")
    if not names:
        raise UserError("no feature with a geometry; expected perimeters")
    if len(names) > 1 and not several:
        raise UserError(f"{len(names)} layers of perimeters; expected fire.layer, one of {known}")
    return names


def _choose_incident(frame: Any, wanted: str | None) -> Any:
    """Returns the features of the incident `wanted`, or of the only incident."""
    known = known_columns({str(name).lower(): str(name) for name in frame.columns}, _INCIDENTS)
    columns = [name for name in known if frame[name].notna().any()]
    if wanted == "*" or not (columns or wanted):
        return frame
    if not columns:
        raise UserError(f"fire.incident={wanted}: no column of incidents, such as {_INCIDENTS[0]}")
    named = frame[columns[0]].dropna().astype(str).str.strip()
    names = {name.casefold(): name for name in named[::-1]}
    if wanted is None and len(names) < 2:
        return frame
    if wanted is None:
        several = sorted(names.values())
        raise UserError(
            f"perimeters of {len(several)} incidents: {', '.join(several[:30])}; expected "
            f"{as_argument('fire.incident', several[0])}, or fire.incident=* for all as one fire"
        )
    if wanted.casefold() not in names:
        raise UserError(f"fire.incident={unknown(wanted, sorted(names.values()))}")
    chosen = named.str.casefold() == wanted.casefold()
    return frame.loc[chosen.index[chosen]]


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
    doubts: Sequence[str] = ()

    def __init__(self, areas: Sequence[Any], times: np.ndarray, clock: Clock):
        if len(times) < 2:
            raise UserError(
                f"one perimeter, of {clock.format(times[0])}; expected two times or more"
            )
        self.clock, self.first, self.last = clock, float(times[0]), float(times[-1])
        span = f"{clock.format(self.first)} to {clock.format(self.last)}"
        self.summary = f"perimeters of {len(times)} times, from {span}"
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
