"""Computes the area that perimeters enclose: polygons, closed lines, collections of them."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from emberlink.envs.fire_files.files import library
from emberlink.envs.utils.errors import UserError

MANY = 50
"""Polygons of one time above which they are not united, as detections of satellites."""
_MAX_RINGS = 20_000
_GAP = 0.01  # of a line's length: a smaller gap between its ends is closed
_POINT = 1e-3  # of an area's width: the size of a fire that is a point


def enclosed(shapes: Sequence[Any], names: Sequence[str]) -> Any:
    """Returns the area inside shapes of one time; a closed line within another is an island.

    Points, and open lines beside a polygon of the same feature, are left out.
    """
    shapely = library("shapely")
    areas: list[Any] = []
    lines: list[tuple[Any, str]] = []
    for shape, name in zip(shapes, names, strict=True):
        parts = _parts(shapely.force_2d(shape))
        found = [part for part in parts if part.geom_type == "Polygon"]
        strokes = [part for part in parts if part.geom_type in ("LineString", "LinearRing")]
        if not found and not strokes:
            raise UserError(f"{name} is of {shape.geom_type}; expected polygons or lines")
        areas += map(make_valid, found)
        lines += [(line, name) for line in strokes if not found or line.is_closed]
    if lines:
        areas.append(_within_lines(lines))
    if len(areas) > MANY:
        area = shapely.MultiPolygon([part for area in areas for part in polygons(area)])
    else:
        area = shapely.union_all(areas)
    if not area.area > 0:
        raise UserError(f"{names[0]} encloses no area; expected a perimeter")
    return area


def make_valid(area: Any) -> Any:
    """Returns an area without self-intersections, with the same shells."""
    if area.is_valid:
        return area
    return library("shapely").make_valid(area, method="structure", keep_collapsed=False)


def polygons(area: Any) -> list[Any]:
    """Returns the polygons of an area."""
    return [part for part in _parts(area) if part.geom_type == "Polygon"]


def nested(shapes: Sequence[Any]) -> bool:
    """Returns whether one of some shapes lies in another that is larger by a tenth or more."""
    shapely = library("shapely")
    areas = [shapely.Polygon(s.coords) if s.geom_type == "LineString" else s for s in shapes]
    inner, outer = shapely.STRtree(areas).query(areas, predicate="covered_by")
    return any(areas[i].area < 0.9 * areas[k].area for i, k in zip(inner, outer, strict=True))


def area_at_zero(areas: Sequence[Any], times: np.ndarray) -> Any:
    """Returns the area burnt at time 0, by extrapolating the boxes of the first two perimeters."""
    first, second = (np.array(area.bounds) for area in areas[:2])
    grown = np.concatenate([np.minimum(second - first, 0)[:2], np.maximum(second - first, 0)[2:]])
    speed = grown / (times[1] - times[0])
    width, spread = ((at[2:] - at[:2]).sum() for at in (first, speed))
    back = min(times[0], width / spread) if spread > 0 else 0.0  # then it is a point
    parts = [_shrunk(part, speed * back) for part in polygons(areas[0])]
    return library("shapely").union_all(parts)


def _shrunk(part: Any, moved: np.ndarray) -> Any:
    """Returns a polygon whose box is smaller by `moved`, the distance of each edge, [4]."""
    now = np.array(part.bounds)
    size, then = now[2:] - now[:2], now - moved
    scale = np.maximum((then[2:] - then[:2]) / size, _POINT)
    shift = np.clip((then[:2] + then[2:]) / 2, now[:2], now[2:]) - scale * (now[:2] + size / 2)
    small = library("shapely").transform(part, lambda at: at * scale + shift).intersection(part)
    return small if small.area > 0 else part.representative_point().buffer(_POINT * size.min())


def _parts(geometry: Any) -> list[Any]:
    """Returns the simple geometries of a collection, which may be nested."""
    parts: list[Any] = []
    rest = [geometry]
    while rest:
        part = rest.pop()
        if hasattr(part, "geoms"):
            rest.extend(part.geoms)
        elif not part.is_empty:
            parts.append(part)
    return parts


def _within_lines(lines: Sequence[tuple[Any, str]]) -> Any:
    """Returns the area inside closed lines. A line within an odd number of others is an island."""
    shapely = library("shapely")
    rings: dict[bytes, Any] = {}
    for line in _parts(shapely.line_merge(shapely.MultiLineString([line for line, _ in lines]))):
        ends = np.asarray(line.coords)[[0, -1]]
        gap = float(np.hypot(*(ends[1] - ends[0])))
        if len(line.coords) < 3 or gap > _GAP * line.length:
            name = next(name for part, name in lines if line.coords[0] in list(part.coords))
            raise UserError(f"{name}: a line is not closed, {gap:g} of {line.length:g} is missing")
        area = make_valid(shapely.Polygon(line.coords))
        rings.setdefault(shapely.normalize(area).wkb, area)
    areas = sorted(rings.values(), key=lambda area: -area.area)
    if len(areas) > _MAX_RINGS:
        raise UserError(f"{len(areas)} closed lines of one time; at most {_MAX_RINGS} are read")
    inner, outer = shapely.STRtree(areas).query(areas, predicate="covered_by")
    depth = np.bincount(inner[outer < inner], minlength=len(areas))
    burnt = shapely.Polygon()
    for level in range(int(depth.max(initial=0)) + 1):
        here = shapely.union_all([a for a, at in zip(areas, depth, strict=True) if at == level])
        burnt = burnt.difference(here) if level % 2 else burnt.union(here)
    return burnt
