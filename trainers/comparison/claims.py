"""Tests the claims of the paper (sections V and VI) with intervals over seeds."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from emberlink.envs import metrics
from emberlink.trainers.comparison import bootstrap
from emberlink.trainers.comparison.bootstrap import Interval
from emberlink.trainers.comparison.groups import (
    NOT_COMPARED,
    Group,
    Section,
    changed,
    differing,
    first_part,
)
from emberlink.trainers.evaluation.results import LEARNED

ROUNDING = 1e-6
"""relative error of a ratio of measures, which are float32"""
_NOT_OF_LEARNING = ("method", "comm", "replay", *NOT_COMPARED)
"""first parts of keys in which compared methods may differ"""


@dataclass(frozen=True)
class Claim:
    """The claim that a method is better than the best other method by a factor."""

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
"""claims of the paper about method 4, compared with the next best method"""


@dataclass(frozen=True)
class Verdict:
    """The result of a claim on one fire.

    Attributes:
        fire: the fire of the evaluation.
        method: label of the group.
        claim: text of the claim.
        measure: measure of the claim.
        factor: the factor claimed.
        best_other: label of the best other group.
        ratio: ratio of the IQMs, above 1 if the method is better; infinite for a ratio to 0.
        interval: of the ratio; None with one seed.
        verdict: "holds", "does not hold" or "undecided".
        fewest_seeds: minimum number of seeds of a group.
    """

    fire: str
    method: str
    claim: str
    measure: str
    factor: float
    best_other: str
    ratio: float
    interval: Interval | None
    verdict: str
    fewest_seeds: int


def verdicts(section: Section, fires: Sequence[str], notes: list[str]) -> list[Verdict]:
    """Returns the verdict of each claim on each fire, for each group of the claim's method.

    If the method was trained in several ways, a group is compared with those groups of other
    methods in which the same was changed: a claim about consensus with 300 episodes is not tested
    with 120 of another method. The communication may differ, and each method has its own defaults.
    A note is appended for a group with which none can be compared.
    """
    found: list[Verdict] = []
    for method in dict.fromkeys(claim.method for claim in CLAIMS):
        claims = [claim for claim in CLAIMS if claim.method == method]
        groups = [group for group in section.as_trained if group.method == method]
        others = [group for group in section.as_trained if group.method != method]
        keys = [key for key in differing([group.runs[0] for group in groups]) if _learning(key)]
        ways = [changed(other.runs[0], keys) for other in others]
        for group in groups if others else ():
            way = changed(group.runs[0], keys)
            alike = [other for other, its in zip(others, ways, strict=True) if its == way]
            if alike:
                found += [_verdict(group, alike, fire, claim) for fire in fires for claim in claims]
            else:
                notes.append(
                    f"{section.label}: {group.label}: no claims, because no other method was "
                    "trained with these settings"
                )
    return found


def _learning(key: str) -> bool:
    """Returns whether compared methods must have the same value of a key."""
    return first_part(key) not in _NOT_OF_LEARNING and not key.startswith("env.radio.")


def _verdict(group: Group, others: Sequence[Group], fire: str, claim: Claim) -> Verdict:
    higher = claim.measure in metrics.HIGHER_IS_BETTER
    samples = [[run.mean(fire, LEARNED, claim.measure) for run in g.runs] for g in (group, *others)]
    share = partial(bootstrap.iqm_ratio_share, higher=higher)
    shares = bootstrap.interval(share, *samples)
    ratios = shares and (bootstrap.as_ratio(shares[0]), bootstrap.as_ratio(shares[1]))
    means = [float(bootstrap.iqm(np.asarray(sample))) for sample in samples[1:]]
    best = means.index(max(means) if higher else min(means))
    return Verdict(
        fire=fire,
        method=group.label,
        claim=claim.text,
        measure=claim.measure,
        factor=claim.factor,
        best_other=others[best].label,
        ratio=bootstrap.as_ratio(float(share(*map(np.asarray, samples)))),
        interval=ratios,
        verdict=_decision(ratios, claim.factor),
        fewest_seeds=min(map(len, samples)),
    )


def _decision(interval: Interval | None, factor: float) -> str:
    """Returns the verdict of an interval; an end `ROUNDING` below the factor is at the factor."""
    least = factor * (1 - ROUNDING)
    if interval is not None and interval[0] >= least:
        return "holds"
    if interval is not None and interval[1] < least:
        return "does not hold"
    return "undecided"
