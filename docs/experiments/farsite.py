"""Compares the level set with runs of FARSITE. Rates fitted on one run apply to all.

    python docs/experiments/farsite.py FOLDER [FIGURE.png]

FOLDER holds `RUN_ArrivalTime.asc`, elapsed minutes. In a RUN called `3mph120deg7hr` the wind blows
from 120° (0 is north, clockwise); in `clockwise1hr` and `counterClockwise3hr` from 180°, turning by
60° in that sense every hour or three hours. The rates are fitted on the first run. Prints a table
in Markdown. The initial fire is FARSITE's: the cells that burn at 0. Needs the extra `geo`.
"""

import math
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import rasterio
import torch
from matplotlib.figure import Figure
from scipy.optimize import minimize
from torch import Tensor

from emberlink.envs.fire.level_set import (
    MAX_LENGTH_TO_BREADTH,
    Distance,
    arrival_times,
    ellipse_rates,
)

PARTS = (0.25, 0.5, 0.75, 1.0)
"""of a run's length: when the two are compared"""


class Run(NamedTuple):
    """Holds one run of FARSITE."""

    name: str
    arrival: Tensor
    """[X, Y], minutes, x to the east and y to the north; inf where it did not burn"""
    wind: Callable[[float], Tensor]
    """from minutes to the azimuth towards which the head runs, radians [1]"""

    @property
    def end(self) -> float:
        """Returns the time of the last arrival, rounded to minutes."""
        return float(math.ceil(self.arrival[self.arrival.isfinite()].max()))


def wind_of(name: str) -> Callable[[float], Tensor]:
    """Returns the azimuth of a run's wind as a function of the minutes."""
    steady = re.fullmatch(r"\d+mph(\d+)deg(\d+hr)?", name)
    turning = re.fullmatch(r"(c|counterC)lockwise(\d+)hr", name)

    def azimuth(minutes: float) -> Tensor:
        bearing = float(steady[1]) if steady else 180.0
        if turning:
            turns = math.floor(minutes / (60 * int(turning[2])) + 1e-9)
            bearing += 60 * turns * (1 if turning[1] == "c" else -1)
        return torch.tensor([math.radians(270 - bearing)])

    return azimuth


def read_run(path: Path) -> Run:
    """Returns the run of an ESRI ASCII grid."""
    with rasterio.open(path) as dataset:
        times = dataset.read(1, masked=True).filled(np.inf)
    name = path.name.removesuffix("_ArrivalTime.asc")
    return Run(name, torch.from_numpy(times[::-1].T.copy()).float(), wind_of(name))


def around(mask: Tensor) -> Distance:
    """Returns the signed distance to the outline of unit cells, bool [X, Y]."""
    ring = torch.nn.functional.max_pool2d(mask[None].float(), 3, 1, 1)[0] > 0

    def to_squares(cells: Tensor, x: Tensor, y: Tensor) -> Tensor:
        i, j = cells.nonzero().to(x).unbind(1)
        dx = ((x[:, None] - i).abs() - 0.5).clamp_min(0)
        dy = ((y[:, None] - j).abs() - 0.5).clamp_min(0)
        return torch.hypot(dx[:, None], dy[None]).amin(2)

    def distance(x: Tensor, y: Tensor) -> Tensor:
        outside, inside = (to_squares(c, x.flatten(), y.flatten()) for c in (mask, ring & ~mask))
        return torch.where(outside > 0, outside, -inside)[None]

    return distance


def simulate(run: Run, head_rate: float, ratio: float) -> Tensor:
    """Computes arrival times from the initial fire and the wind of a run, minutes [X, Y]."""
    x, y = run.arrival.shape
    rates = torch.tensor([head_rate]), torch.tensor([ratio])
    start = around(run.arrival <= 0)
    return arrival_times(start, (x, y), *rates, run.wind, horizon=run.end, refine=1)[0]


def misfit(got: Tensor, run: Run) -> float:
    """Returns the mean difference of arrival, minutes; unburnt cells have the end time."""
    return float((got.clamp_max(run.end) - run.arrival.clamp_max(run.end)).abs().mean())


def fit(run: Run) -> tuple[float, float]:
    """Fits the head rate, cells per minute, and the length-to-breadth ratio to a run."""

    def rates(logs: np.ndarray) -> tuple[float, float]:
        # Parameters are the growth rate of the equivalent radius and the ratio's excess over 1,
        # both as logarithms, since they are positive and nearly independent.
        growth, ratio = math.exp(logs[0]), min(1 + math.exp(logs[1]), MAX_LENGTH_TO_BREADTH)
        a, b, c = (float(rate) for rate in ellipse_rates(1.0, ratio))
        return growth * (a + c) / math.sqrt(a * b), ratio

    cells = int(run.arrival.isfinite().sum())
    guess = [math.log(math.sqrt(cells / math.pi) / run.end), math.log(0.3)]
    options = {"xatol": 2e-3, "fatol": 1e-3}
    cost = lambda logs: misfit(simulate(run, *rates(logs)), run)  # noqa: E731
    return rates(minimize(cost, guess, method="Nelder-Mead", options=options).x)


def compare(run: Run, got: Tensor) -> tuple[list[float], float, float]:
    """Returns overlaps at `PARTS` of the run, final ratio of areas, mean error of arrival, minutes.

    An overlap is the intersection over union of the burnt cells. The error is taken over cells that
    burn in both, without the initial fire.
    """
    pairs = [(got <= part * run.end, run.arrival <= part * run.end) for part in PARTS]
    overlaps = [float((ours & theirs).sum() / (ours | theirs).sum()) for ours, theirs in pairs]
    both = got.isfinite() & run.arrival.isfinite() & (run.arrival > 0)
    error = float((got - run.arrival)[both].abs().mean())
    return overlaps, float(got.isfinite().sum() / run.arrival.isfinite().sum()), error


def main(folder: str, figure: str | None = None) -> None:
    """Prints the table, and draws both fronts of every run for each hour."""
    runs = [read_run(path) for path in sorted(Path(folder).glob("*_ArrivalTime.asc"))]
    rates = fit(runs[0])
    print(f"fitted on {runs[0].name}: {rates[0]:.4f} cells a minute, breadth {rates[1]:.3f}\n")
    print(
        "| run | IoU at 25, 50, 75, 100 % | area ratio | error of arrival, min |\n|---|---|---|---|"
    )
    picture = Figure((3.1 * len(runs), 3.9), layout="constrained")
    for panel, run in zip(picture.subplots(1, len(runs), squeeze=False)[0], runs, strict=True):
        overlaps, area, error = compare(run, got := simulate(run, *rates))
        shares = ", ".join(f"{value:.3f}" for value in overlaps)
        print(f"| `{run.name}` | {shares} | {area:.3f} | {error:.1f} |")
        for values, colour, style in ((run.arrival, "black", "-"), (got, "tab:red", "--")):
            late, hours = values.clamp_max(2 * run.end).T, np.arange(60, run.end + 1, 60)
            panel.contour(late, levels=hours, colors=colour, linestyles=style, linewidths=0.9)
        panel.contourf((run.arrival <= 0).T.float(), levels=[0.5, 1], colors="0.75")
        panel.set(title=run.name, aspect="equal", xticks=[], yticks=[])
    picture.suptitle("FARSITE (black) and the level set (red, dashed)")
    if figure:
        picture.savefig(figure, dpi=110)


if __name__ == "__main__":
    main(*sys.argv[1:])
