"""The area that perimeters enclose: polygons, closed lines, collections of them."""

from typing import Any

import numpy as np

from emberlink.envs.utils.errors import UserError

from .projection import library

_GAP = 0.01  # of a line's length: a gap that small between its ends is closed
_POINT = 1e-3  # of an area's width: what is left of it where it is drawn in to a point
MOST_RINGS = 20_000
"""closed lines of one time"""


def enclosed(geometries: Any, names: list[int]) -> Any:
    """The area inside perimeters of one time, a shapely polygon or several.

    Args:
        geometries: of shapely; those of lines are taken together: a closed line within another
            is an unburnt island.
        names: number of the feature of each, for messages.

    Raises:
        ValueError: a feature encloses nothing, or a line is not closed.
    """
    shapely = library("shapely", "perimeters")
    areas: list[Any] = []
    lines: list[Any] = []
    drawn: list[int] = []  # the feature of each line
    for geometry, name in zip(geometries, names, strict=True):
        if geometry is None or geometry.is_empty:
            raise UserError(f"feature {name} has no geometry; expected a perimeter")
        before = len(areas) + len(lines)
        parts = _parts(shapely.force_2d(geometry))
        if any(part.geom_type == "Polygon" for part in parts):  # open lines beside it are left over
            parts = [part for part in parts if "Line" not in part.geom_type or part.is_closed]
        for part in parts:
            if part.geom_type == "Polygon":
                areas.append(_valid(shapely, part))
            elif part.geom_type in ("LineString", "LinearRing"):
                lines.append(part)
                drawn.append(name)
        if len(areas) + len(lines) == before:
            raise UserError(
                f"feature {name} is of {geometry.geom_type}; expected polygons or lines"
            )
    if lines:
        areas.append(_within_lines(shapely, lines, drawn))
    area = shapely.union_all(areas)
    if not area.area > 0:
        raise UserError(f"feature {names[0]} encloses no area; expected a perimeter")
    return area


def ignition(area: Any, moved: np.ndarray) -> Any:
    """Where a fire began of which an area is what has burnt since.

    Args:
        area: a shapely polygon or several.
        moved: float64 [4], how far the least x and y and the greatest x and y of the whole have
            moved since. The box around each polygon is drawn in by that, to a point at most.
    """
    shapely = library("shapely", "perimeters")
    began: list[Any] = []
    for part in polygons(area):
        now = np.array(part.bounds)
        size, then = now[2:] - now[:2], now - moved
        scale = np.maximum((then[2:] - then[:2]) / size, _POINT)
        shift = np.clip((then[:2] + then[2:]) / 2, now[:2], now[2:]) - scale * (now[:2] + size / 2)
        small = shapely.transform(part, lambda at, scale=scale, shift=shift: at * scale + shift)
        small = small.intersection(part)
        if not small.area > 0:
            small = part.representative_point().buffer(_POINT * size.min())
        began.append(small)
    return shapely.union_all(began)


def polygons(area: Any) -> list[Any]:
    """The polygons that an area consists of."""
    return [part for part in _parts(area) if part.geom_type == "Polygon"]


def _parts(geometry: Any) -> list[Any]:
    """The simple geometries in one, whatever is nested in what."""
    found, left = [], [geometry]
    while left:
        one = left.pop()
        if hasattr(one, "geoms"):
            left.extend(one.geoms)
        elif not one.is_empty:
            found.append(one)
    return found


def _valid(shapely: Any, polygon: Any) -> Any:
    """A polygon that does not cross itself, of the same shells."""
    if polygon.is_valid:
        return polygon
    return shapely.make_valid(polygon, method="structure", keep_collapsed=False)


def _drawn_in(merged: Any, lines: list[Any], names: list[int]) -> int:
    """The feature that a line comes from, the first if from several."""
    end = merged.coords[0]
    return next(n for one, n in zip(lines, names, strict=True) if end in list(one.coords))


def _within_lines(shapely: Any, lines: list[Any], names: list[int]) -> Any:
    """What closed lines enclose; those within an odd number of others are islands."""
    merged = _parts(shapely.line_merge(shapely.MultiLineString(lines)))
    rings: dict[bytes, Any] = {}
    for line in merged:
        ends = np.asarray(line.coords)[[0, -1]]
        gap = float(np.hypot(*(ends[1] - ends[0])))
        if len(line.coords) < 3 or gap > _GAP * line.length:
            raise UserError(
                f"feature {_drawn_in(line, lines, names)}: a line of {len(line.coords)} points is "
                f"not closed, {gap:g} of its length of {line.length:g} is missing; expected "
                "closed lines"
            )
        area = _valid(shapely, shapely.Polygon(line.coords))
        rings.setdefault(shapely.normalize(area).wkb, area)
    areas = sorted(rings.values(), key=lambda area: -area.area)
    if len(areas) > MOST_RINGS:
        raise UserError(f"{len(areas)} closed lines of one time; at most {MOST_RINGS} are read")
    tree = shapely.STRtree(areas)
    inner, outer = tree.query(areas, predicate="covered_by")
    depth = np.bincount(inner[outer < inner], minlength=len(areas))
    burnt = shapely.Polygon()
    for level in range(int(depth.max(initial=0)) + 1):
        here = shapely.union_all([a for a, deep in zip(areas, depth, strict=True) if deep == level])
        burnt = burnt.difference(here) if level % 2 else burnt.union(here)
    return burnt
