"""Computes the gain of messages and the value of communication: how much of the gain is reached."""

from collections.abc import Callable, Iterable, Sequence
from itertools import product
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from emberlink.trainers.comparison import bootstrap
from emberlink.trainers.comparison.bootstrap import Interval
from emberlink.trainers.comparison.runs import Run
from emberlink.trainers.comparison.tables import RADIO, WARM_START, Frame, radio_text, trained_with
from emberlink.trainers.evaluation.results import LEARNED

SCRIPTED = ("map_greedy", "courier")
"""scripted policies whose value of communication is computed"""
_SAME = {"map_greedy": ("map_greedy_alone", "map_greedy_all")}
"""scripted policy -> the one that acts like it with the radio off, and the one without limits; in
worlds without a base"""
_OF_LEARNERS = ("env.reward.", "env.observation", "env.measures")
"""beginnings of the keys of `env` that do not change what scripted policies do"""
_Radio = tuple[float, float | None, float | None]
"""range, loss and bandwidth; None for no loss or no limit, and where they do not matter"""
_OFF: _Radio = (0.0, None, None)
_FULL: _Radio = (float("inf"), None, None)
COLUMNS = (
    *("section", "fires", "label", "measure", "radios", "none", "with_radio", "full"),
    *("gain", "gain_low", "gain_high", "value", "value_low", "value_high"),
)
"""columns of `communication_values`. `radios` is "evaluated" if the same networks were evaluated
with other radios, "retrained" if other networks were trained with them, "scripted" for a scripted
policy. `none`, `with_radio` and `full` are means with the radio off, with the world's radio and
without limits; `gain` is with_radio - none, `value` is gain / (full - none)."""

Values = NDArray[np.float64]
Group = list[Run]
"""the runs of a label"""


def communication_values(runs: Frame) -> Frame:
    """Returns the value of communication wherever there is an evaluation with the radio off.

    Intervals are over the fires where the networks are the same, and over seeds and fires where
    others were trained.
    """
    groups = {str(label): list(part["object"]) for label, part in runs.groupby("label")}
    trained = {label: group for label, group in groups.items() if not group[0].evaluated_with}
    limited = {heeded(group[0]): group[0] for group in [*trained.values()][::-1]}
    limited = {radio: run for radio, run in limited.items() if radio not in (_OFF, _FULL)}
    rows: list[dict[str, Any]] = []
    for fires in runs["object"].iloc[0].evaluation.results:
        about = {"section": runs["section"].iloc[0], "fires": fires}
        for label, group in trained.items():
            if _radio(group[0]) in (_OFF, _FULL):
                continue
            for how, find in (("evaluated", _evaluated), ("retrained", _retrained)):
                none, full = (find(groups.values(), group, radio) for radio in (_OFF, _FULL))
                if none is not None:
                    found = [none, group, *([full] if full else [])]
                    measure = group[0].headline
                    samples = [_values(one, fires, measure) for one in found]
                    names = {"label": label, "measure": measure, "radios": how}
                    rows.append(about | names | _row(samples, how == "retrained"))
        for policy, world in product(SCRIPTED, limited.values()):
            measure = world.headline
            samples = _scripted(list(runs["object"]), fires, policy, measure, world)
            if samples is not None:
                several = f", {radio_text(world.now, bandwidth=False)}" if len(limited) > 1 else ""
                names = {"label": policy.replace("_", " ") + several, "measure": measure}
                rows.append(about | names | {"radios": "scripted"} | _row(samples, False))
    return pd.DataFrame(rows, columns=list(COLUMNS))


def _radio(run: Run) -> _Radio:
    """Returns the radio of a run's evaluation."""
    reach, loss, bandwidth = (run.now.get(key) for key in RADIO)
    reach = float("inf") if reach is None else float(reach)
    return _OFF if reach == 0 else (reach, loss or None, bandwidth)


def heeded(run: Run) -> _Radio:
    """Returns the radio of a run's evaluation as far as scripted policies heed it."""
    return (*_radio(run)[:2], None)


