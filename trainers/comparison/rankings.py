"""The numbers of a comparison: tables, claims and curves of the gathered runs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import zip_longest

import numpy as np

from emberlink.envs import metrics
from emberlink.policies.scripted.registry import SCRIPTED
from emberlink.trainers.evaluation.evaluate import HELD_OUT_SCENARIO
from emberlink.trainers.evaluation.results import CURVES, LEARNED

from . import bootstrap as statistics
from .bootstrap import Interval
from .runs import Group, Section

SAME = 1e-5
"""Scripted policies on the same fires differ by less than this share, on whatever device."""
BY_METHOD = frozenset({"mean_reward"})
"""The measures that a scripted policy may have another number of for each method: a method's
reward may differ."""


@dataclass(frozen=True)
class Claim:
    """A method is better than the best other by a factor."""

    method: str
    measure: str
    factor: float
    text: str


CLAIMS = (
    Claim("consensus", "coverage", 1.3, "1.3 times the coverage"),
    Claim("consensus", "tracking_first", 1.4, "1.4 times faster tracking"),
    Claim("consensus", "tracking_last", 1.4, "1.4 times faster tracking, by the slowest UAV"),
    Claim("consensus", "boundary_exits", 2.0, "half the boundary exits"),
)
"""of the paper, sections V and VI, for method 4 against the next best"""


@dataclass(frozen=True)
class Row:
    """A method's place in the ranking by one measure."""

    method: str
    seeds: list[int]
    values: list[float]
    """a run's mean over its episodes, for each seed"""
    iqm: float
    interval: Interval | None
    """None with one seed"""
    next: str | None
    """the method ranked next; None for the last"""
    improvement: float | None
    """probability that a run is better than a run of the next; None where these are the same
    trainings, evaluated in another world"""
    improvement_interval: Interval | None


@dataclass(frozen=True)
class Scripted:
    """What a scripted policy comes to."""

    methods: list[str]
    """whose number it is; none where it is the same for all"""
    value: float
    """the mean over episodes"""


@dataclass(frozen=True)
class Ranking:
    """One measure on one fire."""

    measure: str
    higher_is_better: bool
    rows: list[Row]
    """best first"""
    scripted: dict[str, list[Scripted]]
    """by policy"""


@dataclass(frozen=True)
class Verdict:
    """What the runs say to a claim, on one fire."""

    fire: str
    method: str
    claim: str
    measure: str
    factor: float
    best_other: str
    ratio: float
    """of the IQMs, above 1 where the method is better; infinite for a ratio to 0"""
    interval: Interval | None
    verdict: str
    """holds, does not hold, or undecided"""
    fewest_seeds: int


@dataclass(frozen=True)
class Curve:
    """A measure of the exploring policy over training, at every episode."""

    iqm: list[float]
    low: list[float] | None
    """None with one seed"""
    high: list[float] | None


@dataclass(frozen=True)
class Numbers:
    """Everything that is known of a section."""

    section: Section
    fires: dict[str, list[Ranking]]
    """by evaluation fire, a ranking per measure"""
    verdicts: list[Verdict]
    curves: dict[str, dict[str, Curve]]
    """measure -> method -> curve"""
    notes: list[str] = field(default_factory=list)

    @property
    def on_trained(self) -> list[Ranking]:
        """The rankings on the fire trained on, if it was evaluated."""
        return self.fires.get(self.section.trained_on, [])


def numbers(section: Section) -> Numbers:
    """Tables, claims and curves of one section."""
    fires = sorted(
        section.runs[0].evaluation.results, key=lambda name: (name != HELD_OUT_SCENARIO, name)
    )
    notes: list[str] = []
    rankings = {
        fire: [_ranking(section, fire, name, notes) for name in metrics.NAMES] for fire in fires
    }
    verdicts = [
        verdict
        for fire in fires
        for claim in CLAIMS
        for group in section.as_trained
        if group.method == claim.method
        for verdict in _verdict(section, fire, claim, group)
    ]
    curves = {name: {g.label: _curve(g, name) for g in section.as_trained} for name in CURVES}
    return Numbers(section, rankings, verdicts, curves, list(dict.fromkeys(notes)))


def _of(group: Group, fire: str, measure: str) -> list[float]:
    return [run.mean(fire, LEARNED, measure) for run in group.runs]


