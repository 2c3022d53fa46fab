"""Computes the value of communication: how much of what messages can add is reached."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emberlink.trainers.comparison import bootstrap
from emberlink.trainers.comparison.bootstrap import Interval
from emberlink.trainers.comparison.groups import Group, Section, trained_with
from emberlink.trainers.comparison.runs import Run
from emberlink.trainers.evaluation.results import LEARNED

SCRIPTED = ("map_greedy", "courier")
"""scripted policies whose value of communication is computed"""
_SAME = {"map_greedy": ("map_greedy_alone", "map_greedy_all")}
"""scripted policy -> the one that acts like it with the radio off, and the one without limits; in
worlds without a base"""
_RANGE, _LOSS, _BANDWIDTH = _RADIO = "env.radio.range", "env.radio.loss", "env.radio.bandwidth"
_OF_LEARNERS = ("env.reward.", "env.observation", "env.measures")
"""beginnings of the keys of `env` that do not change what scripted policies do"""
_Radio = tuple[float, float | None, float | None]
"""range, loss and bandwidth; None for no loss or no limit, and where they do not matter"""
_OFF: _Radio = (0.0, None, None)
_FULL: _Radio = (float("inf"), None, None)

Values = NDArray[np.float64]


@dataclass(frozen=True)
class CommunicationValue:
    """The value of communication of a group or a scripted policy on one fire.

    Attributes:
        fire: the fire of the evaluation.
        policy: label of the group; or name of the scripted policy, with its radio if the section
            has several.
        measure: the headline measure of the world.
        how: "evaluated" if the same networks were evaluated with other radios, "retrained" if other
            networks were trained with them, "scripted" for a scripted policy.
        none, with_radio, full: mean of the measure with the radio off, with the radio of the world,
            and with a radio without limits; `full` is None if that was not evaluated.
        gain: with_radio - none, in units of the measure.
        gain_interval: 95 % bootstrap interval of `gain` over fires, paired; None with one fire.
        value: (with_radio - none) / (full - none); None if there is no `full`, or it equals `none`.
        interval: 95 % bootstrap interval over fires, paired; None if it is not finite.
    """

    fire: str
    policy: str
    measure: str
    how: str
    none: float
    with_radio: float
    full: float | None
    gain: float
    gain_interval: Interval | None
    value: float | None
    interval: Interval | None


def communication_values(section: Section) -> list[CommunicationValue]:
    """Returns the value of communication wherever there is an evaluation with the radio off."""
    limited = _limited(section)
    values: list[CommunicationValue] = []
    for fire in section.runs[0].evaluation.results:
        for group in section.as_trained:
            measure = group.runs[0].config.evaluation.headline
            if _radio(group.runs[0]) in (_OFF, _FULL):
                continue
            for how, others in (("evaluated", _evaluated), ("retrained", _retrained)):
                none, full = (others(section, group, radio) for radio in (_OFF, _FULL))
                if none is not None:
                    groups = [none, group] if full is None else [none, group, full]
                    samples = [_per_fire(g.runs, fire, measure) for g in groups]
                    values.append(_value(fire, group.label, measure, how, samples))
        for policy, world in product(SCRIPTED, limited):
            measure = world.config.evaluation.headline
            samples = _scripted(section, fire, policy, measure, world)
            if samples is not None:
                name = policy + (f", {_radio_text(world)}" if len(limited) > 1 else "")
                values.append(_value(fire, name, measure, "scripted", samples))
    return values


def _limited(section: Section) -> list[Run]:
    """Returns one run as trained for each range and loss, without those off or without limits."""
    first: dict[_Radio, Run] = {}
    for run in (run for group in section.as_trained for run in group.runs):
        first.setdefault(_heeded(run), run)
    return [run for radio, run in first.items() if radio not in (_OFF, _FULL)]


def _heeded(run: Run) -> _Radio:
    """Returns the radio of a run's evaluation as far as scripted policies heed it."""
    reach, loss, _ = _radio(run)
    return reach, loss, None


def _radio_text(run: Run) -> str:
    """Returns the limits of scripted policies' radio, such as `range 10.0, loss 0.2`."""
    reach, loss, _ = _radio(run)
    return f"range {reach}" + ("" if loss is None else f", loss {loss}")


