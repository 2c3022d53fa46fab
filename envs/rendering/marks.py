"""What is drawn over the map: who hears whom, who has which role, and where each is to go."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from PIL import ImageDraw

from .frame import NO_FIRE, UAV, Chart

LINK = (0, 200, 255)
LINK_WIDTHS = {NO_FIRE: 4, LINK: 2}
"""pixels by colour: a dark edge first"""
TARGET = (255, 140, 0)
ROLES = ("discoverer", "seeker", "wanderer")
"""what a UAV can be in a network that agrees whom to follow (paper, section IV.F)"""
ROLE_COLOURS = ((230, 0, 60), (0, 150, 60), (215, 215, 215))
MANY = 16
"""UAVs above which links are thin, and targets have no lines that lead to them"""

# Corners of a UAV's mark by its role, in half widths to the right and downwards.
_DIAMOND = ((0, -1.3), (1.3, 0), (0, 1.3), (-1.3, 0))
_TRIANGLE = ((0, -1.4), (1.35, 1), (-1.35, 1))
_SQUARE = ((-1, -1), (1, -1), (1, 1), (-1, 1))
_SHAPES = (_DIAMOND, _TRIANGLE, _SQUARE)


@dataclass(frozen=True, kw_only=True, eq=False)
class Moment:
    """One moment of an episode, as far as it can be drawn."""

    step: int
    """steps since the episode began"""
    seen: int
    """burning cells that some UAV has seen"""
    burning: int
    """cells that burn"""
    fire_map: NDArray[np.uint8]
    """[X, Y]: 0 no fire, 1 fire that was seen, 2 fire that was not"""
    position: NDArray[np.float32]
    """[n, 3], cells"""
    links: NDArray[np.bool_] | None = None
    """[n, n], who hears whom, where anyone hears anything"""
    roles: NDArray[np.int64] | None = None
    """[n], places in `ROLES`, where UAVs have roles"""
    target: NDArray[np.float32] | None = None
    """[n, 3], where each UAV is told to go, cells, where it is told"""

    @property
    def coverage(self) -> float:
        """Cells seen / cells that burn so far, in %; 100 where nothing burns."""
        return 100 * self.seen / self.burning if self.burning else 100.0


def mark(chart: Chart, moment: Moment) -> None:
    """Draws links, ways to the targets and UAVs over the map."""
    places = [chart.point(x, y) for x, y, _ in moment.position.tolist()]
    half = mark_size(chart.scale)
    if moment.links is not None:
        pairs = np.argwhere(np.triu(moment.links | moment.links.T, 1)).tolist()
        # The edges of very many links would black out the map.
        widths = LINK_WIDTHS if len(places) <= MANY else {LINK: 1}
        for colour, width in widths.items():
            for i, j in pairs:
                chart.draw.line((places[i], places[j]), fill=colour, width=width)
    if moment.target is not None:
        for index, (x, y, _) in enumerate(moment.target.tolist()):
            role = None if moment.roles is None else int(moment.roles[index])
            end, colour = chart.point(x, y), TARGET if role is None else ROLE_COLOURS[role]
            if len(places) <= MANY:
                dashes(chart.draw, places[index], end, colour)
            cross(chart.draw, end, half * 0.6, colour)
    for index, (x, y, _) in enumerate(moment.position.tolist()):
        if moment.roles is None:
            chart.uav(x, y)
        else:
            uav(chart.draw, places[index], half, int(moment.roles[index]))


def mark_size(scale: int) -> float:
    """Half the width of a UAV's mark, pixels, on a chart of `scale` pixels per cell."""
    return min(max(0.55 * scale, 6.0), 9.0)


def dashes(
    draw: ImageDraw.ImageDraw,
    start: tuple[float, float],
    end: tuple[float, float],
    colour: tuple[int, int, int],
) -> None:
    """A thin dashed line, 4 pixels and 4 pixels without."""
    way = np.subtract(end, start)
    length = float(np.hypot(*way))
    stops = np.arange(0, length, 4)
    for dash, (near, far) in enumerate(pairwise([*stops, length])):
        if dash % 2 == 0:
            points = (tuple(np.add(start, way * (stop / length))) for stop in (near, far))
            draw.line(tuple(points), fill=colour)


def cross(
    draw: ImageDraw.ImageDraw,
    place: tuple[float, float],
    half: float,
    colour: tuple[int, int, int],
) -> None:
    """A cross with dark edges, at a target."""
    x, y = place
    for width, fill in ((4, NO_FIRE), (2, colour)):
        for turn in (1, -1):
            ends = (x - half, y - turn * half), (x + half, y + turn * half)
            draw.line(ends, fill=fill, width=width)


def uav(
    draw: ImageDraw.ImageDraw, place: tuple[float, float], half: float, role: int | None
) -> None:
    """A UAV: a blue disc, within a shape in its role's colour if it has one."""
    x, y = place
    if role is not None:
        corners = [(x + half * right, y + half * down) for right, down in _SHAPES[role]]
        draw.polygon(corners, fill=ROLE_COLOURS[role], outline=NO_FIRE)
        half *= 0.5
    draw.ellipse((x - half, y - half, x + half, y + half), fill=UAV)
