"""Makes a fire of features over time: areas of each time, their union, the arrival between them."""

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.ndimage import binary_dilation, distance_transform_edt, label

from emberlink.envs.fire_files.config import FileFireConfig
from emberlink.envs.fire_files.files import library
from emberlink.envs.fire_files.grid import EIGHT, Raster, Window, span
from emberlink.envs.fire_files.plane import choose_plane
from emberlink.envs.fire_files.report import Report, ask, counted
from emberlink.envs.fire_files.tables import choose_features
from emberlink.envs.fire_files.times import read_times
from emberlink.envs.utils.errors import UserError

_MAX_TIMES = 500
_MAX_BORDER = 2000  # sample points beside the grid, to which fronts outside are drawn
_MANY = 50  # polygons above which points are looked up in polygons, and not polygons drawn
_GAP = 0.01  # of a line's length: a smaller gap between its ends is closed
_POINT = 1e-3  # of an area's width: the size of a fire that is a point


def read_perimeters(
    table: tuple[Any, list[str]], config: FileFireConfig, grid: Any, horizon: int, report: Report
) -> Raster:
    """Makes a fire of features, and of the columns whose values stand outside their attributes.

    A fire only grows: the area burnt by a time is the union of the areas until then. A fire with
    elapsed times began at 0.
    """
    (frame, outside), left_out = table, []
    count = len(frame)
    frame = frame[~(frame.geometry.isna() | frame.geometry.is_empty)]
    if len(frame) < count:
        left_out.append(f"{count - len(frame)} without a geometry left out")
    points = frame.geom_type.isin(("Point", "MultiPoint"))
    if config.radius is None and points.any():
        if points.all():
            key = "fire.radius, metres of the circle around each, such as fire.radius=375 for VIIRS"
            raise ask(f"{len(frame)} points, as of satellite detections", key)
        left_out.append(f"{points.sum()} points left out")
        frame = frame[~points]
    if len(frame) == 0:
        raise ask("no feature with a geometry", "perimeters")
    frame = choose_features(frame, config, left_out)
    values, clock = read_times(frame, config, outside, report)
    shapes = _on_plane(frame, config, report)
    at, sizes = np.unique(values, return_counts=True)
    first, last = clock.format(at[0]), clock.format(at[-1])
    if not 2 <= len(at) <= _MAX_TIMES:
        seen = f"{report.facts[0]}: {counted(len(at), 'time')}, from {first} to {last}"
        raise ask(seen, f"2 to {_MAX_TIMES}")
    why = f" ({'; '.join(left_out)})" if left_out else ""
    report.facts = [
        f"perimeters of {len(at)} times, from {first} to {last}",
        f"{len(frame)} of {count} features used{why}",
        f"{' to '.join(map(str, sorted({sizes.min(), sizes.max()})))} per time",
        *report.facts,
    ]
    areas, burns = [_areas(shapes[values == time]) for time in at], (float(at[0]), float(at[-1]))
    if clock.origin is None and at[0] > 0:
        if at[0] > at[-1] - at[0]:
            report.doubts.append(f"it begins at time 0 (fire.start={at[0]:g}: at the first)")
        areas, at = [_at_zero(areas, at), *areas], np.concatenate([[0.0], at])
    _, end = span(clock, burns, float(at[0]), config, horizon)
    boxes = np.array([library("shapely").total_bounds(parts) for parts in areas])
    boxes = np.hstack([np.minimum.accumulate(boxes[:, :2]), np.maximum.accumulate(boxes[:, 2:])])
    until = at[-1] if config.margin is None else end
    x0, y0, x1, y1 = (float(np.interp(until, at, edge)) for edge in boxes.T)
    window = Window.around((x0, y0, x1, y1), grid, config.margin or 0)
    count = min(int(np.searchsorted(at, end)), len(at) - 1) + 1
    points = _around(window.samples()[0], boxes[count - 1])
    arrival = _between(areas[:count], at, points, report)
    corner, cell = (points.x, points.y + points.grid[1] * points.side), (points.side, points.side)
    fire = Raster(arrival.T[::-1], corner, cell, clock, window=window, began=float(at[0]))
    fire.first, fire.last = burns
    return fire


