"""Makes a fire of features over time: areas of each time, their union, the arrival between them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import binary_erosion
from scipy.spatial import KDTree

from emberlink.envs.fire_files.config import FileFireConfig
from emberlink.envs.fire_files.files import library
from emberlink.envs.fire_files.grid import EIGHT, Fire, Window, beginning
from emberlink.envs.fire_files.plane import Bounds, choose_plane
from emberlink.envs.fire_files.report import Report, ask, counted
from emberlink.envs.fire_files.tables import choose_features
from emberlink.envs.fire_files.times import read_times

_MAX_TIMES = 500
_MAX_POINTS = 200_000  # points into which the front of one time is cut
_GAP = 0.01  # of a line's length: a smaller gap between its ends is closed


@dataclass
class Perimeters(Fire):
    """A fire of perimeters, polygons for each time. A fire only grows: their union is burnt."""

    areas: Sequence[np.ndarray]
    at: np.ndarray
    """times of the areas, ascending"""

    def bounds(self, until: float | None) -> Bounds:
        """Returns the bounds of the burnt area, linear between two times."""
        boxes = np.array([library("shapely").total_bounds(parts) for parts in self.areas])
        low, high = np.minimum.accumulate(boxes[:, :2]), np.maximum.accumulate(boxes[:, 2:])
        until, edges = self.last if until is None else until, np.hstack([low, high]).T
        x0, y0, x1, y1 = (float(np.interp(until, self.at, edge)) for edge in edges)
        return x0, y0, x1, y1

    def on(self, window: Window, until: float, report: Report) -> np.ndarray:
        """Divides the time between two fronts by a sample's distances to both."""
        points, idle = window.samples(), 0
        burnt, times = np.zeros(points.grid, bool), np.full(points.grid, np.inf)
        front = KDTree(np.empty((0, 2)))
        centres = np.stack(np.meshgrid(*points.axes(), indexing="ij"), -1)
        index = library("shapely").STRtree(library("shapely").points(centres.reshape(-1, 2)))
        for k, parts in enumerate(self.areas):
            part, at = _samples_in(parts, points, index)
            part, at = part[~burnt.flat[at]], at[~burnt.flat[at]]
            new, last = np.zeros(points.grid, bool), front
            new.flat[at] = True
            burnt |= new
            outline = _outline(parts[np.unique(part)], points.side)
            edge = _front(np.concatenate([last.data, outline]), burnt, points)
            front = KDTree(edge, balanced_tree=False, compact_nodes=False)
            idle += k > 0 and not new.any()
            times[new] = self.at[k]
            if k > 0:
                share = _share(last, front, centres[new])
                times[new] -= (self.at[k] - self.at[k - 1]) * (1 - share)
            if self.at[k] >= until:
                break
        report.facts += [f"{idle} within the area burnt before"] if idle else []
        return window.earliest(times)


def _samples_in(parts: np.ndarray, points: Window, index: Any) -> np.ndarray:
    """Returns polygons and the sample points in them, at least one of each, [2, n]."""
    shapely = library("shapely")
    inside = index.query(parts, predicate="intersects")
    i, j, there = points.cells(*shapely.get_coordinates(shapely.point_on_surface(parts)).T)
    own = np.flatnonzero(there), i[there] * points.grid[1] + j[there]
    return np.concatenate([inside, own], 1)


def _outline(parts: np.ndarray, side: float) -> np.ndarray:
    """Returns points along the edges of polygons, half a sample apart or less, [n, 2]."""
    shapely = library("shapely")
    apart = max(side / 2, float(shapely.length(parts).sum()) / _MAX_POINTS)
    return shapely.get_coordinates(shapely.segmentize(shapely.boundary(parts), apart))


def _share(last: KDTree, front: KDTree, points: np.ndarray) -> np.ndarray:
    """Returns how far points are on their way from one front to the next, 0 to 1, [n].

    A point is compared with the point of the next front that lies in the same direction from the
    same place of the last one: both have moved with the same speed.
    """
    (passed, here), (whole, there) = last.query(points), last.query(front.data)
    reach = float(whole.mean()) + 1e-9

    def rays(ends: np.ndarray, feet: Any, lengths: np.ndarray) -> np.ndarray:
        away = (ends - last.data[feet]) / np.maximum(lengths, 1e-9)[:, None]
        return np.hstack([last.data[feet], reach * away])

    ahead = KDTree(rays(front.data, there, whole)).query(rays(points, here, passed))[1]
    return np.minimum(passed / np.maximum(whole[ahead], 1e-9), 1)


