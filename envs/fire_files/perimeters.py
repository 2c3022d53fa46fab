"""Makes a fire of features over time: areas of each time, their union, the arrival between them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from scipy.ndimage import binary_erosion
from scipy.spatial import KDTree

from emberlink.envs.fire_files.config import FileFireConfig
from emberlink.envs.fire_files.plane import Bounds, Window, choose_plane
from emberlink.envs.fire_files.report import Clock, Report, ask
from emberlink.envs.fire_files.tables import choose_features, read_table
from emberlink.envs.fire_files.times import read_times

_MAX_TIMES = 500
_MAX_POINTS = 200_000  # points into which the front of one time is cut
_GAP = 0.01  # of a line's length: a smaller gap between its ends is closed


@dataclass
class Perimeters:
    """A fire of perimeters, polygons for each time. A fire only grows: their union is burnt."""

    clock: Clock
    first: float
    """time of the first perimeter"""
    last: float
    areas: Sequence[np.ndarray]
    at: np.ndarray
    """times of the areas, ascending"""
    whole = False

    def bounds(self, until: float | None) -> Bounds:
        """Returns the bounds of the burnt area, linear between two times."""
        boxes = np.array([shapely.total_bounds(parts) for parts in self.areas])
        low, high = np.minimum.accumulate(boxes[:, :2]), np.maximum.accumulate(boxes[:, 2:])
        until, edges = self.last if until is None else until, np.hstack([low, high]).T
        x0, y0, x1, y1 = (float(np.interp(until, self.at, edge)) for edge in edges)
        return x0, y0, x1, y1

    def on(self, window: Window, until: float, report: Report) -> np.ndarray:
        """Divides the time between two fronts by a sample's distances to both, float64 [X, Y]."""
        points, idle, bare = window.samples(), 0, 0
        centres = np.stack(points.centres(), -1).reshape(-1, 2)
        index = shapely.STRtree(shapely.points(centres))  # pyright: ignore
        times, front = np.full(points.grid, np.inf), KDTree(np.empty((0, 2)))
        for k, parts in enumerate(self.areas):
            part, at = index.query(parts, predicate="intersects")
            # The smallest spot fire has a sample of its own.
            i, j, there = points.cells(*shapely.get_coordinates(shapely.point_on_surface(parts)).T)
            part = np.append(part, np.flatnonzero(there))
            at = np.append(at, i[there] * points.grid[1] + j[there])
            fresh = np.isinf(times.flat[at])
            idle += k > 0 and not fresh.any()
            bare += len(np.unique(at[~fresh])) < 0.99 * np.isfinite(times).sum()
            new, last = np.unique(at[fresh]), front
            times.flat[new] = self.at[k]
            apart = max(points.side / 2, float(shapely.length(parts).sum()) / _MAX_POINTS)
            edges = shapely.segmentize(shapely.boundary(parts[np.unique(part[fresh])]), apart)
            edge = np.concatenate([last.data, shapely.get_coordinates(edges)])
            edge = _front(edge, np.isfinite(times), points)
            front = KDTree(edge, balanced_tree=False, compact_nodes=False)
            if k > 0:
                share = _share(last, front, centres[new])
                times.flat[new] -= (self.at[k] - self.at[k - 1]) * (1 - share)
            if self.at[k] >= until:
                break
        report.facts += [f"{idle} within the area burnt before"] if idle else []
        report.facts += [f"{bare} without all that burnt before: the union counts"] if bare else []
        return window.earliest(times)


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
    inner: Any = binary_erosion(burnt, np.ones((3, 3)))
    i, j, there = points.cells(*edge.T)
    there[there] = inner[i[there], j[there]]
    edge = edge[~there]
    edge = edge[np.lexsort(edge.T)]  # whatever the order of the file
    x, y = np.floor(edge / (points.side / 2)).astype(np.int64).T
    return edge[np.unique(x * 2**31 + y, return_index=True)[1]]


