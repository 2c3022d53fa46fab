"""Lays a comparison out as tables of text and as an HTML page."""

import base64
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, StrictUndefined

from emberlink.envs import metrics
from emberlink.trainers.comparison.bootstrap import FEW
from emberlink.trainers.comparison.rankings import differing
from emberlink.trainers.comparison.results import Comparison, about
from emberlink.trainers.comparison.tables import Frame
from emberlink.trainers.evaluation.results import LEARNED

NONE = "-"
DIGITS = {"mean_reward": 3, "boundary_exits": 2, "fire_losses": 2}
"""digits after the decimal point; 1 for other measures"""
ENDS = "95 % interval"
NUMBERS = {"seeds", "IQM", ENDS, "P(better than the next)", "ratio", "gain", "value"} | {
    "radio off",
    "with radio",
    "no limits",
}
"""columns of numbers"""
Row = tuple[list[str], bool]
"""the cells, and whether the row is of a scripted policy"""


@dataclass(frozen=True)
class Table:
    """A table of text: columns, and a heading with rows for each group."""

    title: str
    caption: str
    columns: Sequence[str]
    groups: Sequence[tuple[str, Sequence[Row]]]


@dataclass(frozen=True)
class Picture:
    """A PNG file and its caption."""

    path: Path
    caption: str

    @property
    def uri(self) -> str:
        """The file as a data URI."""
        return "data:image/png;base64," + base64.b64encode(self.path.read_bytes()).decode()


def ranking_table(ranking: Frame) -> Table:
    """Returns the ranking of a section on one set of fires, a group for each measure."""
    groups: list[tuple[str, list[Row]]] = []
    for measure, part in ranking.groupby("measure", sort=False):
        better = "↑" if measure in metrics.HIGHER_IS_BETTER else "↓"
        why = part["not_ranked"].iloc[0]
        heading = f"{measure} (not ranked: {why})" if why else f"{measure} {better}"
        digits = DIGITS.get(str(measure), 1)
        groups.append((heading, [_ranked(row, digits) for row in part.to_dict("records")]))
    caption = (
        "IQM: interquartile mean over seeds; interval: bootstrap over seeds; ↑ more is better, "
        "↓ less is better. A scripted policy has no seeds: its number is the mean over the fires."
    )
    if ranking["seeds"].map(len).between(1, FEW - 1).any():
        caption += f" *: fewer than {FEW} seeds are too few for an interval to be trusted."
    columns = ("policy", "seeds", "IQM", ENDS, "P(better than the next)")
    return Table(f"on {ranking['fires'].iloc[0]}", caption, columns, groups)


def _ranked(row: Mapping[str, Any], digits: int) -> Row:
    seeds = len(row["seeds"])
    probability = _number(row["probability"], 2)
    if probability != NONE:
        probability += f" {_ends(row, 'probability_', 2)}"
    cells = [
        row["label"],
        f"{seeds}{'*' if seeds < FEW else ''}" if seeds else NONE,
        _number(row["iqm"], digits),
        _ends(row, "", digits),
        probability,
    ]
    return cells, row["policy"] != LEARNED


def communication_table(values: Frame) -> Table:
    """Returns the gains of messages of a section, a group for each set of fires."""
    caption = (
        "Gain: with the world's radio less with the radio off. Value: gain / (without limits less "
        "off), 0 where the radio adds nothing and 1 where it adds as much as one without limits. "
        "Intervals: over the fires for the same networks, over seeds and fires for retrained ones."
    )
    groups = [
        (str(fires), [_gain(row) for row in part.to_dict("records")])
        for fires, part in values.groupby("fires", sort=False)
    ]
    columns = ("policy", "radios", "radio off", "with radio", "no limits")
    columns += ("gain", ENDS, "value", ENDS)
    title = f"the gain of messages and the value of communication, by {values['measure'].iloc[0]}"
    return Table(title, caption, columns, groups)


