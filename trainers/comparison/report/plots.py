"""Draws the paper's figures 5 to 9 and the results of frozen policies."""

import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, StrMethodFormatter

from emberlink.trainers.comparison.rankings import Curve, Numbers, Ranking
from emberlink.trainers.evaluation.results import CURVES

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
"""colours of methods, distinguishable with colour blindness (Okabe and Ito, 2008, with a darker
yellow), and the same lighter"""
DASHES = (
    *((0, (7, 3)), (0, (7, 2, 1, 2)), (0, (3, 2)), (0, (7, 2, 1, 2, 1, 2)), (0, (12, 4))),
    *((0, (3, 2, 1, 2)), (0, (12, 2, 3, 2)), (0, (1, 1)), (0, (1, 4)), (0, (12, 2, 1, 2, 1, 2))),
)
"""line styles of scripted policies, one for each that comes with emberlink"""
FROZEN = ("coverage", "tracking_first", "tracking_last", "boundary_exits")
"""measures of the figure of frozen policies; rows are sorted by the first"""
LOGARITHMIC = {"tracking_first": 1.0, "boundary_exits": 0.1}
"""measure with a logarithmic axis in that figure -> value below which the axis is linear"""
DOTTED = "tracking_last"
"""measure with dotted lines, as in the paper's figure 7"""


def figure(path: Path, numbers: Numbers, measures: tuple[str, ...]) -> None:
    """Draws training curves: the IQM over seeds and its interval for each method.

    Args:
        path: a .png file.
        numbers: numbers of a section.
        measures: measure of each panel.
    """
    colours = _colours(numbers)
    policies = _policies(numbers) if numbers.on_trained else {}
    lines = len(policies) + sum(1 + _wrapped(name).count("\n") for name in colours)
    wide = 9.2 if lines == len(policies) + len(colours) else 10.8
    figure = Figure(figsize=(wide, max(3.8, 0.4 + 0.2 * lines)), layout="constrained")
    panels = figure.subplots(1, len(measures), squeeze=False)[0]
    for axes, measure in zip(panels, measures, strict=True):
        _scripted_lines(axes, numbers, measure, policies, colours)
        _curves(axes, numbers.curves[measure], measure, colours)
        axes.set(xlabel="episode of training", ylabel=CURVES[measure])
        axes.xaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))
        axes.grid(alpha=0.3)
    _legend(figure, colours, policies)
    figure.savefig(path, dpi=120, metadata={"Software": None})


def frozen(path: Path, numbers: Numbers, fire: str) -> None:
    """Draws the results of frozen policies on a fire: a row per group, a panel per measure.

    Args:
        path: a .png file.
        numbers: numbers of a section.
        fire: a key of `numbers.fires`.
    """
    rankings = {ranking.measure: ranking for ranking in numbers.fires[fire]}
    order = [row.method for row in rankings[FROZEN[0]].rows][::-1]
    colours = _colours(numbers)
    policies = _policies(numbers)
    names = [_wrapped(name) for name in order]
    tall = sum(0.14 + 0.2 * (1 + name.count("\n")) for name in names)
    figure = Figure(figsize=(3.4 * len(FROZEN), 1.5 + max(tall, 1.4)), layout="constrained")
    panels = figure.subplots(1, len(FROZEN), sharey=True)
    for axes, measure in zip(panels, FROZEN, strict=True):
        _frozen_rows(axes, rankings[measure], order, colours)
        _frozen_scripted(axes, rankings[measure], order, policies)
        if measure in LOGARITHMIC:
            axes.set_xscale("symlog", linthresh=LOGARITHMIC[measure])
            axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axes.set_xlim(left=0)
        better = "more" if rankings[measure].higher_is_better else "less"
        axes.set(xlabel=f"{CURVES[measure]}\n({better} is better)")
        axes.set_ylim(-0.5, len(order) - 0.5)
        axes.grid(alpha=0.3, axis="x")
    panels[0].set_yticks(range(len(order)), names, parse_math=False)
    _legend(figure, {}, policies)
    figure.savefig(path, dpi=120, metadata={"Software": None})


