"""Collects the results of scripted policies, which have no training seeds."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from emberlink.envs import metrics
from emberlink.policies.scripted.registry import SCRIPTED
from emberlink.trainers.comparison.groups import Section
from emberlink.trainers.evaluation.results import LEARNED

TOLERANCE = 1e-5
"""relative difference that is possible between devices for a scripted policy on the same fires"""
REWARD = "mean_reward"
"""the measure that depends on a method's own reward"""


@dataclass(frozen=True)
class Scripted:
    """A result of a scripted policy.

    Attributes:
        methods: labels of the groups with this result; empty if it is the same for all groups.
        value: mean over episodes.
    """

    methods: list[str]
    value: float


def scripted(
    section: Section, fire: str, measure: str, notes: list[str]
) -> dict[str, list[Scripted]]:
    """Returns the mean over episodes of each scripted policy, with an entry per differing group.

    Args:
        section: the section.
        fire: fire of the evaluation.
        measure: a name in `metrics.NAMES`.
        notes: a note is appended for results that should be equal and differ.
    """
    policies = dict.fromkeys(p for run in section.runs for p in run.evaluation.results[fire])
    results: dict[str, list[Scripted]] = {}
    for policy in sorted(policies.keys() - {LEARNED}):
        values = _values(section, fire, measure, policy)
        all_values = [value for group in values.values() for value in group]
        if len(all_values) < len(section.runs):
            notes.append(
                f"{section.label}: {policy} was played for {len(all_values)} of the runs only"
            )
        may_differ = measure == REWARD or _depends_on_radio(section, policy, measure)
        for group in values.values() if may_differ else [all_values]:
            if group and not _same(group):
                notes.append(
                    f"{section.label}: {policy} does not have the same {measure} on {fire} in all "
                    f"runs ({min(group):.6g} to {max(group):.6g}): they were not evaluated on the "
                    "same fires and starts, or with another version"
                )
        results[policy] = _by_methods({label: group[0] for label, group in values.items() if group})
    return results


def different_rewards(section: Section, fire: str) -> str:
    """Returns the reason why the groups' rewards cannot be compared, or an empty text if they can.

    They cannot if the settings of the reward differ, or if a scripted policy, whose actions do not
    depend on the reward, has different rewards.
    """
    rewards = [
        {k: v for k, v in group.runs[0].settings.items() if k.startswith("env.reward.")}
        for group in section.groups
    ]
    for key in rewards[0]:
        if any(reward.get(key) != rewards[0][key] for reward in rewards):
            return f"the methods' rewards differ in {key}"
    policies = set.intersection(*(set(run.evaluation.results[fire]) for run in section.runs))
    for policy in sorted(policies - {LEARNED}):
        if not _depends_on_radio(section, policy, REWARD):
            values = _values(section, fire, REWARD, policy)
            if not _same([group[0] for group in values.values()]):
                return f"the methods' rewards differ: {policy} earns differently with them"
    return ""


def _values(section: Section, fire: str, measure: str, policy: str) -> dict[str, list[float]]:
    """Returns a policy's mean over episodes in each run that has it, by group."""
    return {
        group.label: [
            run.mean(fire, policy, measure)
            for run in group.runs
            if policy in run.evaluation.results[fire]
        ]
        for group in section.groups
    }


def _depends_on_radio(section: Section, policy: str, measure: str) -> bool:
    """Returns whether runs may differ in a policy's measure, since their communication differs."""
    hears = policy in SCRIPTED and SCRIPTED[policy].hears
    has_base = section.runs[0].config.env.base is not None
    if not hears and not has_base and measure not in metrics.OF_BASE:
        return False
    evaluations = [run.evaluation for run in section.runs]
    settings = [(e.environment.get("radio"), e.communication.get(policy)) for e in evaluations]
    return any(other != settings[0] for other in settings)


def _by_methods(values: Mapping[str, float]) -> list[Scripted]:
    """Merges equal results of several groups."""
    different: list[Scripted] = []
    for method, value in values.items():
        same = next((other for other in different if _same([value, other.value])), None)
        if same is None:
            different.append(Scripted([method], value))
        else:
            same.methods.append(method)
    return different if len(different) > 1 else [Scripted([], item.value) for item in different]


def _same(values: Sequence[float]) -> bool:
    return max(values) - min(values) <= TOLERANCE * max(1.0, *map(abs, values))
