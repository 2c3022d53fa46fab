"""Draws the figures of a run: training curves, timelapse."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from emberlink.trainers.evaluation.scores import CURVES
from emberlink.trainers.replay.recording import Recording
from emberlink.trainers.replay.screen import draw_step, even_steps


def training_curves(path: Path, lines: Sequence[Mapping[str, Any]], title: str) -> None:
    """Draws the paper's figures 5 to 9 for one run as PNG.

    Keys of `lines`, as in metrics.jsonl, are measures of the exploring policy, and "fire/measure"
    for the frozen policy on validation fires.
    """
    figure = Figure(figsize=(11, 6), layout="constrained")
    figure.suptitle(title)
    for axes, (name, label) in zip(figure.subplots(2, 3).flat, CURVES.items(), strict=True):
        fires = sorted({k for line in lines for k in line if k.endswith("/" + name)})
        for key in (name, *fires):
            points = [(line["episode"], line[key]) for line in lines if key in line]
            frozen = {"marker": "o", "ms": 3, "label": f"without noise, {key.split('/')[0]}"}
            style = frozen if key in fires else {"color": "0.6", "label": "with noise"}
            axes.plot(*np.reshape(points, (-1, 2)).T, **style)
        axes.set(xlabel="episode", ylabel=label)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.grid(alpha=0.3)
    for text in figure.axes[0].legend(fontsize="small").get_texts():
        text.set_parse_math(False)
    figure.savefig(path, format="png", dpi=120)


def timelapse(path: Path, episode: Recording) -> None:
    """Draws a row of up to five steps of an episode as PNG, as in the paper's figure 3."""
    steps = even_steps(episode.horizon, 5)
    figure = Figure(figsize=(2.4 * len(steps), 2.7), layout="constrained")
    for axes, step in zip(figure.subplots(1, len(steps), squeeze=False)[0], steps, strict=True):
        draw_step(axes, episode, step)
        axes.set_title(f"step {step}", fontsize="medium")
    figure.savefig(path, format="png", dpi=120)
