"""Draws the arrival times of a fire."""

from pathlib import Path

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes

NEVER, BURNT_OUT = "0.9", "0.45"


def arrival_figure(path: Path, arrival: NDArray[np.float32], horizon: int, title: str) -> None:
    """Draws arrival times [X, Y] as colours with contours."""
    figure = Figure(figsize=(7.5, 7.3), layout="constrained")
    axes, (across, up) = figure.subplots(), arrival.shape
    core = binary_fill_holes(arrival <= 0) & np.isinf(arrival)  # burnt before step 0
    greys = ListedColormap([NEVER, BURNT_OUT])
    axes.imshow(core.T, cmap=greys, vmin=0, vmax=1, origin="lower")
    shown = np.ma.masked_greater(arrival, horizon).T
    picture = axes.imshow(shown, cmap="viridis", vmin=0, vmax=horizon, origin="lower")
    levels = MaxNLocator(nbins=6, integer=True).tick_values(0, horizon)[1:-1]
    if shown.min() < levels[-1] and shown.max() > levels[0]:
        contours = axes.contour(shown, levels=levels, colors="white", linewidths=1.1)
        axes.clabel(contours, fmt="%g", fontsize="small")
    axes.set(xlim=(-0.5, across - 0.5), ylim=(-0.5, up - 0.5), xlabel="x, cells", ylabel="y, cells")
    figure.suptitle(title, parse_math=False, fontsize="medium")
    figure.colorbar(picture, ax=axes, label="arrival time, steps", shrink=0.9)
    samples = [
        Patch(fc=BURNT_OUT, label="burnt out before step 0"),
        Patch(fc=NEVER, label="does not burn"),
    ]
    figure.legend(handles=samples, loc="outside lower center", ncols=2, fontsize="small")
    figure.savefig(path, format="png", dpi=120, metadata={"Software": None})