def _frozen_rows(
    axes: Axes, ranking: Ranking, order: Sequence[str], colours: Mapping[str, str]
) -> None:
    """Draws the seeds, IQM and interval of each group in its row."""
    for row in ranking.rows:
        y, colour = order.index(row.method), colours.get(row.method, "0.45")
        axes.plot(row.values, [y] * len(row.values), "o", ms=3, color=colour, alpha=0.5)
        axes.plot([row.iqm], [y], "o", ms=6, color=colour)
        if row.interval is not None:
            axes.plot(row.interval, [y, y], "|-", lw=2, ms=9, mew=1.5, color=colour)


def _frozen_scripted(
    axes: Axes,
    ranking: Ranking,
    order: Sequence[str],
    policies: Mapping[str, tuple[int, tuple[int, ...]]],
) -> None:
    """Draws the result of each scripted policy as a line across the rows of its groups."""
    for policy, values in ranking.scripted.items():
        for result in values:
            rows = [order.index(name) for name in result.methods or order]
            for low, high in _stretches(rows):
                ends = [low - 0.5, high + 0.5]
                style = {"color": "0.3", "ls": policies[policy], "lw": 1.3}
                axes.plot([result.value] * 2, ends, **style, zorder=1)


def _stretches(places: Sequence[int]) -> Iterator[tuple[int, int]]:
    """Yields the first and the last of each run of consecutive rows."""
    ordered = sorted(places)
    starts = [i for i in ordered if i - 1 not in ordered]
    ends = [i for i in ordered if i + 1 not in ordered]
    yield from zip(starts, ends, strict=True)


def _wrapped(label: str) -> str:
    return textwrap.fill(label, 34, break_on_hyphens=False)


def _colours(numbers: Numbers) -> dict[str, str]:
    """Returns the colour of each group, by label."""
    groups = enumerate(numbers.section.as_trained)
    return {group.label: COLOURS[i % len(COLOURS)] for i, group in groups}


def _legend(
    figure: Figure,
    colours: Mapping[str, str],
    policies: Mapping[str, tuple[int, tuple[int, ...]]],
) -> None:
    handles = [
        Line2D([], [], color=colour, lw=2, label=_wrapped(name)) for name, colour in colours.items()
    ]
    handles += [
        Line2D([], [], color="0.3", ls=dash, lw=1.3, label=f"scripted: {name.replace('_', ' ')}")
        for name, dash in policies.items()
    ]
    if not handles:
        return
    legend = figure.legend(
        handles=handles, loc="outside right upper", frameon=False, handlelength=3
    )
    for text in legend.get_texts():  # names are not formulas
        text.set_parse_math(False)


def _curves(
    axes: Axes, curves: Mapping[str, Curve], measure: str, colours: Mapping[str, str]
) -> None:
    for label, curve in curves.items():
        episodes = range(1, len(curve.iqm) + 1)
        colour, style = colours[label], ":" if measure == DOTTED else "-"
        marker = "o" if len(episodes) == 1 else ""
        axes.plot(episodes, curve.iqm, color=colour, ls=style, lw=2, marker=marker)
        if curve.low is not None and curve.high is not None:
            axes.fill_between(episodes, curve.low, curve.high, color=colour, alpha=0.18, lw=0)


def _policies(numbers: Numbers) -> dict[str, tuple[int, tuple[int, ...]]]:
    """Returns the line style of each scripted policy, by name."""
    rankings = [ranking for on_fire in numbers.fires.values() for ranking in on_fire]
    names = sorted({policy for ranking in rankings for policy in ranking.scripted})
    return {name: DASHES[i % len(DASHES)] for i, name in enumerate(names)}


def _scripted_lines(
    axes: Axes,
    numbers: Numbers,
    measure: str,
    policies: Mapping[str, tuple[int, tuple[int, ...]]],
    colours: Mapping[str, str],
) -> None:
    """Draws the result of each scripted policy, in the colour of a group if it is of one group."""
    for ranking in (ranking for ranking in numbers.on_trained if ranking.measure == measure):
        for policy, results in ranking.scripted.items():
            for result in results:
                shown = [name for name in result.methods if name in colours]
                if shown or not result.methods:
                    colour = colours[shown[0]] if len(shown) == 1 else "0.3"
                    axes.axhline(result.value, color=colour, ls=policies[policy], lw=1.3, zorder=1)
