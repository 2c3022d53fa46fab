"""Draws a map with fields of view and UAVs in the paper's colours (section IV.A)."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgba_array
from matplotlib.figure import Figure
from numpy.typing import NDArray

from emberlink.envs.world.sensor import view_radius

NO_FIRE, FIRE, FIELD_OF_VIEW = "#000000", "#ffffff", "#ffff00"
BURNT_OUT, MISSED = "#484848", "#963c00"
"""colours of burnt-out cells that were or were not seen while they burned"""
UAV: dict[str, Any] = {"color": "#0000ff", "marker": "o", "ms": 7, "mew": 0}
FAILED: dict[str, Any] = {"color": "#969696", "marker": "x", "ms": 9, "mew": 2}
BASE: dict[str, Any] = {"color": "#e600e6", "marker": "s", "ms": 9, "mec": FIRE}
"""marks, as keywords of `Axes.plot`"""
DPI = 100


def draw_map(
    axes: Axes,
    fire_map: NDArray[np.uint8],
    position: NDArray[np.float32],
    *,
    view_angle: float,
    seen_fire: str = FIRE,
    alive: NDArray[np.bool_] | None = None,
    base: Sequence[float] | None = None,
) -> None:
    """Draws a map: no fire black, fire white, burnt-out cells dark, fields of view yellow.

    Args:
        axes: x and y are cells; x grows to the right and y upwards.
        fire_map: uint8 [X, Y], see `WildfireEnv.fire_map`.
        position: [n, 3], cells.
        view_angle: half the opening angle of the cameras, degrees.
        seen_fire: the colour of seen fire.
        alive: bool [n], the UAVs that have not failed; the others see nothing. All if None.
        base: x and y of the base station, cells; None without one.
    """
    flies = np.ones(len(position), bool) if alive is None else alive
    cells = to_rgba_array([(0, 0, 0, 0), seen_fire, FIRE, BURNT_OUT, MISSED])
    axes.imshow((255 * cells).astype(np.uint8)[fire_map.T], origin="lower", zorder=1)
    axes.set(facecolor=NO_FIRE, xticks=[], yticks=[])
    corners = np.array([(-1, -1), (-1, 1), (1, 1), (1, -1)])
    places = position[flies, None, :2]
    reach = position[flies, None, 2:] * view_radius(1.0, view_angle)
    # The black line keeps the edge visible over fire and over other views.
    styles = (0.0, "face", 0), (0.12, NO_FIRE, 2), (0.0, FIELD_OF_VIEW, 2)
    for wider, colour, order in styles:
        face = FIELD_OF_VIEW if colour == "face" else "none"
        views = PolyCollection([*(places + (reach + wider) * corners)], facecolors=face)
        views.set(edgecolor=colour, linewidth=1.5, zorder=order, antialiased=False)
        axes.add_collection(views, autolim=False)
    mark(axes, position[~flies], **FAILED)
    mark(axes, position[flies], **UAV)
    if base is not None:
        mark(axes, np.array([base]), **BASE)


def mark(axes: Axes, places: NDArray[Any], zorder: float = 5, **style: Any) -> None:
    """Draws a mark at each place, [k, 2 or 3] in cells."""
    axes.plot(places[:, 0], places[:, 1], ls="", zorder=zorder, antialiased=False, **style)


def frame(
    fire_map: NDArray[np.uint8], position: NDArray[np.float32], *, size: int = 360, **drawn: Any
) -> NDArray[np.uint8]:
    """Returns a map, see `draw_map`, as uint8 [Y * scale, X * scale, 3].

    `size` is the approximate number of pixels of the longer side of the grid.
    """
    scale = max(2, size // max(fire_map.shape))
    inches: Any = [side * scale / DPI for side in fire_map.shape]
    figure = Figure(figsize=inches, dpi=DPI)
    draw_map(figure.add_axes((0, 0, 1, 1)), fire_map, position, **drawn)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3]
