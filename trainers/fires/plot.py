"""The picture of a fire: when it comes to which cell."""

import math
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.contour import QuadContourSet
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from matplotlib.patheffects import AbstractPathEffect, withStroke
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, map_coordinates

from .stats import Arrival, Team, burnt_out

NEVER, BURNT_OUT = "0.9", "0.45"
_COLOURS = "viridis"
_SIDE = 5.6  # inches of the map's longer side
_LINES = 6  # contours, about
_LETTERS = 10  # of the title, in an inch
_CELLS_PER_LINE = 8  # at least, that burn after step 0
_VIEW = "#ffff00"  # as in animations


def arrival_figure(path: Path, arrival: Arrival, horizon: int, team: Team, title: str) -> None:
    """Times of arrival as colours with contours, and the view of a UAV to scale.

    Args:
        path: a .png file.
        arrival: [X, Y], steps; inf never burns.
        horizon: steps of the episode.
        team: of which one UAV's view at full altitude is drawn.
        title: above the map.
    """
    across, up = arrival.shape
    scale = _SIDE / max(across, up)
    wide = across * scale > _SIDE / 2
    size = max(2.6, across * scale) + 1.9, max(2.0, up * scale) + (1.5 if wide else 2.0)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots()
    box = (-0.5, across - 0.5, -0.5, up - 0.5)
    shown = np.where(arrival <= horizon, arrival, np.nan).T
    core = burnt_out(arrival)
    never = ListedColormap([NEVER, BURNT_OUT])
    axes.imshow(core.T, cmap=never, vmin=0, vmax=1, origin="lower", extent=box)
    picture = axes.imshow(shown, cmap=_COLOURS, vmin=0, vmax=horizon, origin="lower", extent=box)
    _contours(axes, arrival, horizon)
    _view(axes, arrival, team.width)
    axes.set(xlim=box[:2], ylim=box[2:], xlabel="x, cells", ylabel="y, cells")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(nbins=7, integer=True))
    most = int(_LETTERS * size[0])
    short = title if len(title) <= most else f"{title[: most - 28]}...{title[-25:]}"
    figure.suptitle(short, parse_math=False, fontsize="medium")
    figure.colorbar(picture, ax=axes, label="time of arrival, steps", shrink=0.9)
    _legend(figure, bool(core.any()), team.width, max(across, up), 3 if wide else 1)
    figure.savefig(path, format="png", dpi=120, metadata={"Software": None})


def _legend(figure: Figure, core: bool, width: float, side: int, columns: int) -> None:
    """What the greys and the square mean, below the map."""
    view = f"view of one UAV, {width:.3g} cells wide"
    view += " (more than the map)" if width > side else ""
    samples = [
        *([Patch(fc=BURNT_OUT, label="burnt out before step 0")] if core else []),
        Patch(fc=NEVER, label="does not burn"),
        Patch(fc="none", ec=_VIEW, lw=2, path_effects=_around(4), label=view),
    ]
    place = "outside lower center"
    figure.legend(handles=samples, loc=place, ncols=columns, frameon=False, fontsize="small")


def _contours(axes: Axes, arrival: Arrival, horizon: int) -> None:
    """The front at round steps, fewer where little burns."""
    lines = min(_LINES, int(((arrival > 0) & (arrival <= horizon)).sum()) // _CELLS_PER_LINE)
    if lines == 0:
        return
    times = _continued(arrival, horizon)
    round_steps = MaxNLocator(nbins=lines + 1, steps=[1, 2, 2.5, 5, 10], integer=True)
    levels = [t for t in round_steps.tick_values(0, horizon) if 0 < t < min(horizon, times.max())]
    x, y = (np.arange(side) for side in arrival.shape)
    contours = axes.contour(x, y, times.T, levels=levels, colors="white", linewidths=1.1)
    contours.set_path_effects(_around(2.2))
    for (x, y), level in _label_places(contours, times):
        text = axes.text(x, y, f"{level:g}", fontsize="small", color="white")
        text.set(ha="center", va="center", path_effects=_around(2.2))


def _label_places(
    contours: QuadContourSet, times: NDArray[np.float64]
) -> Iterator[tuple[NDArray[np.float64], float]]:
    """For each contour where its neighbours are far and no label or edge is near, if anywhere."""
    along, up = np.gradient(times)
    steep = np.sqrt(along**2 + up**2)
    apart, taken = 0.09 * max(times.shape), []
    for level, path in zip(contours.levels, contours.get_paths(), strict=True):
        points = np.asarray(path.vertices)
        inside = ((points > apart / 3) & (points < np.array(times.shape) - 1 - apart / 3)).all(1)
        free = [p for p in points[inside] if all(math.dist(p, other) > apart for other in taken)]
        if free:
            slopes = map_coordinates(steep, np.transpose(free), order=1)
            taken.append(free[int(slopes.argmin())])
            yield taken[-1], float(level)


def _continued(arrival: Arrival, horizon: int) -> NDArray[np.float64]:
    """Times of arrival without gaps: contours would end where cells that never burn begin.

    Around the fire it arrives after the horizon, later the farther away; what is burnt out has
    been reached at step 0.
    """
    reached = arrival <= horizon
    times = np.where(reached, arrival, 0.0)
    if not reached.any():
        return times
    away = np.asarray(distance_transform_edt(~reached))
    beyond = horizon + away * horizon / max(arrival.shape)
    return np.where(reached | burnt_out(arrival), times, beyond)


def _view(axes: Axes, arrival: Arrival, width: float) -> None:
    """A UAV's view, in the corner of the map where the fewest cells burn."""
    free = 0.5  # between the square and the edge of the map
    corners = []
    for right, upper in product((True, False), repeat=2):
        x, y = (
            side - 0.5 - free - width if far else free - 0.5
            for side, far in zip(arrival.shape, (right, upper), strict=True)
        )
        i, j = (slice(max(0, math.floor(at)), max(1, math.ceil(at + width) + 1)) for at in (x, y))
        corners.append((np.isfinite(arrival[i, j]).sum(), not right, upper, x, y))
    *_, x, y = min(corners)
    square = Rectangle((x, y), width, width, fc="none", ec=_VIEW, lw=2)
    square.set_path_effects(_around(4))
    axes.add_patch(square)


def _around(width: float) -> list[AbstractPathEffect]:
    """A dark edge, with which a light line is seen on any colour."""
    return [withStroke(linewidth=width, foreground="black")]
