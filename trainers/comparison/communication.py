"""Computes the gain of messages and the value of communication: how much of the gain is reached."""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import product
from typing import Any

import numpy as np
import pandas as pd

from emberlink.envs import metrics
from emberlink.trainers.comparison import bootstrap
from emberlink.trainers.comparison.bootstrap import Values
from emberlink.trainers.comparison.reading import EvaluatedRun
from emberlink.trainers.comparison.tables import RADIO, WARM_START, Frame, radio_text, trained_with
from emberlink.trainers.evaluation.scores import LEARNED

_POLICIES = ("map_greedy", "courier")
"""scripted policies whose value of communication is computed"""
_SAME = {"map_greedy": ("map_greedy_alone", "map_greedy_all")}
"""scripted policy -> the policies that act like it with the radio off and without limits, in worlds
without a base"""
_OF_LEARNERS = ("env.reward.", "env.observation", "env.measures")
"""beginnings of the keys of `env` that do not change what scripted policies do"""
_OFF, _FULL = "off", "no limits"
"""texts of `radio_text`"""
COLUMNS = (
    *("section", "fires", "label", "measure", "radios", "none", "with_radio", "full"),
    *("gain", "gain_low", "gain_high", "value", "value_low", "value_high"),
)
"""columns of `communication_values`. `radios` is "evaluated" if the same networks were evaluated
with other radios, "retrained" if other networks were trained with them, "scripted" for a scripted
policy. `none`, `with_radio` and `full` are interquartile means over seeds with the radio off, with
the world's radio and without limits; `gain` is with_radio - none, `value` is gain / (full - none),
missing where the interval of full - none is not above 0 (below, if less is better)."""

Group = list[EvaluatedRun]
"""the runs of a label"""
Found = Iterator[tuple[str, str, str, list[Values]]]
"""label, measure, `radios`, and [seeds, fires] with the radio off, on and maybe without limits"""


def communication_values(runs: Frame) -> Frame:
    """Returns the value of communication wherever there is an evaluation with the radio off.

    Intervals are over the fires where the networks are the same, and over seeds and fires where
    others were trained.
    """
    groups = {str(label): list(part["object"]) for label, part in runs.groupby("label")}
    rows = [
        {"section": runs["section"].iloc[0], "fires": fires}
        | {"label": label, "measure": measure, "radios": how}
        | gain_and_value(measure, samples, retrained=how == "retrained")
        for fires in runs["object"].iloc[0].evaluation.results
        for found in (_of_networks(groups, fires), _of_scripted(groups, fires))
        for label, measure, how, samples in found
    ]
    return pd.DataFrame(rows, columns=list(COLUMNS))


def _of_networks(groups: Mapping[str, Group], fires: str) -> Found:
    for label, group in groups.items():
        if group[0].evaluated_with or radio_text(group[0].now) in (_OFF, _FULL):
            continue
        measure = group[0].headline
        for how, same in (("evaluated", _evaluated), ("retrained", _retrained)):
            others = [other for other in groups.values() if same(group, other)]
            alike = {radio_text(other[0].now): other for other in others[::-1]}
            if _OFF in alike:
                found = [alike[_OFF], group, *([alike[_FULL]] if _FULL in alike else [])]
                played = [[run.evaluation.results[fires][LEARNED] for run in one] for one in found]
                yield label, measure, how, [np.array([p[measure] for p in one]) for one in played]


def _of_scripted(groups: Mapping[str, Group], fires: str) -> Found:
    """Yields scripted policies; without a base no evaluation with another radio is needed."""
    trained = [group[0] for group in groups.values() if not group[0].evaluated_with]
    every = [run for group in groups.values() for run in group]
    limited = {radio_text(run.now): run for run in trained[::-1]}
    limited = {radio: run for radio, run in limited.items() if radio not in (_OFF, _FULL)}
    for policy, (radio, world) in product(_POLICIES, limited.items()):
        alike = {radio_text(r.now): r for r in every[::-1] if _world(r) == _world(world)}
        choices = [(alike.get(_OFF), policy), (world, policy), (alike.get(_FULL), policy)]
        if world.settings.get("env.base") is None and policy in _SAME:
            off, unlimited = _SAME[policy]
            choices = [(world, off), (world, policy), (world, unlimited)]
        played = [run and run.evaluation.results[fires].get(name) for run, name in choices]
        measured = [np.array([p[world.headline]]) for p in played if p and world.headline in p]
        if len(measured) == len(choices):
            several = f", {radio}" if len(limited) > 1 else ""
            yield policy.replace("_", " ") + several, world.headline, "scripted", measured


def _evaluated(group: Group, other: Group) -> bool:
    """Returns whether the other group holds evaluations of the same networks with other radios."""
    changed, paths = set(other[0].evaluated_with), [{r.path for r in g} for g in (group, other)]
    return len(changed) > 0 and changed <= {*RADIO} and paths[0] == paths[1]


def _retrained(group: Group, other: Group) -> bool:
    """Returns whether the other group has the same seeds and settings except for the radio."""

    def same(run: EvaluatedRun) -> dict[str, str]:
        return {k: v for k, v in trained_with(run).items() if k not in (*RADIO, WARM_START)}

    seeds = [[run.settings["seed"] for run in runs] for runs in (group, other)]
    return not other[0].evaluated_with and seeds[0] == seeds[1] and same(group[0]) == same(other[0])


def _world(run: EvaluatedRun) -> dict[str, Any]:
    """Returns the settings of an evaluation that scripted policies heed, without the radio."""
    left_out = (*RADIO, *_OF_LEARNERS)
    return {k: v for k, v in run.now.items() if k.startswith("env.") and not k.startswith(left_out)}


def gain_and_value(measure: str, samples: Sequence[Values], *, retrained: bool) -> dict[str, Any]:
    """Returns the numbers of samples [seeds, fires]: radio off, the world's and maybe no limits."""
    means = [sample.mean(1) for sample in samples]
    ends = partial(bootstrap.crossed_interval, seeds=retrained)
    radios = "none", "with_radio", "full"
    row: dict[str, Any] = dict(zip(radios, map(bootstrap.iqm, means), strict=False))
    row["gain"] = bootstrap.iqm_difference(means[1], means[0])
    low_high = ends(bootstrap.iqm_difference, samples[1], samples[0])
    row["gain_low"], row["gain_high"] = low_high or (None, None)
    for full in samples[2:]:
        low, high = ends(bootstrap.iqm_difference, full, samples[0]) or (0, 0)
        if low > 0 if measure in metrics.HIGHER_IS_BETTER else high < 0:
            row["value"] = float(_share(*means))
            row["value_low"], row["value_high"] = ends(_share, *samples) or (None, None)
    return row


def _share(none: Values, with_radio: Values, full: Values, axis: int = -1) -> Any:
    """Returns (with_radio - none) / (full - none) of interquartile means; NaN for x / 0."""
    gained, most = (bootstrap.iqm_difference(x, none, axis) for x in (with_radio, full))
    return np.divide(gained, most, out=np.full_like(gained, np.nan), where=most != 0)
