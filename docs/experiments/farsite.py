"""Compares the level set with runs of FARSITE. Rates fitted on one run apply to all.

    python docs/experiments/farsite.py FOLDER [--fit RUN] [--figure FILE.png]

FOLDER holds `RUN_ArrivalTime.asc`: ESRI ASCII grids of elapsed minutes, north up. The wind is read
from the whole name RUN: in `3mph120deg7hr` it blows from 120° (0 is north, clockwise); in
`clockwise1hr` and `counterClockwise3hr` it starts from 180° and turns by 60° in that sense every
hour or three hours.
The fitted head rate and length-to-breadth ratio apply to one wind speed and one fuel.
Prints a Markdown table. The initial fire is FARSITE's: the cells that burn at 0. Needs the extra
`geo`.
"""

import argparse
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from emberlink.envs.fire.level_set import (
    MAX_LENGTH_TO_BREADTH,
    Distance,
    arrival_times,
    ellipse_rates,
)
from emberlink.envs.fire_files.config import FileFireConfig
from emberlink.envs.fire_files.rasters import read_raster
from emberlink.envs.fire_files.report import Report

SUFFIX = "_ArrivalTime.asc"
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
    if not (steady or turning):
        raise ValueError(f"{name}: no wind in this name; known: 3mph120deg…, clockwise1hr, …")

    def azimuth(minutes: float) -> Tensor:
        bearing = float(steady[1]) if steady else 180.0
        if turning:
            turns = math.floor(minutes / (60 * int(turning[2])) + 1e-9)
            bearing += 60 * turns * (1 if turning[1] == "c" else -1)
        return torch.tensor([math.radians(270 - bearing)])

    return azimuth


def read_grid(path: Path) -> Tensor:
    """Returns the arrival times of an ESRI ASCII grid, as in `Run`."""
    try:
        config = FileFireConfig(path=str(path), units="minutes", unburned="none")
        times = read_raster(path, "asc", config, 0, Report())[0].times
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return torch.from_numpy(times[::-1].T.copy()).float()


def read_runs(folder: Path) -> dict[str, Run]:
    """Returns the runs in a folder, in alphabetical order."""
    files = sorted(folder.glob(f"*{SUFFIX}"))
    if not files:
        raise ValueError(f"{folder}: no *{SUFFIX} in it")
    names = [file.name.removesuffix(SUFFIX) for file in files]
    return {n: Run(n, read_grid(f), wind_of(n)) for n, f in zip(names, files, strict=True)}


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


def overlap(got: Tensor, run: Run, minutes: float) -> float:
    """Returns the intersection over union of the cells burnt by a time."""
    ours, theirs = got <= minutes, run.arrival <= minutes
    return float((ours & theirs).sum() / (ours | theirs).sum())


def compare(run: Run, got: Tensor) -> tuple[list[float], float, float]:
    """Returns overlaps at `PARTS` of the run, final ratio of areas, mean error of arrival, minutes.

    The error is taken over cells that burn in both, without the initial fire.
    """
    overlaps = [overlap(got, run, part * run.end) for part in PARTS]
    both = got.isfinite() & run.arrival.isfinite() & (run.arrival > 0)
    error = float((got - run.arrival)[both].abs().mean())
    return overlaps, float(got.isfinite().sum() / run.arrival.isfinite().sum()), error


def draw(runs: list[tuple[Run, Tensor]], file: str) -> None:
    """Draws both fronts of every run for each hour."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt
    from matplotlib.lines import Line2D

    size = (3.1 * len(runs), 3.9)
    figure, panels = plt.subplots(1, len(runs), figsize=size, layout="constrained", squeeze=False)
    for panel, (run, got) in zip(panels[0], runs, strict=True):
        hours = np.arange(60, run.end + 1, 60)
        for values, colour, style in ((run.arrival, "black", "-"), (got, "tab:red", "--")):
            late = values.clamp_max(2 * run.end).T
            panel.contour(late, levels=hours, colors=colour, linestyles=style, linewidths=0.9)
        panel.contourf((run.arrival <= 0).T.float(), levels=[0.5, 1], colors="0.75")
        panel.set(title=run.name, aspect="equal", xticks=[], yticks=[])
    handles = [Line2D([], [], color="black"), Line2D([], [], color="tab:red", linestyle="--")]
    figure.legend(handles, ["FARSITE", "level set"], loc="outside lower center", ncols=2)
    figure.savefig(file, dpi=110)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--fit", help="the run to fit on, by default the first")
    parser.add_argument("--figure", help="file to draw both fronts to")
    given = parser.parse_args(arguments)
    try:
        runs = read_runs(given.folder)
        name = given.fit or next(iter(runs))
        if name not in runs:
            raise ValueError(f"unknown run {name!r}; known: {', '.join(runs)}")
    except (OSError, ValueError) as error:
        parser.error(str(error))
    head_rate, ratio = fit(runs[name])
    print(f"fitted on {name}: {head_rate:.4f} cells a minute, length-to-breadth {ratio:.3f}\n")
    done = [(run, simulate(run, head_rate, ratio)) for run in runs.values()]
    times = " | ".join(f"IoU at {part:.0%}" for part in PARTS)
    print(f"| run | {times} | area ratio | error of arrival, min |")
    print("|---|" + "---|" * (len(PARTS) + 2))
    for run, got in done:
        overlaps, area, error = compare(run, got)
        row = " | ".join(f"{value:.3f}" for value in overlaps)
        print(f"| `{run.name}` | {row} | {area:.3f} | {error:.1f} |")
    if given.figure:
        draw(done, given.figure)


if __name__ == "__main__":
    main()
