"""Draws marks on a map: the UAVs, their roles, targets and communication links."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from PIL import ImageDraw

from emberlink.envs.rendering.frame import FAILED, NO_FIRE, UAV, Chart, draw_cross

LINK = (0, 200, 255)
LINK_WIDTHS = {NO_FIRE: 4, LINK: 2}
"""width in pixels of each line of a link; the dark edge is drawn first"""
TARGET = (255, 140, 0)
ROLES = ("discoverer", "seeker", "wanderer")
"""the roles of UAVs in a consensus network (paper, section IV.F)"""
ROLE_COLOURS = ((230, 0, 60), (0, 150, 60), (215, 215, 215))
MANY = 16
"""number of UAVs above which links are thin and lines to targets are left out"""

# Corners of the shape of each role: offsets to the right and downwards, in half widths.
_DIAMOND = ((0, -1.3), (1.3, 0), (0, 1.3), (-1.3, 0))
_TRIANGLE = ((0, -1.4), (1.35, 1), (-1.35, 1))
_SQUARE = ((-1, -1), (1, -1), (1, 1), (-1, 1))
_SHAPES = (_DIAMOND, _TRIANGLE, _SQUARE)


@dataclass(frozen=True, kw_only=True, eq=False)
class FrameData:
    """The data of one picture: one environment at one step."""

    step: int
    """steps since the episode began"""
    seen: int
    """cells that a UAV has seen while they burned"""
    burnt: int
    """cells that burn or have burnt out"""
    fire_map: NDArray[np.uint8]
    """[X, Y], see `WildfireEnv.fire_map`"""
    position: NDArray[np.float32]
    """[n, 3], cells"""
    links: NDArray[np.bool_] | None = None
    """[r, r], whether a radio (row) hears another one; the base is last; None for no links"""
    roles: NDArray[np.int64] | None = None
    """[n], indices into `ROLES`; None without roles"""
    target: NDArray[np.float32] | None = None
    """[n, 3], the target of each UAV, cells; None without targets"""
    alive: NDArray[np.bool_] | None = None
    """[n], the UAVs that have not failed; all of them if None"""
    base: tuple[float, float] | None = None
    """x and y of the base station, cells; None without one"""

    @property
    def coverage(self) -> float:
        """Cells seen / cells burnt, in %; 100 where nothing has burnt."""
        return 100 * self.seen / self.burnt if self.burnt else 100.0

    def flies(self, uav: int) -> bool:
        """Returns whether a UAV has not failed."""
        return self.alive is None or bool(self.alive[uav])


def draw_marks(chart: Chart, data: FrameData) -> None:
    """Draws links, lines to targets, and UAVs on a map."""
    places = [chart.point(x, y) for x, y, _ in data.position.tolist()]
    half = mark_size(chart.scale)
    if data.links is not None:
        radios = [*places, *([chart.point(*data.base)] if data.base else [])]
        pairs = np.argwhere(np.triu(data.links | data.links.T, 1)).tolist()
        # The dark edges of many links would hide the map.
        widths = LINK_WIDTHS if len(places) <= MANY else {LINK: 1}
        for colour, width in widths.items():
            for i, j in pairs:
                chart.draw.line((radios[i], radios[j]), fill=colour, width=width)
    if data.target is not None:
        for index, (x, y, _) in enumerate(data.target.tolist()):
            if not data.flies(index):
                continue
            role = None if data.roles is None else int(data.roles[index])
            end, colour = chart.point(x, y), TARGET if role is None else ROLE_COLOURS[role]
            if len(places) <= MANY:
                dashes(chart.draw, places[index], end, colour)
            draw_cross(chart.draw, end, half * 0.6, colour)
    for index, (x, y, _) in enumerate(data.position.tolist()):
        if not data.flies(index):
            draw_cross(chart.draw, places[index], half, FAILED)
        elif data.roles is None:
            chart.uav(x, y)
        else:
            uav(chart.draw, places[index], half, int(data.roles[index]))


def mark_size(scale: int) -> float:
    """Returns half the width of a UAV's mark, pixels, on a chart of `scale` pixels per cell."""
    return min(max(0.55 * scale, 6.0), 9.0)


def dashes(
    draw: ImageDraw.ImageDraw,
    start: tuple[float, float],
    end: tuple[float, float],
    colour: tuple[int, int, int],
) -> None:
    """Draws a thin line with dashes and gaps of 4 pixels."""
    offset = np.subtract(end, start)
    length = float(np.hypot(*offset))
    stops = np.arange(0, length, 4)
    for dash, (near, far) in enumerate(pairwise([*stops, length])):
        if dash % 2 == 0:
            points = (tuple(np.add(start, offset * (stop / length))) for stop in (near, far))
            draw.line(tuple(points), fill=colour)


def uav(
    draw: ImageDraw.ImageDraw, place: tuple[float, float], half: float, role: int | None
) -> None:
    """Draws a UAV as a blue disc, within a shape in the colour of its role if it has one."""
    x, y = place
    if role is not None:
        corners = [(x + half * right, y + half * down) for right, down in _SHAPES[role]]
        draw.polygon(corners, fill=ROLE_COLOURS[role], outline=NO_FIRE)
        half *= 0.5
    draw.ellipse((x - half, y - half, x + half, y + half), fill=UAV)
