"""Draws the gains of a sweep of worlds."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes as Panel
from matplotlib.cm import ScalarMappable
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure

from emberlink.trainers.worlds.axes import Axes, World
from emberlink.trainers.worlds.sweep_folder import Line
from emberlink.trainers.worlds.worth import clear, nothing

_CELL = 0.26  # inches
_UNCLEAR = (0.93, 0.93, 0.93, 1.0)
_FONT = 8


def sweep_figure(path: Path, lines: Sequence[Line], axes: Axes, headline: str, title: str) -> None:
    """Draws a panel per grid and speed of the fire: teams down, ranges across.

    Args:
        path: a .png file.
        lines: the worlds of a sweep.
        axes: the values of the sweep.
        headline: the measure in which gains are counted.
        title: title of the figure.
    """
    by_world = {World(**{name: line[name] for name in World._fields}): line for line in lines}
    gains = [line[key][0] for line in lines for key in ("gain", "gain_all")]
    most = max(5.0, *map(abs, gains))
    scale = ScalarMappable(TwoSlopeNorm(0, -most, most), "RdBu")
    across, down = len(axes.ranges) + 2.4, len(axes.teams) + 0.6
    size = (
        max(5.0, _CELL * across * len(axes.speeds) + 1.5),
        max(2.2, _CELL * down * len(axes.grids) + 1.2),
    )
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(len(axes.grids), len(axes.speeds), squeeze=False)
    for row, grid in zip(panels, axes.grids, strict=True):
        for panel, speed in zip(row, axes.speeds, strict=True):
            worlds = [
                [by_world[World(speed, grid, uavs, reach)] for reach in axes.ranges]
                for uavs in axes.teams
            ]
            _panel(panel, worlds, scale)
        row[0].set_yticks(range(len(axes.teams)), list(map(str, axes.teams)), fontsize=_FONT)
        row[0].set_ylabel(f"{grid} x {grid} cells\nUAVs", fontsize=_FONT + 1)
    for panel, speed in zip(panels[0], axes.speeds, strict=True):
        panel.set_title(f"{speed:g} x the fire's speed", fontsize=_FONT + 1, pad=3)
    for panel in panels[-1]:
        labels = ["none", *(f"{reach:g}" for reach in axes.ranges), "all"]
        panel.set_xticks(range(len(labels)), labels, fontsize=_FONT)
    figure.supxlabel("messages: none (the measure), radio range in cells, all", fontsize=_FONT + 1)
    figure.suptitle(title, fontsize=_FONT + 2, parse_math=False)
    bar = figure.colorbar(scale, ax=panels, shrink=0.6, aspect=40, pad=0.01)
    bar.set_label(f"{headline} gained by messages, points", fontsize=_FONT + 1)
    bar.ax.tick_params(labelsize=_FONT)
    figure.savefig(path, format="png", dpi=160, metadata={"Software": None})


def _panel(panel: Panel, worlds: Sequence[Sequence[Line]], scale: ScalarMappable) -> None:
    """Draws the worlds of a grid and a speed: a row per team, a column per range."""
    columns = len(worlds[0]) + 2
    colours = np.ones((len(worlds), columns, 4))
    for y, row in enumerate(worlds):
        _, none, _, _ = row[0]["headline"]
        panel.text(0, y, f"{none:.0f}", ha="center", va="center", fontsize=_FONT, color="0.45")
        gains = [*(line["gain"] for line in row), row[0]["gain_all"]]
        for x, gain in enumerate(gains, 1):
            mean, _ = gain
            colours[y, x] = scale.to_rgba(mean) if clear(gain) else _UNCLEAR
            text = f"{mean:.0f}" if clear(gain) else "0" if nothing(gain) else ""
            dark = colours[y, x, :3].mean() < 0.5
            panel.text(
                *(x, y, text),
                ha="center",
                va="center",
                fontsize=_FONT,
                color="white" if dark else "black",
            )
    panel.imshow(colours, aspect="equal")
    for edge in (0.5, columns - 1.5):
        panel.axvline(edge, color="white", lw=2.5)
    panel.set_xticks([])
    panel.set_yticks([])
    panel.tick_params(length=0, pad=2)
    for spine in panel.spines.values():
        spine.set_visible(False)
