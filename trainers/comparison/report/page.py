"""Formats a comparison as rows of tables and as an HTML page."""

import base64
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from jinja2 import Environment, StrictUndefined

from emberlink.trainers.comparison import bootstrap
from emberlink.trainers.comparison.claims import Verdict
from emberlink.trainers.comparison.communication import CommunicationValue
from emberlink.trainers.comparison.rankings import Numbers, Ranking, Row
from emberlink.trainers.comparison.record import settings
from emberlink.trainers.comparison.runs import LeftOut

NONE = "-"
FLAG = "*"
"""mark of a number of seeds that is too small for an interval"""
DIGITS = {"mean_reward": 3, "boundary_exits": 2, "fire_losses": 2}
"""digits after the decimal point; 1 for other measures"""


@dataclass(frozen=True)
class Line:
    """The cells of a table row, as text."""

    name: str
    seeds: str
    mean: str
    interval: str
    probability: str
    next: str
    scripted: bool


@dataclass(frozen=True)
class Picture:
    """A PNG file and its caption."""

    path: Path
    caption: str

    @property
    def uri(self) -> str:
        """The file as a data URI."""
        return "data:image/png;base64," + base64.b64encode(self.path.read_bytes()).decode()


@dataclass(frozen=True)
class ReplayFile:
    """A page beside the report that plays one episode of several methods.

    Attributes:
        path: the page.
        fire: name of the scenario of the fire.
        methods: number of methods on the page.
    """

    path: Path
    fire: str
    methods: int


@dataclass(frozen=True)
class Chapter:
    """The part of the page about one section.

    Attributes:
        numbers: numbers of the section.
        frozen: figure of the frozen policies for each fire of the evaluation.
        figures: figures of the training.
        timelapses: timelapse of each method.
        replays: replay of the methods for each fire of a timelapse.
    """

    numbers: Numbers
    frozen: Sequence[Picture]
    figures: Sequence[Picture]
    timelapses: Sequence[Picture]
    replays: Sequence[ReplayFile]


@dataclass(frozen=True)
class Report:
    """The content of the page.

    Attributes:
        command: command line of the comparison.
        chapters: one chapter per section.
        left_out: folders and files that are not compared, with the reason.
        notes: differences between runs.
        replays: run folder -> address of its replay, for the runs that have one.
    """

    command: str
    chapters: Sequence[Chapter]
    left_out: Sequence[LeftOut]
    notes: Sequence[str]
    replays: Mapping[Path, str]


def lines(ranking: Ranking) -> Iterator[Line]:
    """Yields the rows of a ranking: the methods, best first, then the scripted policies."""
    digits = DIGITS.get(ranking.measure, 1)
    for row in ranking.rows:
        yield Line(
            name=row.method,
            seeds=f"{len(row.seeds)}{FLAG if len(row.seeds) < bootstrap.FEW else ''}",
            mean=f"{row.iqm:.{digits}f}",
            interval=_interval(row.interval, digits),
            probability=_probability(row),
            next=row.next or NONE,
            scripted=False,
        )
    for policy, values in ranking.scripted.items():
        most = max(values, key=lambda value: len(value.methods))
        for value in sorted(values, key=lambda value: value is most):
            several = value is most and len(value.methods) > 2
            whose = "all others" if several else ", ".join(value.methods)
            name = policy.replace("_", " ") + (f" ({whose})" if whose else "")
            yield Line(name, NONE, f"{value.value:.{digits}f}", NONE, NONE, NONE, scripted=True)


def _probability(row: Row) -> str:
    if row.probability_of_improvement is None:
        return NONE
    ends = row.probability_interval
    return f"{row.probability_of_improvement:.2f}" + (f" {_interval(ends, 2)}" if ends else "")


def heading(ranking: Ranking) -> str:
    """Returns the measure with its better direction, or the reason why it is not ranked."""
    if ranking.not_ranked:
        return f"{ranking.measure} (not ranked: {ranking.not_ranked})"
    return f"{ranking.measure} ({'more' if ranking.higher_is_better else 'less'} is better)"


def ratio(verdict: Verdict) -> tuple[str, str]:
    """Returns the ratio of a claim and its interval."""
    return _number(verdict.ratio, 2), _interval(verdict.interval, 2)


def decision(verdict: Verdict) -> str:
    """Returns the verdict of a claim, with a note if there are too few seeds."""
    seeds = verdict.fewest_seeds
    few = "" if seeds >= bootstrap.FEW else f" (only {seeds} seed{'s' if seeds > 1 else ''})"
    return verdict.verdict + few


def worth(value: CommunicationValue) -> tuple[str, ...]:
    """Returns the cells of a value of communication.

    Three means, the gain and its interval, the value and its interval.
    """
    digits = DIGITS.get(value.measure, 1)
    return (
        *(_number(mean, digits) for mean in (value.none, value.with_radio, value.full)),
        _number(value.gain, digits + 1),
        _interval(value.gain_interval, digits + 1),
        _number(value.value, 2),
        _interval(value.interval, 2),
    )


def counts(numbers: Numbers) -> list[int]:
    """Returns the number of seeds of each group."""
    return [len(group.runs) for group in numbers.section.groups]


def html(report: Report) -> str:
    """Returns the page as HTML without external files."""
    source = files("emberlink.trainers.comparison.report").joinpath("page.html").read_text("utf-8")
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.globals |= {
        "lines": lines,
        "heading": heading,
        "ratio": ratio,
        "worth": worth,
        "decision": decision,
        "counts": counts,
    }
    return environment.from_string(source).render(report=report, settings=settings())


def _number(value: float | None, digits: int) -> str:
    if value is None:
        return NONE
    return "∞" if math.isinf(value) else f"{value:.{digits}f}"


def _interval(ends: bootstrap.Interval | None, digits: int) -> str:
    if ends is None:
        return NONE
    return f"[{_number(ends[0], digits)}, {_number(ends[1], digits)}]"
