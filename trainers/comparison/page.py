"""A comparison as text: rows of tables, the HTML page and the JSON beside it."""

import base64
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, StrictUndefined

from . import bootstrap as statistics
from .rankings import Numbers, Ranking, Verdict

NONE = "-"
FLAG = "*"
"""behind a number of seeds that is too small for an interval"""
DIGITS = {"mean_reward": 3, "boundary_exits": 2, "fire_losses": 2}
"""behind the point; of other measures one"""


@dataclass(frozen=True)
class Line:
    """A row of a table, as text."""

    name: str
    seeds: str
    mean: str
    interval: str
    improvement: str
    next: str
    scripted: bool


@dataclass(frozen=True)
class Picture:
    """A PNG file and what it shows."""

    path: Path
    caption: str

    @property
    def uri(self) -> str:
        """The picture as an address that holds it."""
        return "data:image/png;base64," + base64.b64encode(self.path.read_bytes()).decode()


@dataclass(frozen=True)
class Chapter:
    """What the page says of one setup."""

    numbers: Numbers
    frozen: Sequence[Picture]
    """a figure for each evaluation fire"""
    figures: Sequence[Picture]
    """of training"""
    timelapses: Sequence[Picture]


@dataclass(frozen=True)
class Report:
    """Everything that is on the page."""

    command: str
    chapters: Sequence[Chapter]
    left_out: Sequence[tuple[str, str]]
    """folder, why"""
    notes: Sequence[str]


def lines(ranking: Ranking) -> Iterator[Line]:
    """A ranking's rows: the methods, best first, then the scripted policies."""
    digits = DIGITS.get(ranking.measure, 1)
    for row in ranking.rows:
        yield Line(
            name=row.method,
            seeds=f"{len(row.seeds)}{FLAG if len(row.seeds) < statistics.FEW else ''}",
            mean=f"{row.iqm:.{digits}f}",
            interval=_interval(row.interval, digits),
            improvement=(
                NONE
                if row.improvement is None
                else f"{row.improvement:.2f}"
                + (f" {_interval(row.improvement_interval, 2)}" if row.improvement_interval else "")
            ),
            next=row.next or NONE,
            scripted=False,
        )
    for policy, each in ranking.scripted.items():
        for one in each:
            whose = f" ({', '.join(one.methods)})" if one.methods else ""
            mean = f"{one.value:.{digits}f}"
            name = policy.replace("_", " ") + whose
            yield Line(name, NONE, mean, NONE, NONE, NONE, scripted=True)


def heading(ranking: Ranking) -> str:
    """The measure and which way is better."""
    return f"{ranking.measure} ({'more' if ranking.higher_is_better else 'less'} is better)"


def ratio(verdict: Verdict) -> tuple[str, str]:
    """A claim's ratio and its interval."""
    return _number(verdict.ratio, 2), _interval(verdict.interval, 2)


def decision(verdict: Verdict) -> str:
    """What the runs say to a claim, with a flag where they are few."""
    return verdict.verdict + few(verdict.fewest_seeds)


def few(seeds: int) -> str:
    """A flag behind what rests on too few seeds."""
    return "" if seeds >= statistics.FEW else f" (only {seeds} seed{'s' if seeds > 1 else ''})"


def counts(numbers: Numbers) -> list[int]:
    """Seeds of each group."""
    return [len(group.runs) for group in numbers.section.groups]


def settings() -> dict[str, Any]:
    """What the statistics were made with."""
    return {
        "emberlink": version("emberlink"),
        "scipy": version("scipy"),
        "mean": "interquartile mean (scipy.stats.trim_mean, 0.25)",
        "interval": "percentile bootstrap, stratified by method (scipy.stats.bootstrap)",
        "level": statistics.LEVEL,
        "resamples": statistics.RESAMPLES,
        "bootstrap_seed": statistics.BOOTSTRAP_SEED,
        "few_seeds": statistics.FEW,
    }


def html(report: Report) -> str:
    """The page: it needs no other file and no address."""
    source = files("emberlink.trainers.comparison").joinpath("page.html").read_text("utf-8")
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.globals |= {
        "lines": lines,
        "heading": heading,
        "ratio": ratio,
        "decision": decision,
        "counts": counts,
    }
    return environment.from_string(source).render(report=report, settings=settings())


def record(report: Report) -> str:
    """Every number of the page as JSON; what is infinite is the text "inf"."""
    content = {
        "settings": settings(),
        "command": report.command,
        "left_out": [{"run": path, "why": why} for path, why in report.left_out],
        "notes": list(report.notes),
        "setups": [_chapter(chapter.numbers) for chapter in report.chapters],
    }
    return json.dumps(_finite(content), indent=1, allow_nan=False) + "\n"


def _chapter(numbers: Numbers) -> dict[str, Any]:
    section = numbers.section
    return {
        "setup": section.label,
        "trained_on": section.trained_on,
        "runs": [
            {
                "run": str(run.path),
                "method": group.label,
                "seed": run.config.seed,
                "episodes": run.config.episodes,
                "num_envs": run.config.num_envs,
                "evaluated_with": dict(run.evaluated_with),
                "checkpoint": run.evaluation.checkpoint,
                "held_out_fires": run.evaluation.fires,
            }
            for group in section.groups
            for run in group.runs
        ],
        "fires": {fire: [asdict(one) for one in all_] for fire, all_ in numbers.fires.items()},
        "claims": [asdict(verdict) for verdict in numbers.verdicts],
        "curves": {
            measure: {method: asdict(curve) for method, curve in by_method.items()}
            for measure, by_method in numbers.curves.items()
        },
    }


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(one) for one in value]
    return "inf" if isinstance(value, float) and math.isinf(value) else value


def _number(value: float, digits: int) -> str:
    return "∞" if math.isinf(value) else f"{value:.{digits}f}"


def _interval(ends: statistics.Interval | None, digits: int) -> str:
    if ends is None:
        return NONE
    return f"[{_number(ends[0], digits)}, {_number(ends[1], digits)}]"
