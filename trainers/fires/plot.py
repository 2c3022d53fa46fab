"""Draws the arrival times of a fire."""

import math
from itertools import product
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from matplotlib.patheffects import AbstractPathEffect, withStroke
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from emberlink.trainers.fires.stats import Arrival, TeamCapability, burnt_out

NEVER, BURNT_OUT = "0.9", "0.45"
_COLOURS = "viridis"
_SIDE = 5.6  # inches of the map's longer side
_LINES = 6  # contours, about
_LETTERS = 10  # of the title, in an inch
_CELLS_PER_LINE = 8  # at least, that burn after step 0
_VIEW = "#ffff00"  # as in animations


def arrival_figure(
    path: Path, arrival: Arrival, horizon: int, team: TeamCapability, title: str
) -> None:
    """Draws arrival times as colours with contours, and the view of a UAV to scale.

    Args:
        path: a .png file.
        arrival: [X, Y], steps; inf never burns.
        horizon: steps of the episode.
        team: the team; the view of one UAV at full altitude is drawn.
        title: title above the map.
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
    figure.colorbar(picture, ax=axes, label="arrival time, steps", shrink=0.9)
    _legend(figure, bool(core.any()), team.width, max(across, up), 3 if wide else 1)
    figure.savefig(path, format="png", dpi=120, metadata={"Software": None})


def _legend(figure: Figure, core: bool, width: float, side: int, columns: int) -> None:
    """Adds a legend of the greys and the square below the map."""
    view = f"view of one UAV, {width:.3g} cells wide"
    view += " (more than the map)" if width > side else ""
    samples = [
        *([Patch(fc=BURNT_OUT, label="burnt out before step 0")] if core else []),
        Patch(fc=NEVER, label="does not burn"),
        Patch(fc="none", ec=_VIEW, lw=2, path_effects=_outline(4), label=view),
    ]
    place = "outside lower center"
    figure.legend(handles=samples, loc=place, ncols=columns, frameon=False, fontsize="small")


def _contours(axes: Axes, arrival: Arrival, horizon: int) -> None:
    """Draws the front at round steps, fewer if few cells burn."""
    lines = min(_LINES, int(((arrival > 0) & (arrival <= horizon)).sum()) // _CELLS_PER_LINE)
    if lines == 0:
        return
    times = _continued(arrival, horizon)
    round_steps = MaxNLocator(nbins=lines + 1, steps=[1, 2, 2.5, 5, 10], integer=True)
    levels = [t for t in round_steps.tick_values(0, horizon) if 0 < t < min(horizon, times.max())]
    x, y = (np.arange(side) for side in arrival.shape)
    contours = axes.contour(x, y, times.T, levels=levels, colors="white", linewidths=1.1)
    contours.set_path_effects(_outline(2.2))
    for text in axes.clabel(contours, fmt="%g", fontsize="small", inline=False):
        text.set_path_effects(_outline(2.2))


def _continued(arrival: Arrival, horizon: int) -> NDArray[np.float64]:
    """Fills the gaps in arrival times, because contours end at gaps.

    Cells around the fire get times after the horizon that grow with the distance. Cells that are
    burnt out get 0.
    """
    reached = arrival <= horizon
    times = np.where(reached, arrival, 0.0)
    if not reached.any():
        return times
    away = np.asarray(distance_transform_edt(~reached))
    beyond = horizon + away * horizon / max(arrival.shape)
    return np.where(reached | burnt_out(arrival), times, beyond)


def _view(axes: Axes, arrival: Arrival, width: float) -> None:
    """Draws the view of a UAV in the corner of the map with the fewest burning cells."""
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
    square.set_path_effects(_outline(4))
    axes.add_patch(square)


def _outline(width: float) -> list[AbstractPathEffect]:
    """Returns a dark outline, so that a light line is visible on any colour."""
    return [withStroke(linewidth=width, foreground="black")]