def _front(edge: np.ndarray, burnt: np.ndarray, points: Window) -> np.ndarray:
    """Returns points of edges that don't lie in the burnt area, four in a sample at most."""
    inner: Any = binary_erosion(burnt, EIGHT)
    i, j, there = points.cells(*edge.T)
    there[there] = inner[i[there], j[there]]
    edge = edge[~there]
    edge = edge[np.lexsort(edge.T)]  # whatever the order of the file
    x, y = np.floor(edge / (points.side / 2)).astype(np.int64).T
    return edge[np.unique(x * 2**31 + y, return_index=True)[1]]


def read_perimeters(
    table: tuple[Any, list[str]], config: FileFireConfig, report: Report
) -> Perimeters:
    """Makes a fire of features, and of the columns whose values stand outside their attributes."""
    frame, outside = table
    points = frame.geom_type.isin(("Point", "MultiPoint"))
    if config.radius is None and points.all():
        key = "fire.radius, metres around each, such as fire.radius=375 for VIIRS"
        raise ask(f"{len(frame)} points, as of satellite detections", key)
    kept = ~(frame.geometry.isna() | frame.geometry.is_empty | (points & (config.radius is None)))
    if not kept.any():
        raise ask("no feature with a geometry", "perimeters")
    left_out = [f"{(~kept).sum()} without an area left out"] * int(not kept.all())
    used = choose_features(frame[kept], config, left_out)
    values, clock = read_times(used, config, outside, report)
    shapes = _on_plane(used, config, report)
    at, sizes = np.unique(values, return_counts=True)
    first, last = clock.format(at[0]), clock.format(at[-1])
    if not 2 <= len(at) <= _MAX_TIMES:
        raise ask(f"{report.facts[0]}: {counted(len(at), 'time')}", f"2 to {_MAX_TIMES}")
    why = "; ".join(left_out)
    report.facts = [
        f"perimeters of {len(at)} times, from {first} to {last}",
        f"{len(used)} of {len(frame)} features used{why and f' ({why})'}",
        f"{' to '.join(map(str, sorted({sizes.min(), sizes.max()})))} per time",
        *report.facts,
    ]
    areas = [_areas(shapes[values == time]) for time in at]
    ends = float(at[0]), float(at[-1])
    if config.start != at[0] > beginning(clock, config, *ends):
        areas, at = [_at_zero(areas, at), *areas], np.concatenate([[0.0], at])
    return Perimeters(clock, *ends, whole=False, areas=areas, at=at)


def _at_zero(areas: Sequence[np.ndarray], at: np.ndarray) -> np.ndarray:
    """Returns the area burnt at 0: the first shrinks with the speed between the first two."""
    shapely, (first, second) = library("shapely"), areas[:2]
    grown = shapely.area(second).sum() - shapely.area(first).sum()
    edges = (shapely.length(first).sum() + shapely.length(second).sum()) / 2
    small = shapely.buffer(first, -max(grown, 0) / edges / (at[1] - at[0]) * at[0])
    points = shapely.buffer(shapely.point_on_surface(first), 1e-3 * shapely.area(first) ** 0.5)
    return shapely.get_parts(np.where(shapely.is_empty(small), points, small))


def _on_plane(frame: Any, config: FileFireConfig, report: Report) -> Any:
    """Returns the shapes of features on a plane, with a circle for each point."""
    x0, y0, x1, y1 = (float(value) for value in frame.total_bounds)
    plane = choose_plane(frame.crs, config.crs, (x0, y0, x1, y1))
    report.facts.append(plane.about)
    shapes = frame.geometry.force_2d()
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

    Points, and open lines beside polygons, are left out.
    """
    shapely, name = library("shapely"), shapes.index[0]
    while shapes.geom_type.isin(("GeometryCollection", "MultiPolygon", "MultiLineString")).any():
        shapes = shapes.explode()
    found = shapes[shapes.geom_type == "Polygon"].to_numpy()
    lines = shapes[shapes.geom_type.isin(("LineString", "LinearRing"))]
    lines = lines[lines.is_closed | (len(found) == 0)].to_numpy()
    if not shapely.is_valid(found).all():
        found = shapely.make_valid(found, method="structure", keep_collapsed=False)
    if len(lines):
        merged = shapely.get_parts(shapely.line_merge(shapely.multilinestrings(lines)))
        ends = shapely.get_point(merged, 0), shapely.get_point(merged, -1)
        gap = (shapely.distance(*ends) / shapely.length(merged)).max()
        if gap > _GAP:
            raise ask(f"{name}: a line is not closed, {gap:.0%} are missing", "closed lines")
        rings = [shapely.linearrings(shapely.get_coordinates(line)) for line in merged]
        area = shapely.build_area(shapely.node(shapely.geometrycollections(rings)))
        found = np.append(found, area)
    parts = shapely.get_parts(found)
    parts = parts[shapely.area(parts) > 0]
    if len(parts) == 0:
        raise ask(f"{name} encloses no area", "polygons or closed lines")
    return parts