def _on_plane(frame: Any, config: FileFireConfig, report: Report) -> Any:
    """Returns the shapes of features on a plane, with a circle for each point."""
    x0, y0, x1, y1 = (float(value) for value in frame.total_bounds)
    plane = choose_plane(frame.crs, config.crs, (x0, y0, x1, y1), None)
    report.facts.append(plane.about)
    shapes = frame.geometry.force_2d() if frame.has_z.any() else frame.geometry
    if plane.target is not None:
        shapes = shapes.set_crs(plane.source, allow_override=True).to_crs(plane.target)
        if not np.isfinite(shapes.total_bounds).all():
            raise ask(f"features outside {plane.target.name}", "another fire.crs")
    if config.radius is not None:
        if plane.unit is None:
            raise ask("fire.radius: the unit of coordinates is not known", "fire.crs")
        points = shapes.geom_type.isin(("Point", "MultiPoint"))
        shapes = shapes.where(~points, shapes.buffer(config.radius / plane.unit))
    return shapes


def _areas(shapes: Any) -> np.ndarray:
    """Returns the polygons of shapes of one time; a closed line within another is an island.

    Points, and open lines beside a polygon of the same feature, are left out.
    """
    shapely, name = library("shapely"), shapes.index[0]
    while shapes.geom_type.isin(("GeometryCollection", "MultiPolygon", "MultiLineString")).any():
        shapes = shapes.explode()
    areas = shapes[shapes.geom_type == "Polygon"]
    lines = shapes[shapes.geom_type.isin(("LineString", "LinearRing"))]
    lines = lines[lines.is_closed | ~lines.index.isin(areas.index)]
    if len(areas) == len(lines) == 0:
        raise ask(f"{name} is of {shapes.geom_type.iloc[0]}", "polygons or lines")
    found = areas.to_numpy()
    if not areas.is_valid.all():
        found = shapely.make_valid(found, method="structure", keep_collapsed=False)
    found = np.concatenate([found, _within(lines)]) if len(lines) else found
    parts = shapely.get_parts(found)
    parts = parts[shapely.area(parts) > 0]
    if len(parts) == 0:
        raise ask(f"{name} encloses no area", "a perimeter")
    return parts


def _within(lines: Any) -> np.ndarray:
    """Returns the area inside closed lines. A line within an odd number of others is an island."""
    shapely = library("shapely")
    merged = shapely.get_parts(shapely.line_merge(shapely.multilinestrings(lines.to_numpy())))
    ends = shapely.get_point(merged, 0), shapely.get_point(merged, -1)
    gaps, lengths = shapely.distance(*ends), shapely.length(merged)
    open_ = np.flatnonzero((gaps > _GAP * lengths) | (shapely.get_num_points(merged) < 3))
    if len(open_):
        name = lines.index[shapely.distance(lines.to_numpy(), ends[0][open_[0]]).argmin()]
        gap = f"{gaps[open_[0]]:g} of {lengths[open_[0]]:g}"
        raise UserError(f"{name}: a line is not closed, {gap} is missing")
    rings = [shapely.linearrings(shapely.get_coordinates(line)) for line in merged]
    return np.array([shapely.build_area(shapely.node(shapely.geometrycollections(rings)))])


def _around(points: Window, box: np.ndarray) -> Window:
    """Returns sample points continued over a box, to which distances are computed."""
    corner, size = np.array([points.x, points.y]), np.array(points.grid)
    past = np.array([corner - box[:2], box[2:] - corner - size * points.side])
    below, above = np.clip(np.ceil(past / points.side).astype(int) + 1, 0, _MAX_BORDER)
    x, y = (corner - below * points.side).tolist()
    columns, rows = (size + below + above).tolist()
    return Window(x, y, points.side, (columns, rows))