def _scripted(
    section: Section, fire: str, policy: str, measure: str, world: Run
) -> list[Values] | None:
    """Returns a scripted policy's measure with the radio off, that of a run, and no limits.

    None if an evaluation is missing. Without a base no evaluation with another radio is needed.
    """
    wanted = _world(world)
    alike = [run for run in section.runs if _world(run) == wanted]
    others = [next((r for r in alike if _heeded(r) == radio), None) for radio in (_OFF, _FULL)]
    choices = [(others[0], policy), (world, policy), (others[1], policy)]
    if world.config.env.base is None and policy in _SAME:
        none, full = _SAME[policy]
        choices = [(world, none), (world, policy), (world, full)]
    played = [run and run.evaluation.results[fire].get(name) for run, name in choices]
    measured = [np.asarray(p[measure]) for p in played if p and measure in p]
    return measured if len(measured) == len(played) else None


def _world(run: Run) -> dict[str, Any]:
    """Returns the settings of an evaluation that scripted policies heed, without the radio."""
    return {
        key: value
        for key, value in {**run.settings, **run.evaluated_with}.items()
        if key.startswith("env.") and not key.startswith((*_RADIO, *_OF_LEARNERS))
    }


def _radio(run: Run) -> _Radio:
    """Returns the radio of a run's evaluation."""
    settings = {**run.settings, **run.evaluated_with}
    reach = float(settings[_RANGE])
    return _OFF if reach == 0 else (reach, settings[_LOSS] or None, settings[_BANDWIDTH])


def _evaluated(section: Section, group: Group, radio: _Radio) -> Group | None:
    """Returns the evaluation of a group's own networks with another radio."""
    paths = {run.path for run in group.runs}
    return next(
        (
            other
            for other in section.groups
            if not other.as_trained
            and {run.path for run in other.runs} == paths
            and set(other.runs[0].evaluated_with) <= set(_RADIO)
            and _radio(other.runs[0]) == radio
        ),
        None,
    )


def _retrained(section: Section, group: Group, radio: _Radio) -> Group | None:
    """Returns the group that was trained with another radio and equal settings otherwise."""
    wanted = _without_radio(trained_with(group.runs[0]))
    return next(
        (
            other
            for other in section.as_trained
            if other.seeds == group.seeds
            and _radio(other.runs[0]) == radio
            and _without_radio(trained_with(other.runs[0])) == wanted
        ),
        None,
    )


def _without_radio(settings: dict[str, Any]) -> dict[str, Any]:
    """Returns settings, and those of a warm start within them, without those of the radio."""
    rest = {key: value for key, value in settings.items() if key not in _RADIO}
    return {k: _without_radio(v) if isinstance(v, dict) else v for k, v in rest.items()}


def _per_fire(runs: Sequence[Run], fire: str, measure: str) -> Values:
    """Returns the mean over seeds of a measure in each episode, [fires]."""
    return np.mean([run.evaluation.results[fire][LEARNED][measure] for run in runs], axis=0)


def _value(
    fire: str, policy: str, measure: str, how: str, samples: Sequence[Values]
) -> CommunicationValue:
    """Returns the value of samples with the radio off, that of the world and, maybe, no limits."""
    none, with_radio, *rest = (float(sample.mean()) for sample in samples)
    gain, full = with_radio - none, rest[0] if rest else None
    value = None if full is None or full == none else gain / (full - none)
    return CommunicationValue(
        fire=fire,
        policy=policy,
        measure=measure,
        how=how,
        none=none,
        with_radio=with_radio,
        full=full,
        gain=gain,
        gain_interval=bootstrap.paired_interval(_gain, *samples[:2]),
        value=value,
        interval=None if full is None else bootstrap.paired_interval(_share, *samples),
    )


def _gain(none: Values, with_radio: Values, axis: int = -1) -> Any:
    """Returns with_radio - none of the means along an axis."""
    return with_radio.mean(axis) - none.mean(axis)


def _share(none: Values, with_radio: Values, full: Values, axis: int = -1) -> Any:
    """Returns (with_radio - none) / (full - none) of the means along an axis; NaN for x / 0."""
    gained, most = (_gain(none, m, axis) for m in (with_radio, full))
    return np.divide(gained, most, out=np.full_like(gained, np.nan), where=most != 0)