def _evaluated(groups: Iterable[Group], group: Group, radio: _Radio) -> Group | None:
    """Returns the evaluation of a group's own networks with another radio."""
    paths = {run.path for run in group}
    alike = (
        other
        for other in groups
        if other[0].evaluated_with
        and {run.path for run in other} == paths
        and set(other[0].evaluated_with) <= set(RADIO)
        and _radio(other[0]) == radio
    )
    return next(alike, None)


def _retrained(groups: Iterable[Group], group: Group, radio: _Radio) -> Group | None:
    """Returns the group that was trained with another radio and equal settings otherwise."""

    def without_radio(run: Run) -> dict[str, str]:
        return {k: v for k, v in trained_with(run).items() if k not in (*RADIO, WARM_START)}

    seeds = [run.settings["seed"] for run in group]
    alike = (
        other
        for other in groups
        if not other[0].evaluated_with
        and [run.settings["seed"] for run in other] == seeds
        and _radio(other[0]) == radio
        and without_radio(other[0]) == without_radio(group[0])
    )
    return next(alike, None)


def _scripted(
    runs: Sequence[Run], fires: str, policy: str, measure: str, world: Run
) -> list[Values] | None:
    """Returns a scripted policy's measure with the radio off, that of a run, and no limits.

    None if an evaluation is missing. Without a base no evaluation with another radio is needed.
    """
    alike = [run for run in runs if _world(run) == _world(world)]
    others = [next((r for r in alike if heeded(r) == radio), None) for radio in (_OFF, _FULL)]
    choices = [(others[0], policy), (world, policy), (others[1], policy)]
    if world.settings.get("env.base") is None and policy in _SAME:
        none, full = _SAME[policy]
        choices = [(world, none), (world, policy), (world, full)]
    played = [run and run.evaluation.results[fires].get(name) for run, name in choices]
    measured = [np.array([p[measure]]) for p in played if p and measure in p]
    return measured if len(measured) == len(played) else None


def _world(run: Run) -> dict[str, Any]:
    """Returns the settings of an evaluation that scripted policies heed, without the radio."""
    return {
        key: value
        for key, value in run.now.items()
        if key.startswith("env.") and not key.startswith((*RADIO, *_OF_LEARNERS))
    }


def _values(group: Group, fires: str, measure: str) -> Values:
    """Returns a measure of the runs of a group on each fire, [seeds, fires]."""
    return np.array([run.evaluation.results[fires][LEARNED][measure] for run in group], float)


def _row(samples: Sequence[Values], retrained: bool) -> dict[str, Any]:
    """Returns the numbers of samples [seeds, fires]: radio off, the world's and maybe no limits."""
    means = [sample.mean(0) for sample in samples]

    def ends(statistic: Callable[..., Any], count: int) -> Interval | tuple[None, None]:
        if retrained:
            found = bootstrap.crossed_interval(statistic, *samples[:count])
        else:
            found = bootstrap.paired_interval(statistic, *means[:count])
        return found or (None, None)

    none, with_radio, *rest = (float(mean.mean()) for mean in means)
    full = rest[0] if rest else None
    low, high = ends(_gain, 2)
    least, most = (None, None) if full is None else ends(_share, 3)
    return {
        "none": none,
        "with_radio": with_radio,
        "full": full,
        "gain": with_radio - none,
        "gain_low": low,
        "gain_high": high,
        "value": None if full in (None, none) else (with_radio - none) / (full - none),
        "value_low": least,
        "value_high": most,
    }


def _gain(none: Values, with_radio: Values, axis: int = -1) -> Any:
    """Returns with_radio - none of the means along an axis."""
    return with_radio.mean(axis) - none.mean(axis)


def _share(none: Values, with_radio: Values, full: Values, axis: int = -1) -> Any:
    """Returns (with_radio - none) / (full - none) of the means along an axis; NaN for x / 0."""
    gained, most = (_gain(none, m, axis) for m in (with_radio, full))
    return np.divide(gained, most, out=np.full_like(gained, np.nan), where=most != 0)
