"""Computes the numbers of a section: rankings by measure, verdicts and training curves."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import zip_longest
from typing import NamedTuple, TypeVar

import numpy as np

from emberlink.envs import metrics
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import unknown
from emberlink.trainers.comparison import bootstrap
from emberlink.trainers.comparison.bootstrap import Interval
from emberlink.trainers.comparison.claims import Verdict, verdicts
from emberlink.trainers.comparison.communication import CommunicationValue, communication_values
from emberlink.trainers.comparison.groups import Group, Section
from emberlink.trainers.comparison.scripted import REWARD, Scripted, different_rewards, scripted
from emberlink.trainers.evaluation.evaluate import HELD_OUT_SCENARIO
from emberlink.trainers.evaluation.results import CURVES, LEARNED

T = TypeVar("T")


@dataclass(frozen=True)
class Row:
    """The result of a group for one measure.

    Attributes:
        method: label of the group.
        seeds: training seeds of the group.
        values: mean over the episodes of the run of each seed.
        iqm: interquartile mean over seeds.
        interval: interval of the IQM; None with one seed.
        next: label of the next group in the ranking; None for the last group, and if the measure is
            not ranked.
        probability_of_improvement: probability that a run is better than a run of the next group;
            None without a next group, and if both groups are evaluations of the same runs.
        probability_interval: interval of this probability; None with one seed.
    """

    method: str
    seeds: list[int]
    values: list[float]
    iqm: float
    interval: Interval | None
    next: str | None
    probability_of_improvement: float | None
    probability_interval: Interval | None


@dataclass(frozen=True)
class Ranking:
    """The ranking of groups by one measure on one fire.

    Attributes:
        measure: a name in `metrics.NAMES`.
        higher_is_better: whether more is better.
        rows: rows of the groups, best first; sorted by label if the measure is not ranked.
        scripted: results of each scripted policy.
        not_ranked: reason why the measure is not ranked, else empty.
    """

    measure: str
    higher_is_better: bool
    rows: list[Row]
    scripted: dict[str, list[Scripted]]
    not_ranked: str = ""


class Difference(NamedTuple):
    """The difference between the IQMs of two groups, first minus second.

    Attributes:
        value: the difference.
        interval: its interval; None if a group has only one seed.
    """

    value: float
    interval: Interval | None


@dataclass(frozen=True)
class Curve:
    """A measure of the exploring policy at every episode of training.

    Attributes:
        iqm: interquartile mean over seeds.
        low, high: ends of its interval; None with one seed.
    """

    iqm: list[float]
    low: list[float] | None
    high: list[float] | None


@dataclass(frozen=True)
class Numbers:
    """The numbers of a section.

    Attributes:
        section: the section.
        fires: fire of the evaluation -> ranking of each measure.
        verdicts: verdicts of the paper's claims.
        curves: measure -> label of the group -> curve.
        communication: the value of communication, where all evaluations that it needs are present.
        notes: differences between runs.
    """

    section: Section
    fires: dict[str, list[Ranking]]
    verdicts: list[Verdict]
    curves: dict[str, dict[str, Curve]]
    communication: list[CommunicationValue]
    notes: list[str] = field(default_factory=list)

    @property
    def on_trained(self) -> list[Ranking]:
        """The rankings on the training fire; empty if it was not evaluated."""
        return self.fires.get(self.section.trained_on, [])

    def difference(self, first: str, second: str, measure: str, fire: str) -> Difference:
        """Returns by how much the IQM of a group is above that of another, with its interval.

        Args:
            first, second: labels of the groups; the second is subtracted.
            measure: a name in `metrics.ALL`.
            fire: fire of the evaluation.

        Raises:
            UserError: a name is not known, the measure is not ranked, or both groups are
                evaluations of the same runs, which are not independent samples.
        """
        rankings = _known("fire", fire, self.fires)
        ranking = _known("measure", measure, {r.measure: r for r in rankings})
        if ranking.not_ranked:
            raise UserError(f"{measure} has no differences: {ranking.not_ranked}")
        groups = {group.label: group for group in self.section.groups}
        pair = [_known("method", label, groups) for label in (first, second)]
        if _same_trainings(*pair):
            raise UserError(f"{first!r} and {second!r} are evaluations of the same runs")
        rows = {row.method: row for row in ranking.rows}
        a, b = rows[first], rows[second]
        if a.iqm < b.iqm:  # The resamples depend on the order, so the higher is always the first.
            value, ends = self.difference(second, first, measure, fire)
            return Difference(-value, ends and (-ends[1], -ends[0]))
        ends = bootstrap.interval(bootstrap.iqm_difference, a.values, b.values)
        return Difference(a.iqm - b.iqm, ends)


def numbers(section: Section) -> Numbers:
    """Computes the rankings, verdicts and curves of a section."""
    fires = sorted(
        section.runs[0].evaluation.results, key=lambda name: (name != HELD_OUT_SCENARIO, name)
    )
    notes: list[str] = []
    rankings = {
        fire: [_ranking(section, fire, name, notes) for name in measures(section, fire)]
        for fire in fires
    }
    curves = {
        name: {group.label: _curve(group, name) for group in section.as_trained} for name in CURVES
    }
    told = verdicts(section, fires, notes)
    unique = list(dict.fromkeys(notes))
    return Numbers(section, rankings, told, curves, communication_values(section), unique)


def measures(section: Section, fire: str) -> list[str]:
    """Returns the measures of all runs of a section on a fire.

    The headline of the world is first, and the reward last, since methods may have different ones.
    """
    headline = section.runs[0].config.evaluation.headline
    known = [
        name
        for name in metrics.ALL
        if all(name in run.evaluation.results[fire][LEARNED] for run in section.runs)
    ]
    return sorted(known, key=lambda name: (name == REWARD, name != headline))


def _known(what: str, name: str, known: Mapping[str, T]) -> T:
    """Returns the entry with a name; raises a UserError if there is none."""
    if name not in known:
        raise UserError(f"{what} {unknown(name, known)}")
    return known[name]


def _ranking(section: Section, fire: str, measure: str, notes: list[str]) -> Ranking:
    higher = measure in metrics.HIGHER_IS_BETTER
    values = {g.label: [run.mean(fire, LEARNED, measure) for run in g.runs] for g in section.groups}
    means = {label: float(bootstrap.iqm(np.asarray(v))) for label, v in values.items()}
    why = different_rewards(section, fire) if measure == REWARD else ""
    order = list(section.groups)
    if not why:
        order.sort(key=lambda g: -means[g.label] if higher else means[g.label])
    rows: list[Row] = []
    for group, other in zip_longest(order, [] if why else order[1:]):
        sample = values[group.label]
        probability = ends = None
        if other is not None and not _same_trainings(group, other):
            pair = (sample, values[other.label]) if higher else (values[other.label], sample)
            better, worse = map(np.asarray, pair)
            probability = float(bootstrap.probability_of_improvement(better, worse))
            ends = bootstrap.interval(bootstrap.probability_of_improvement, *pair)
        rows.append(
            Row(
                method=group.label,
                seeds=group.seeds,
                values=sample,
                iqm=means[group.label],
                interval=bootstrap.interval(bootstrap.iqm, sample),
                next=other and other.label,
                probability_of_improvement=probability,
                probability_interval=ends,
            )
        )
    return Ranking(measure, higher, rows, scripted(section, fire, measure, notes), why)


def _same_trainings(first: Group, second: Group) -> bool:
    """Returns whether two groups are evaluations of the same runs."""
    return not {run.path for run in first.runs}.isdisjoint(run.path for run in second.runs)


def _curve(group: Group, measure: str) -> Curve:
    values = np.asarray([[line[measure] for line in run.lines] for run in group.runs], float)
    ends = bootstrap.band(values)
    low, high = (None, None) if ends is None else (ends[0].tolist(), ends[1].tolist())
    return Curve(bootstrap.iqm(values, 0).tolist(), low, high)
