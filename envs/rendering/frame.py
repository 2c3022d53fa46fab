"""Draws a map with fields of view and UAVs in the paper's colours (section IV.A)."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from emberlink.envs.world.sensor import view_radius

NO_FIRE = (0, 0, 0)
FIRE = (255, 255, 255)
FIELD_OF_VIEW = (255, 255, 0)
UAV = (0, 0, 255)
BURNT_OUT = (72, 72, 72)
"""colour of a burnt-out cell that was seen while it burned"""
MISSED = (150, 60, 0)
"""colour of a burnt-out cell that was not seen while it burned"""
FAILED = (150, 150, 150)
BASE = (230, 0, 230)

Colour = tuple[int, int, int]
Pen = ImageDraw.ImageDraw


class Chart:
    """Draws a map: no fire black, fire white, burnt-out cells dark, fields of view yellow.

    Args:
        fire_map: uint8 [X, Y], see `WildfireEnv.fire_map`.
        position: [n, 3], cells.
        view_angle: half the opening angle of the cameras, degrees.
        scale: pixels per cell.
        seen_fire: the colour of seen fire.
        alive: bool [n], the UAVs that have not failed; the others see nothing. All if None.
        base: x and y of the base station, cells; None without one.
    """

    def __init__(
        self,
        fire_map: NDArray[np.uint8],
        position: NDArray[np.float32],
        *,
        view_angle: float,
        scale: int,
        seen_fire: Colour = FIRE,
        alive: NDArray[np.bool_] | None = None,
        base: Sequence[float] | None = None,
    ):
        self.scale = scale
        self._rows = fire_map.shape[1]
        self.image = Image.new("RGB", (fire_map.shape[0] * scale, self._rows * scale), NO_FIRE)
        self.pen = ImageDraw.Draw(self.image)
        flying = position if alive is None else position[alive]
        views = [self.square(x, y, view_radius(z, view_angle)) for x, y, z in flying.tolist()]
        for box in views:
            self.pen.rectangle(box, fill=FIELD_OF_VIEW)
        for value, colour in ((1, seen_fire), (2, FIRE), (3, BURNT_OUT), (4, MISSED)):
            cells = Image.fromarray(np.uint8(255) * (fire_map.T[::-1] == value))
            mask = cells.resize(self.image.size, Image.Resampling.NEAREST)
            self.image.paste(colour, mask=mask)
        line = max(2, scale // 6)
        for left, top, right, bottom in views:
            # The black line keeps the edge visible over fire and over other views.
            self.pen.rectangle((left - 1, top - 1, right + 1, bottom + 1), outline=NO_FIRE)
            self.pen.rectangle((left, top, right, bottom), outline=FIELD_OF_VIEW, width=line)
        if base is not None:
            draw_base(self.pen, self.point(*base), max(0.6 * scale, 6.0))

    def point(self, x: float, y: float) -> tuple[float, float]:
        """Returns the pixel of a point in cells; x grows to the right and y upwards."""
        return (x + 0.5) * self.scale, (self._rows - 0.5 - y) * self.scale

    def square(self, x: float, y: float, half: float) -> tuple[float, float, float, float]:
        """Returns the box, in pixels, of the square of 2 * half cells around a point."""
        (across, down), reach = self.point(x, y), max(half * self.scale, 0.5)
        return across - reach, down - reach, across + reach - 1, down + reach - 1

    def draw_uav(self, x: float, y: float, *, alive: bool = True) -> None:
        """Draws a UAV as a blue disc, or as a grey cross if it has failed."""
        half = max(0.45, 4 / self.scale)
        if alive:
            self.pen.ellipse(self.square(x, y, half), fill=UAV)
        else:
            draw_cross(self.pen, self.point(x, y), half * self.scale, FAILED)


def draw_base(pen: Pen, place: tuple[float, float], half: float) -> None:
    """Draws the base station as a magenta square with a white edge, 2 * half pixels wide."""
    x, y = place
    pen.rectangle((x - half, y - half, x + half, y + half), fill=BASE, outline=FIRE, width=2)


def draw_cross(pen: Pen, place: tuple[float, float], half: float, colour: Colour) -> None:
    """Draws a diagonal cross with dark edges, 2 * half pixels wide."""
    x, y = place
    for width, fill in ((4, NO_FIRE), (2, colour)):
        for turn in (1, -1):
            ends = (x - half, y - turn * half), (x + half, y + turn * half)
            pen.line(ends, fill=fill, width=width)


def frame(
    fire_map: NDArray[np.uint8],
    position: NDArray[np.float32],
    *,
    size: int = 360,
    alive: NDArray[np.bool_] | None = None,
    **chart: Any,
) -> NDArray[np.uint8]:
    """Returns a `Chart` with its UAVs, uint8 [Y * scale, X * scale, 3].

    `size` is the approximate number of pixels of the longer side of the grid.
    """
    scale = max(2, size // max(fire_map.shape))
    drawn = Chart(fire_map, position, scale=scale, alive=alive, **chart)
    for index, (x, y, _) in enumerate(position.tolist()):
        drawn.draw_uav(x, y, alive=alive is None or bool(alive[index]))
    return np.asarray(drawn.image)
