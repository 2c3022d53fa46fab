"""Draws the figures of a run: training curves, coverage, timelapse."""

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from emberlink.envs.rendering.frame import frame
from emberlink.trainers.evaluation.results import CURVES, LEARNED, Results
from emberlink.trainers.replay.recording import Recording
from emberlink.trainers.replay.screen import even_steps


def training_curves(path: Path, lines: Sequence[Mapping[str, Any]], title: str) -> None:
    """Draws the paper's figures 5 to 9 for one run.

    Args:
        path: a .png file.
        lines: lines of metrics.jsonl. Keys are measures of the exploring policy, and "fire/measure"
            for the frozen policy on validation fires.
        title: title of the figure.
    """
    figure = Figure(figsize=(11, 6), layout="constrained")
    figure.suptitle(title)
    for axes, (name, label) in zip(figure.subplots(2, 3).flat, CURVES.items(), strict=True):
        axes.plot(*_points(lines, name), color="0.6", label="with noise")
        for key in sorted({k for line in lines for k in line if k.endswith("/" + name)}):
            fire = key.split("/")[0]
            axes.plot(*_points(lines, key), marker="o", ms=3, label=f"without noise, {fire}")
        axes.set(xlabel="episode", ylabel=label)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.grid(alpha=0.3)
    for text in figure.axes[0].legend(fontsize="small").get_texts():
        text.set_parse_math(False)
    figure.savefig(path, format="png", dpi=120)


def _points(lines: Sequence[Mapping[str, Any]], key: str) -> NDArray[np.float32]:
    """Returns the episodes that have a measure, and its values, float32 [2, episodes].

    float32 makes absurd numbers of a damaged file infinite, which are not drawn.
    """
    points = [(line["episode"], line[key]) for line in lines if key in line]
    with np.errstate(over="ignore"):
        return np.array(points, np.float64).reshape(-1, 2).T.astype(np.float32)


def coverage_bars(path: Path, results: Results) -> None:
    """Draws the coverage of each policy on the test fires: a dot per episode, a bar at the mean."""
    most = max(len(by_policy) for by_policy in results.values())
    size = max(2.8, 1.6 + 0.55 * most) * len(results), 4.1
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(1, len(results), squeeze=False, sharey=True)[0]
    for axes, (fire, by_policy) in zip(panels, results.items(), strict=True):
        for place, (policy, measured) in enumerate(by_policy.items()):
            values = np.asarray(measured["coverage"])
            colour = "tab:orange" if policy == LEARNED else "0.75"
            axes.bar(place, values.mean(), color=colour)
            axes.annotate(
                f"{values.mean():.0f}",
                (place, 101),
                ha="center",
                va="bottom",
                fontsize="small",
                annotation_clip=False,
            )
            spread = place + np.linspace(-0.3, 0.3, len(values))
            axes.plot(spread, values, "k.", ms=2, alpha=0.4)
        names = [name.replace("_", " ") for name in by_policy]
        axes.set_xticks(range(len(by_policy)), names, rotation=35, ha="right")
        axes.set_title(f"test fires:\n{fire}", pad=18)
        axes.set_ylim(0, 100)
        axes.grid(axis="y", alpha=0.3)
        axes.set_axisbelow(True)
    panels[0].set_ylabel("coverage, % (mean above)")
    figure.savefig(path, format="png", dpi=120)


def timelapse(path: Path, episode: Recording, title: str = "") -> None:
    """Draws a row of up to five steps of an episode, as in the paper's figure 3.

    Args:
        path: a .png file.
        episode: the episode.
        title: title of the figure; none if empty.
    """
    steps = even_steps(episode.horizon, 5)
    figure = Figure(figsize=(2.4 * len(steps), 2.7), layout="constrained")
    for axes, step in zip(figure.subplots(1, len(steps), squeeze=False)[0], steps, strict=True):
        picture = frame(
            episode.fire_map(step),
            episode.steps["position"][step],
            view_angle=episode.world.view_angle,
            alive=episode.steps["alive"][step],
            base=episode.world.base,
        )
        axes.imshow(picture, interpolation="nearest")
        axes.set_title(f"step {step}", fontsize="medium")
        axes.set_axis_off()
    if title:
        figure.suptitle(textwrap.fill(title, 24 * len(steps)), parse_math=False)
    figure.savefig(path, format="png", dpi=120)