def _at_zero(areas: Sequence[np.ndarray], at: np.ndarray) -> np.ndarray:
    """Returns the area burnt at time 0, by extrapolating the boxes of the first two perimeters."""
    shapely = library("shapely")
    first, second = (np.array(shapely.total_bounds(parts)) for parts in areas[:2])
    grown = np.concatenate([np.minimum(second - first, 0)[:2], np.maximum(second - first, 0)[2:]])
    speed = grown / (at[1] - at[0])
    width, spread = ((box[2:] - box[:2]).sum() for box in (first, speed))
    moved = speed * (min(at[0], width / spread) if spread > 0 else 0.0)  # then it is a point
    then = []
    for part in areas[0]:
        now = np.array(part.bounds)
        size, box = now[2:] - now[:2], now - moved
        scale = np.maximum((box[2:] - box[:2]) / size, _POINT)
        shift = np.clip((box[:2] + box[2:]) / 2, now[:2], now[2:]) - scale * (now[:2] + size / 2)
        small = shapely.transform(part, lambda xy, k=scale, d=shift: xy * k + d).intersection(part)
        point = part.representative_point().buffer(_POINT * size.min())
        then += [part for part in shapely.get_parts(small) if part.area > 0] or [point]
    return np.array(then)


def _between(
    areas: Sequence[np.ndarray], at: np.ndarray, window: Window, report: Report
) -> np.ndarray:
    """Returns arrival times at the centres of a window's cells, by the distances to fronts."""
    before = _rasterize(areas[0], window)
    begun, idle = int(label(before, EIGHT)[1]), 0  # pyright: ignore
    times = np.where(before, at[0], np.inf)
    for k in range(1, len(areas)):
        after = before | _rasterize(areas[k], window)
        new = after & ~before
        parts: Any = label(new, EIGHT)
        beside: Any = binary_dilation(before, EIGHT)
        begun += parts[1] - len(np.unique(parts[0][new & beside]))
        idle += not new.any()
        if before.any():
            # Distances of centres to the edges of the areas, in cells.
            from_last, to_next = (
                np.asarray(distance_transform_edt(area)) - 0.5
                for area in (~before, np.pad(after, 1))
            )
            share = from_last / (from_last + to_next[1:-1, 1:-1])
            times[new] = (at[k - 1] + (at[k] - at[k - 1]) * share)[new]
        else:
            times[new] = at[k]  # the first front lies outside
        before = after
    report.facts.append(f"{counted(begun, 'place')} where it begins")
    report.facts += [f"{idle} within the area burnt before"] if idle else []
    return times


@functools.lru_cache(1)
def _tree(window: Window) -> Any:
    """Returns a tree of the centres of a window's cells, in C order."""
    shapely, centres = library("shapely"), np.meshgrid(*window.axes(), indexing="ij")
    return shapely.STRtree(shapely.points(*(at.ravel() for at in centres)))


def _rasterize(parts: np.ndarray, window: Window) -> np.ndarray:
    """Returns the mask of cells centred in polygons, at least one per part, bool [X, Y]."""
    shapely = library("shapely")
    if len(parts) > _MANY:
        inside = np.zeros(window.grid, bool)
        inside.flat[_tree(window).query(parts, predicate="intersects")[1]] = True
    else:
        affine = library("rasterio.transform").from_origin(
            window.x, window.y + window.grid[1] * window.side, window.side, window.side
        )
        about = {"out_shape": window.grid[::-1], "transform": affine, "dtype": "uint8"}
        inside = library("rasterio.features").rasterize(parts, **about)[::-1].T.astype(bool)
    i, j, there = window.cells(*shapely.get_coordinates(shapely.point_on_surface(parts)).T)
    inside[i[there], j[there]] = True
    return inside
