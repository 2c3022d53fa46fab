"""Draws the paper's figures 5 to 9 and the results of frozen policies."""

import textwrap
from collections.abc import Sequence
from itertools import cycle
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from emberlink.envs import metrics
from emberlink.trainers.comparison.tables import Frame
from emberlink.trainers.evaluation.scores import CURVES, LEARNED

FIGURES = {
    5: (("mean_reward",), "Averaged rewards collected by all UAVs at each episode."),
    6: (("coverage",), "The share of the fire region that was seen, of all that burns."),
    7: (
        ("tracking_first", "tracking_last"),
        "The fastest (solid) and slowest (dotted) time taken by the UAVs to track the fire.",
    ),
    8: (("boundary_exits",), "Attempted moves out of the box, mean over UAVs."),
    9: (("fire_losses",), "Times a UAV fell out of the fire region, mean over UAVs."),
}
"""number of the figure in the paper -> measure of each panel, and the caption"""
COLOURS = (
    *("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#D55E00", "#56B4E9", "#8C6D00", "#000000"),
    *("#8CBFDD", "#F4D28C", "#8CD2BE", "#E8C1D7", "#ECB48C", "#AFDCF5", "#CBBB8C", "#999999"),
)
"""colours of labels, distinguishable with colour blindness (Okabe and Ito, 2008, with a darker
yellow), and the same lighter"""
DASHES = tuple((0, dash) for dash in ((7, 3), (7, 2, 1, 2), (3, 2), (12, 4), (1, 1), (1, 4)))
"""line styles of scripted policies"""
FROZEN = ("coverage", "tracking_first", "tracking_last", "boundary_exits")
"""measures of the figure of frozen policies, besides the world's headline"""
FROZEN_CAPTION = (
    "frozen policies. Small dots: each seed's mean over the fires. Large dot: interquartile mean "
    "over seeds; line: 95 % bootstrap interval, none with one seed. Dashed: scripted policies."
)
CURVES_CAPTION = (
    "The exploring policy in each episode of training, mean over its environments. Line: "
    "interquartile mean over seeds; band: 95 % bootstrap interval, none with one seed. Dashed: "
    "scripted policies, mean over held-out fires of the scenario trained on."
)


def training(
    curves: Frame, scripted: Frame, measures: Sequence[str], labels: Sequence[str]
) -> Figure:
    """Returns training curves: the interquartile mean over seeds and its interval for each label.

    Each measure has a panel, with the results of scripted policies on the fires trained on. Labels
    have the colours of `frozen`.
    """
    has_curve = set(curves["label"])
    colours = {label: c for label, c in zip(labels, cycle(COLOURS)) if label in has_curve}
    dashes = _dashes(scripted)
    lines = len(dashes) + sum(1 + _wrapped(name).count("\n") for name in colours)
    figure = Figure(figsize=(10.8, max(3.8, 0.4 + 0.2 * lines)), layout="constrained")
    panels = figure.subplots(1, len(measures), squeeze=False)[0]
    for axes, measure in zip(panels, measures, strict=True):
        for row in scripted[scripted["measure"] == measure].to_dict("records"):
            axes.axhline(row["iqm"], **dashes[row["label"]])
        for label, curve in curves[curves["measure"] == measure].groupby("label"):
            style = {"color": colours[label], "ls": ":" if measure == "tracking_last" else "-"}
            style |= {"lw": 2, "marker": "o" if len(curve) == 1 else "", "label": _wrapped(label)}
            axes.plot(curve["episode"], curve["iqm"], **style)
            if curve["low"].notna().all():
                ends = curve["low"], curve["high"]
                axes.fill_between(curve["episode"], *ends, color=colours[label], alpha=0.18, lw=0)
        axes.set(xlabel="episode of training", ylabel=CURVES.get(measure, measure))
        axes.xaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))
        axes.grid(alpha=0.3)
    return _with_legend(figure, panels[0])


def frozen(ranking: Frame, labels: Sequence[str]) -> Figure:
    """Returns the results of frozen policies: a row per label, a panel per measure.

    Rows are sorted by the first measure of `ranking`; `labels`, as trained, have colours.
    """
    is_learned = ranking["policy"] == LEARNED
    learned, scripted = ranking[is_learned], ranking[~is_learned]
    first = ranking["measure"].iloc[0]
    order = list(learned[learned["measure"] == first]["label"])[::-1]
    colours, dashes = dict(zip(labels, cycle(COLOURS))), _dashes(scripted)
    names = [_wrapped(name) for name in order]
    tall = sum(0.14 + 0.2 * (1 + name.count("\n")) for name in names)
    measures = [m for m in dict.fromkeys([first, *FROZEN]) if m in set(ranking["measure"])]
    size = 3.4 * len(measures), 1.5 + max(tall, 1.4)
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(1, len(measures), sharey=True, squeeze=False)[0]
    for axes, measure in zip(panels, measures, strict=True):
        for row in learned[learned["measure"] == measure].to_dict("records"):
            y, style = order.index(row["label"]), {"color": colours.get(row["label"], "0.45")}
            axes.plot(row["values"], [y] * len(row["values"]), "o", ms=3, alpha=0.5, **style)
            axes.plot([row["iqm"]], [y], "o", ms=6, **style)
            axes.plot([row["low"], row["high"]], [y, y], "|-", lw=2, ms=9, mew=1.5, **style)
        for row in scripted[scripted["measure"] == measure].to_dict("records"):
            axes.axvline(row["iqm"], **dashes[row["label"]])
        better = "more" if measure in metrics.HIGHER_IS_BETTER else "less"
        axes.set(xlabel=f"{CURVES.get(measure, measure)}\n({better} is better)")
        axes.set_ylim(-0.5, len(order) - 0.5)
        axes.grid(alpha=0.3, axis="x")
    panels[0].set_yticks(range(len(order)), names, parse_math=False)
    return _with_legend(figure, panels[0])


def _wrapped(label: str) -> str:
    return textwrap.fill(label, 34, break_on_hyphens=False)


def _dashes(scripted: Frame) -> dict[str, Any]:
    """Returns the line of each scripted policy."""
    style = {"color": "0.3", "lw": 1.3, "zorder": 1}
    return {
        name: {**style, "ls": dash, "label": _wrapped(f"scripted: {name}")}
        for name, dash in zip(sorted(scripted["label"].unique()), cycle(DASHES))
    }


def _with_legend(figure: Figure, axes: Axes) -> Figure:
    """Adds a legend of the lines of a panel that have labels."""
    if (handles := axes.get_legend_handles_labels())[0]:
        place = {"loc": "outside right upper", "frameon": False, "handlelength": 3}
        for text in figure.legend(*handles, **place).get_texts():
            text.set_parse_math(False)  # names are not formulas
    return figure
