"""The area that perimeters enclose: polygons, closed lines, collections of them."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from emberlink.envs.fire_files.projection import library
from emberlink.envs.utils.errors import UserError

_GAP = 0.01  # of a line's length: a gap that small between its ends is closed
_POINT = 1e-3  # of an area's width: a fire drawn in to a point keeps that much
MAX_RINGS = 20_000
"""Closed lines of one time."""


def enclosed(geometries: Sequence[Any], features: Sequence[int]) -> Any:
    """Returns the area inside perimeters of one time, a shapely polygon or several.

    A closed line within another is an unburnt island. Points, and open lines beside a polygon of
    the same feature, are left out.

    Args:
        geometries: of shapely.
        features: number of the feature of each, for messages.

    Raises:
        UserError: a feature encloses nothing, or a line is not closed.
    """
    shapely = library("shapely")
    areas: list[Any] = []
    lines: list[tuple[Any, int]] = []
    for geometry, feature in zip(geometries, features, strict=True):
        parts = _parts(shapely.force_2d(geometry))
        shapes = [part for part in parts if part.geom_type == "Polygon"]
        strokes = [part for part in parts if part.geom_type in ("LineString", "LinearRing")]
        if not shapes and not strokes:
            raise UserError(
                f"feature {feature} is of {geometry.geom_type}; expected polygons or lines"
            )
        areas += [make_valid(shape) for shape in shapes]
        lines += [(line, feature) for line in strokes if not shapes or line.is_closed]
    if lines:
        areas.append(_within_lines(lines))
    area = shapely.union_all(areas)
    if not area.area > 0:
        raise UserError(f"feature {features[0]} encloses no area; expected a perimeter")
    return area


def make_valid(area: Any) -> Any:
    """Returns an area that does not cross itself, with the same shells."""
    shapely = library("shapely")
    if area.is_valid:
        return area
    return shapely.make_valid(area, method="structure", keep_collapsed=False)


def polygons(area: Any) -> list[Any]:
    """Returns the polygons that an area consists of."""
    return [part for part in _parts(area) if part.geom_type == "Polygon"]


def ignition(area: Any, moved: np.ndarray) -> Any:
    """Returns the area at an earlier time, from the speeds of the edges of the whole fire.

    The box around each polygon is drawn in by `moved`, to a point at most.

    Args:
        area: a shapely polygon or several.
        moved: float64 [4], how far least x, least y, greatest x and greatest y have moved since.
    """
    shapely = library("shapely")
    earlier: list[Any] = []
    for part in polygons(area):
        now = np.array(part.bounds)
        size, then = now[2:] - now[:2], now - moved
        scale = np.maximum((then[2:] - then[:2]) / size, _POINT)
        shift = np.clip((then[:2] + then[2:]) / 2, now[:2], now[2:]) - scale * (now[:2] + size / 2)
        small = shapely.transform(part, lambda at, scale=scale, shift=shift: at * scale + shift)
        small = small.intersection(part)
        if not small.area > 0:
            small = part.representative_point().buffer(_POINT * size.min())
        earlier.append(small)
    return shapely.union_all(earlier)


def _parts(geometry: Any) -> list[Any]:
    """Returns the simple geometries in one, however they are nested."""
    parts: list[Any] = []
    rest = [geometry]
    while rest:
        part = rest.pop()
        if hasattr(part, "geoms"):
            rest.extend(part.geoms)
        elif not part.is_empty:
            parts.append(part)
    return parts


def _within_lines(lines: Sequence[tuple[Any, int]]) -> Any:
    """Returns what closed lines enclose; those within an odd number of others are islands."""
    shapely = library("shapely")
    rings: dict[bytes, Any] = {}
    for line in _parts(shapely.line_merge(shapely.MultiLineString([line for line, _ in lines]))):
        ends = np.asarray(line.coords)[[0, -1]]
        gap = float(np.hypot(*(ends[1] - ends[0])))
        if len(line.coords) < 3 or gap > _GAP * line.length:
            end = line.coords[0]
            feature = next(number for part, number in lines if end in list(part.coords))
            raise UserError(
                f"feature {feature}: a line of {len(line.coords)} points is not closed, {gap:g} of "
                f"its length of {line.length:g} is missing; expected closed lines"
            )
        area = make_valid(shapely.Polygon(line.coords))
        rings.setdefault(shapely.normalize(area).wkb, area)
    areas = sorted(rings.values(), key=lambda area: -area.area)
    if len(areas) > MAX_RINGS:
        raise UserError(f"{len(areas)} closed lines of one time; at most {MAX_RINGS} are read")
    inner, outer = shapely.STRtree(areas).query(areas, predicate="covered_by")
    depth = np.bincount(inner[outer < inner], minlength=len(areas))
    burnt = shapely.Polygon()
    for level in range(int(depth.max(initial=0)) + 1):
        here = shapely.union_all(
            [area for area, at in zip(areas, depth, strict=True) if at == level]
        )
        burnt = burnt.difference(here) if level % 2 else burnt.union(here)
    return burnt