def read_perimeters(path: Path, kind: str, config: FileFireConfig, report: Report) -> Perimeters:
    """Makes a fire of the features of a file or folder."""
    table, shapes = read_table(path, kind, config.layer)
    points = shapes.geom_type.isin(("Point", "MultiPoint"))
    kept = ~(shapes.isna() | shapes.is_empty | (points & (config.radius is None)))
    if not kept.any():
        key = "fire.radius, metres around each point, such as fire.radius=375 for VIIRS"
        raise ask(f"{points.sum()} points, no areas, as of satellite detections", key)
    left_out = [f"{(~kept).sum()} without an area left out"] * int(not kept.all())
    used = choose_features(table[kept], config, left_out)
    shapes = shapes[used.index]
    values, clock = read_times(used, shapes, config, report)
    shapes = _on_plane(shapes, config, report)
    at, sizes = np.unique(values, return_counts=True)
    first, last = float(at[0]), float(at[-1])
    if not 2 <= len(at) <= _MAX_TIMES:
        raise ask(f"{report.facts[0]}: times {len(at)}", f"2 to {_MAX_TIMES}")
    report.facts = [
        f"perimeters of {len(at)} times, from {clock.format(first)} to {clock.format(last)}",
        "; ".join([f"{len(used)} of {len(table)} features used", *left_out]),
        f"{' to '.join(map(str, sorted({sizes.min(), sizes.max()})))} per time",
        *report.facts,
    ]
    areas = [_areas(shapes[values == time]) for time in at]
    if config.start != first and first > (
        0.0 if config.start is not None else clock.beginning(first, last)
    ):
        # At 0, the fire is a point in each of its first areas.
        points, size = shapely.point_on_surface(areas[0]), 1e-3 * shapely.area(areas[0]) ** 0.5
        areas, at = [shapely.buffer(points, size), *areas], np.append(0.0, at)
    return Perimeters(clock, first, last, areas, at)


def _on_plane(shapes: Any, config: FileFireConfig, report: Report) -> Any:
    """Returns the shapes of features on a plane, with a circle for each point."""
    x0, y0, x1, y1 = (float(value) for value in shapes.total_bounds)
    plane = choose_plane(shapes.crs, config.crs, (x0, y0, x1, y1))
    report.facts.append(plane.about)
    shapes = shapes.force_2d().transform(lambda at: np.stack(plane.project(*at.T), 1))
    if not np.isfinite(shapes.total_bounds).all():
        raise ask("features outside the projection", "another fire.crs")
    if config.radius is not None:
        points = shapes.geom_type.isin(("Point", "MultiPoint"))
        shapes = shapes.where(~points, shapes.buffer(config.radius / plane.unit))
    return shapes


def _areas(shapes: Any) -> np.ndarray:
    """Returns the polygons of shapes of one time; a closed line within another is an island."""
    name = shapes.index[0]
    parts = shapely.get_parts(shapely.get_parts(shapes.to_numpy()))  # of collections of others
    found = parts[shapely.get_type_id(parts) == shapely.GeometryType.POLYGON]
    lines = parts[shapely.get_dimensions(parts) == 1]
    lines = lines[shapely.is_closed(lines) | (len(found) == 0)]
    if not shapely.is_valid(found).all():
        found = shapely.make_valid(found, method="structure", keep_collapsed=False)
    if len(lines):
        merged = shapely.get_parts(shapely.line_merge(shapely.multilinestrings(lines)))
        ends = shapely.get_point(merged, 0), shapely.get_point(merged, -1)
        gap = (shapely.distance(*ends) / shapely.length(merged)).max()
        if gap > _GAP:
            raise ask(f"{name}: a line is not closed, {gap:.0%} are missing", "closed lines")
        rings: Any = [shapely.linearrings(shapely.get_coordinates(line)) for line in merged]
        found = np.append(
            found, shapely.build_area(shapely.node(shapely.geometrycollections(rings)))
        )
    parts = shapely.get_parts(found)
    parts = parts[shapely.area(parts) > 0]
    if len(parts) == 0:
        raise ask(f"{name} encloses no area", "polygons or closed lines")
    return parts
