"""Draws the arrival times of a fire."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes, distance_transform_edt

NEVER, BURNT_OUT = "0.9", "0.45"
_VIEW = "#ffff00"  # as in animations
_SIDE = 5.6  # inches of the map's longer side


def arrival_figure(
    path: Path, arrival: NDArray[np.float32], horizon: int, width: float, title: str
) -> None:
    """Draws arrival times [X, Y] as colours with contours, and the `width` of a UAV's view."""
    across, up = arrival.shape
    scale = _SIDE / max(across, up)
    figure = Figure(
        figsize=(max(2.6, across * scale) + 1.9, max(2.0, up * scale) + 1.7), layout="constrained"
    )
    axes = figure.subplots()
    box = (-0.5, across - 0.5, -0.5, up - 0.5)
    reached = arrival <= horizon
    core = binary_fill_holes(arrival <= 0) & np.isinf(arrival)  # burnt before step 0
    greys = ListedColormap([NEVER, BURNT_OUT])
    axes.imshow(core.T, cmap=greys, vmin=0, vmax=1, origin="lower", extent=box)
    shown = np.where(reached, arrival, np.nan).T
    picture = axes.imshow(shown, cmap="viridis", vmin=0, vmax=horizon, origin="lower", extent=box)
    # Contours end at gaps, so that cells around the fire get later times.
    beyond = horizon + np.asarray(distance_transform_edt(~reached)) * horizon / max(across, up)
    times = np.where(reached | core, np.where(reached, arrival, 0.0), beyond)
    lines = min(6, int(((arrival > 0) & reached).sum()) // 8)
    steps = MaxNLocator(nbins=lines + 1, steps=[1, 2, 2.5, 5, 10], integer=True)
    levels = [t for t in steps.tick_values(0, horizon) if 0 < t < min(horizon, times.max())]
    if lines and levels:
        outline: Any = [withStroke(linewidth=2.2, foreground="black")]
        contours = axes.contour(times.T, levels=levels, colors="white", linewidths=1.1)
        for part in (contours, *axes.clabel(contours, fmt="%g", fontsize="small", inline=False)):
            part.set_path_effects(outline)
    samples = [
        *([Patch(fc=BURNT_OUT, label="burnt out before step 0")] if core.any() else []),
        Patch(fc=NEVER, label="does not burn"),
        Patch(fc="none", ec=_VIEW, lw=2, label=f"view of one UAV, {width:.3g} cells wide"),
    ]
    corner = (across - width - 1, up - width - 1)
    axes.add_patch(Rectangle(corner, width, width, fc="none", ec=_VIEW, lw=2))
    axes.set(xlim=box[:2], ylim=box[2:], xlabel="x, cells", ylabel="y, cells")
    short = title if len(title) <= 60 else f"{title[:32]}...{title[-25:]}"
    figure.suptitle(short, parse_math=False, fontsize="medium")
    figure.colorbar(picture, ax=axes, label="arrival time, steps", shrink=0.9)
    columns = 3 if across * scale > _SIDE / 2 else 1
    figure.legend(handles=samples, loc="outside lower center", ncols=columns, fontsize="small")
    figure.savefig(path, format="png", dpi=120, metadata={"Software": None})