def _gain(row: Mapping[str, Any]) -> Row:
    digits = DIGITS.get(row["measure"], 1)
    means = [_number(row[key], digits) for key in ("none", "with_radio", "full")]
    gain = [_number(row["gain"], digits + 1), _ends(row, "gain_", digits + 1)]
    value = [_number(row["value"], 2), _ends(row, "value_", 2)]
    return [row["label"], row["radios"], *means, *gain, *value], False


def claims_table(claims: Frame) -> Table:
    """Returns the verdicts of a section, a group for each label."""
    caption = (
        "Ratio: interquartile mean against that of the best other method, above 1 where the method "
        "is better. A claim holds if the whole interval is at or above the factor claimed, does "
        "not hold if all of it is below, and is undecided otherwise."
    )
    groups = [
        (str(label), [_claim(row) for row in part.to_dict("records")])
        for label, part in claims.groupby("label")
    ]
    columns = ("claim", "verdict", "ratio", ENDS, "best other", "fires")
    return Table("the paper's claims", caption, columns, groups)


def _claim(row: Mapping[str, Any]) -> Row:
    count = row["fewest_seeds"]
    few = "" if count >= FEW else f" (only {count} seed{'s' if count > 1 else ''})"
    ratio = _number(row["ratio"], 2)
    named = f"{row['claim']} ({row['measure']})"
    others = [row["best_other"], row["fires"]]
    return [named, row["verdict"] + few, ratio, _ends(row, "", 2), *others], False


def tables(comparison: Comparison, section: str) -> list[Table]:
    """Returns the tables of a section: rankings, the value of communication, claims."""
    ranking, gains, claims = (
        table[table["section"] == section]
        for table in (comparison.ranking, comparison.communication, comparison.claims)
    )
    found = [ranking_table(part) for _, part in ranking.groupby("fires", sort=False)]
    found += [communication_table(gains)] if len(gains) else []
    return found + ([claims_table(claims)] if len(claims) else [])


def details(runs: Frame, replays: Mapping[str, str]) -> list[Table]:
    """Returns tables of the settings in which the labels of a section differ, and of its runs."""
    apart = differing(runs)
    rows = [([str(label), *map(str, row)], False) for label, row in apart.iterrows()]
    settings = Table("Settings that differ", "", ["policy", *apart], [("", rows)])
    told: list[Row] = []
    for row in runs[runs["as_trained"]].to_dict("records"):
        about_run = [row["radio"], str(row["object"].settings["episodes"]), row["run"]]
        cells = [row["label"], str(row["seed"]), *about_run, replays.get(row["run"], "")]
        told.append((cells, False))
    columns = ("policy", "seed", "radio", "episodes of training", "folder", "replay")
    return [settings, Table("Runs", "", columns, [("", told)])]


def _number(value: float | None, digits: int) -> str:
    if value is None or math.isnan(value):
        return NONE
    return "∞" if math.isinf(value) else f"{value:.{digits}f}"


def _ends(row: Mapping[str, Any], name: str, digits: int) -> str:
    ends = [_number(row[f"{name}{end}"], digits) for end in ("low", "high")]
    return NONE if NONE in ends else f"[{', '.join(ends)}]"


@dataclass(frozen=True)
class Chapter:
    """The part of the page about one section."""

    title: str
    runs: Frame
    frozen: Sequence[Picture]
    training: Sequence[Picture]
    timelapses: Sequence[Picture]


def html(comparison: Comparison, chapters: Sequence[Chapter], replays: Mapping[str, str]) -> str:
    """Returns the page as HTML without external files.

    Args:
        comparison: the comparison.
        chapters: one chapter per section.
        replays: run folder -> address of its replay page, for the runs that have one.
    """
    source = files("emberlink.trainers.comparison").joinpath("page.html").read_text("utf-8")
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.from_string(source).render(
        comparison=comparison,
        chapters=chapters,
        replays=replays,
        settings=about(),
        tables=tables,
        details=details,
        numbers=NUMBERS,
    )