def _ranking(section: Section, fire: str, measure: str, notes: list[str]) -> Ranking:
    higher = measure in metrics.HIGHER_IS_BETTER
    values = {group.label: _of(group, fire, measure) for group in section.groups}
    means = {label: float(statistics.iqm(np.asarray(own))) for label, own in values.items()}
    order = sorted(section.groups, key=lambda g: -means[g.label] if higher else means[g.label])
    rows: list[Row] = []
    for group, other in zip_longest(order, order[1:]):
        own = values[group.label]
        probability = ends = None
        if other is not None and not _same_trainings(group, other):
            pair = (own, values[other.label]) if higher else (values[other.label], own)
            probability = float(statistics.improvement(np.asarray(pair[0]), np.asarray(pair[1])))
            ends = statistics.interval(statistics.improvement, *pair)
        rows.append(
            Row(
                method=group.label,
                seeds=group.seeds,
                values=own,
                iqm=means[group.label],
                interval=statistics.interval(statistics.iqm, own),
                next=other and other.label,
                improvement=probability,
                improvement_interval=ends,
            )
        )
    return Ranking(measure, higher, rows, _scripted(section, fire, measure, notes))


def _same_trainings(one: Group, other: Group) -> bool:
    return not {run.path for run in one.runs}.isdisjoint(run.path for run in other.runs)


def _scripted(
    section: Section, fire: str, measure: str, notes: list[str]
) -> dict[str, list[Scripted]]:
    """A scripted policy's mean over episodes; for each method where theirs differ."""
    policies = dict.fromkeys(p for run in section.runs for p in run.evaluation.results[fire])
    found: dict[str, list[Scripted]] = {}
    for policy in sorted(policies.keys() - {LEARNED}):
        each = {
            group.label: [
                run.mean(fire, policy, measure)
                for run in group.runs
                if policy in run.evaluation.results[fire]
            ]
            for group in section.groups
        }
        seen = [number for own in each.values() for number in own]
        if len(seen) < len(section.runs):
            notes.append(f"{section.label}: {policy} was played for {len(seen)} of the runs only")
        own_world = measure in BY_METHOD or _in_worlds_of_their_own(section, policy)
        for own in each.values() if own_world else [seen]:
            if own and not _same(own):
                notes.append(
                    f"{section.label}: {policy} does not have the same {measure} on {fire} in all "
                    f"runs ({min(own):.6g} to {max(own):.6g}): they were not evaluated on the same "
                    "fires and starts, or with another version"
                )
        found[policy] = _by_methods({label: own[0] for label, own in each.items() if own})
    return found


def _in_worlds_of_their_own(section: Section, policy: str) -> bool:
    """Whether a policy that follows what it hears hears something else for each group."""
    if policy not in SCRIPTED or SCRIPTED[policy].recipe is None:
        return False
    worlds = [run.evaluation.communication.get(policy) for run in section.runs]
    return any(world != worlds[0] for world in worlds)


def _by_methods(each: Mapping[str, float]) -> list[Scripted]:
    """The numbers of several methods, equal ones once."""
    alike: list[Scripted] = []
    for method, value in each.items():
        same = next((one for one in alike if _same([value, one.value])), None)
        if same is None:
            alike.append(Scripted([method], value))
        else:
            same.methods.append(method)
    return alike if len(alike) > 1 else [Scripted([], one.value) for one in alike]


def _same(values: Sequence[float]) -> bool:
    return max(values) - min(values) <= SAME * max(1.0, *map(abs, values))


def _verdict(section: Section, fire: str, claim: Claim, group: Group) -> list[Verdict]:
    others = [other for other in section.as_trained if other.method != group.method]
    if not others:
        return []
    higher = claim.measure in metrics.HIGHER_IS_BETTER
    samples = [_of(one, fire, claim.measure) for one in (group, *others)]
    share = partial(statistics.advantage, higher=higher)
    ends = statistics.interval(share, *samples)
    ratios = ends and (statistics.as_ratio(ends[0]), statistics.as_ratio(ends[1]))
    means = [float(statistics.iqm(np.asarray(sample))) for sample in samples[1:]]
    best = means.index(max(means) if higher else min(means))
    verdict = "undecided"
    if ratios is not None and ratios[0] >= claim.factor:
        verdict = "holds"
    elif ratios is not None and ratios[1] < claim.factor:
        verdict = "does not hold"
    return [
        Verdict(
            fire=fire,
            method=group.label,
            claim=claim.text,
            measure=claim.measure,
            factor=claim.factor,
            best_other=others[best].label,
            ratio=statistics.as_ratio(float(share(*map(np.asarray, samples)))),
            interval=ratios,
            verdict=verdict,
            fewest_seeds=min(map(len, samples)),
        )
    ]


def _curve(group: Group, measure: str) -> Curve:
    values = np.asarray([[line[measure] for line in run.lines] for run in group.runs], float)
    ends = statistics.band(values)
    low, high = (None, None) if ends is None else (ends[0].tolist(), ends[1].tolist())
    return Curve(statistics.iqm(values, 0).tolist(), low, high)
