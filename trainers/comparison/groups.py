"""Groups runs by setup, world, fire and method, and labels the groups."""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from emberlink.envs.utils.errors import UserError
from emberlink.trainers.comparison.runs import Run, settings_of
from emberlink.trainers.config.compose import to_values
from emberlink.trainers.config.defaults import defaults_of
from emberlink.trainers.config.schema import NOT_LEARNT_WITH
from emberlink.trainers.runs import pretrained
from emberlink.trainers.runs.run_folder import without_time_and_seed

NOT_COMPARED = ("seed", "seeds", "output", "evaluation", *NOT_LEARNT_WITH)
"""first parts of keys that may differ within a group, since they do not affect training"""
NOT_NOTED = ("seed", "seeds", "output")
"""first parts of keys whose differences within a group are not reported in notes"""
_WARM_START = "learner.warm_start"
_OF_SECTION = ("env.horizon", "env.grid")
"""settings of the environment that are equal within a section, besides those of the fire"""


@dataclass(frozen=True)
class Group:
    """Runs that differ only in the seed.

    Attributes:
        label: the method, and settings that distinguish it from other groups of the method.
        runs: one run per seed, sorted by seed.
    """

    label: str
    runs: tuple[Run, ...]

    @property
    def as_trained(self) -> bool:
        """Whether the runs were evaluated with their training settings."""
        return not self.runs[0].evaluated_with

    @property
    def method(self) -> str:
        """The method of the runs."""
        return self.runs[0].config.method

    @property
    def settings(self) -> dict[str, Any]:
        """The settings of the first run."""
        return self.runs[0].settings

    @property
    def seeds(self) -> list[int]:
        """The training seeds."""
        return [run.config.seed for run in self.runs]


@dataclass(frozen=True)
class Section:
    """Groups with the same setup, world and training fire and comparable evaluations.

    Attributes:
        label: the setup, the world, the fire, and settings that distinguish it from other sections
            of these.
        groups: groups sorted by label.
    """

    label: str
    groups: tuple[Group, ...]

    @property
    def as_trained(self) -> list[Group]:
        """The groups that were evaluated with their training settings."""
        return [group for group in self.groups if group.as_trained]

    @property
    def runs(self) -> list[Run]:
        """The runs of all groups."""
        return [run for group in self.groups for run in group.runs]

    @property
    def trained_on(self) -> str:
        """The name of the training fire in the evaluation; empty if it was not evaluated."""
        run = self.runs[0]
        name = run.config.fire.name
        fires = run.evaluation.results
        return next((fire for fire in (f"{name}_as_trained", name) if fire in fires), "")


def gather(runs: Sequence[Run]) -> tuple[list[Section], list[str]]:
    """Groups runs into sections by setup, world and training fire, and within these by method.

    Runs with different horizons, grids, numbers of held-out fires or start positions are in
    different sections. Of several runs of a group with the same seed, the last by name is used.

    Returns:
        The sections sorted by label, and notes about differences between runs.

    Raises:
        UserError: runs of a section were evaluated on different fires.
    """
    runs = sorted(runs, key=lambda run: (run.config.seed, run.path.name, run.path))
    parts = _split(runs, _section_key)
    names = [_section_name(part[0], [other[0] for other in parts]) for part in parts]
    notes: list[str] = []
    sections: list[Section] = []
    for name, part in sorted(zip(names, parts, strict=True), key=lambda pair: pair[0]):
        groups = _groups(name, part, notes)
        _check_same_fires(name, part)
        sections.append(Section(name, tuple(groups)))
    return sections, notes


def _section_key(run: Run) -> list[Any]:
    fire = to_values(run.config)["fire"]
    shared = [run.settings[key] for key in _OF_SECTION]
    world = run.config.setup, run.config.world
    return [*world, fire, shared, run.evaluation.fires, run.evaluation.start_seed]


def _section_name(run: Run, firsts: Sequence[Run]) -> str:
    """Returns the label of a run's section.

    Args:
        run: a run of the section.
        firsts: one run of each section.
    """

    def names(other: Run) -> tuple[str, str, str]:
        return other.config.setup, other.config.world, other.config.fire.name

    alike = [other for other in firsts if names(other) == names(run)]
    name = "setup {}, world {}, trained on {}".format(*names(run))
    name += _settings_apart(run, alike, lambda k: k.startswith("fire.") or k in _OF_SECTION)
    if len({other.evaluation.fires for other in alike}) > 1:
        name += f", {run.evaluation.fires} held-out fires"
    if len({other.evaluation.start_seed for other in alike}) > 1:
        name += f", start_seed {run.evaluation.start_seed}"
    return name


def _groups(section: str, runs: Sequence[Run], notes: list[str]) -> list[Group]:
    """Returns the groups of a section sorted by label, and appends notes about their runs."""
    parts = _split(runs, lambda run: [run.config.method, trained_with(run), run.evaluated_with])
    names = [_group_name(part[0], [other[0] for other in parts]) for part in parts]
    groups = [
        Group(name, _one_run_per_seed(f"{section}, {name}", part, notes))
        for name, part in sorted(zip(names, parts, strict=True), key=lambda pair: pair[0])
    ]
    for group in groups:
        keys = [key for key in differing(group.runs) if first_part(key) not in NOT_NOTED]
        if keys:
            notes.append(f"{section}, {group.label}: one group, though {', '.join(keys)} differ")
    trained = [group for group in groups if group.as_trained]
    for key in differing([group.runs[0] for group in trained]):
        if first_part(key) not in ("method", "replay", "comm", *NOT_COMPARED):
            having = {g.label: _word(g.settings[key]) for g in trained if key in g.settings}
            if len({*having.values()}) > 1:
                notes.append(f"{section}: the groups differ in {key}: {by_value(having)}")
    return groups


def by_value(values: Mapping[str, str]) -> str:
    """Returns which groups have which value, such as `0.9 for consensus; 0.99 for all others`.

    Args:
        values: label -> value.
    """
    labels: dict[str, list[str]] = {}
    for label, value in values.items():
        labels.setdefault(value, []).append(label)
    most = max(labels, key=lambda value: len(labels[value]))
    parts = [f"{value} for {', '.join(names)}" for value, names in labels.items() if value != most]
    rest = "all others" if len(labels[most]) > 2 else ", ".join(labels[most])
    return "; ".join([*parts, f"{most} for {rest}"])


def _group_name(run: Run, firsts: Sequence[Run]) -> str:
    """Returns the label of a run's group, given one run of each group of the section."""
    alike = [other for other in firsts if other.config.method == run.config.method]
    apart = (*NOT_COMPARED, "method")
    name = run.config.method + _settings_apart(run, alike, lambda k: first_part(k) not in apart)
    other = (f", evaluated with {_typed(*item)}" for item in run.evaluated_with.items())
    return name + "".join(other)


def _one_run_per_seed(label: str, runs: Sequence[Run], notes: list[str]) -> tuple[Run, ...]:
    """Returns the last run of each seed, sorted by seed, and appends notes about other runs.

    A copy of the package's trained policy is chosen only if there is no other run.
    """
    copies_first = sorted(runs, key=lambda run: not pretrained.is_copy(run.path))
    by_seed = {run.config.seed: run for run in copies_first}
    for run in runs:
        taken = by_seed[run.config.seed]
        if run is not taken:
            notes.append(
                f"{label}: seed {run.config.seed} was trained twice; "
                f"{taken.path} is used, {run.path} is left out"
            )
    return tuple(by_seed[seed] for seed in sorted(by_seed))


def trained_with(run: Run) -> dict[str, Any]:
    """Returns the settings that affect training, without the seed.

    If the run began with the actors of another, `learner.warm_start` holds the settings of that
    run, or its path without the time and the seed if it no longer exists.
    """
    mine, start = _without_seed(run.settings), run.settings.get(_WARM_START, "")
    origin = settings_of(start) if start else ""
    alike = without_time_and_seed(origin) if isinstance(origin, str) else _without_seed(origin)
    return mine | {_WARM_START: alike}


def _without_seed(settings: Mapping[str, Any]) -> dict[str, Any]:
    return {k: v for k, v in settings.items() if first_part(k) not in NOT_COMPARED}


def _split(runs: Iterable[Run], key: Callable[[Run], Any]) -> list[list[Run]]:
    """Splits runs into lists with equal keys, in order of the first run of each list."""
    parts: dict[str, list[Run]] = {}
    for run in runs:
        parts.setdefault(json.dumps(key(run), sort_keys=True), []).append(run)
    return list(parts.values())


def _settings_apart(run: Run, others: Sequence[Run], counts: Callable[[str], bool]) -> str:
    """Returns the settings that distinguish a run from others with the same name, in brackets.

    Settings with the default of the run's method, setup and learner are left out, and those that
    its learner does not have. So is the path of a warm start if the other settings distinguish the
    run. The text can be empty.

    Args:
        run: the run.
        others: all runs with the same name, including `run`.
        counts: whether a key may be part of the text.
    """
    keys = [key for key in differing(others) if counts(key)]
    apart = changed(run, keys)
    if _WARM_START in apart:
        rest = {*keys} - {_WARM_START}
        alike = [other for other in others if rest.isdisjoint(differing([run, other]))]
        if len(_split(alike, trained_with)) == 1:
            del apart[_WARM_START]
    return f" ({', '.join(_typed(*item) for item in apart.items())})" if apart else ""


def changed(run: Run, keys: Sequence[str]) -> dict[str, Any]:
    """Returns the settings among `keys` that are not the default of method, setup and learner."""
    defaults = defaults_of(run.config) if keys else {}
    return {
        key: run.settings[key]
        for key in keys
        if key in run.settings and (key not in defaults or run.settings[key] != defaults[key])
    }


def _typed(key: str, value: Any) -> str:
    """Returns a setting as on the command line."""
    return f"{key.replace('learner.name', 'learner')}={_word(value)}"


def _word(value: Any) -> str:
    """Returns a value as on the command line."""
    words = {None: "null", True: "true", False: "false"}
    return words[value] if value is None or isinstance(value, bool) else str(value) or "''"


def differing(runs: Sequence[Run]) -> list[str]:
    """Returns the keys whose values differ between runs."""
    keys = dict.fromkeys(key for run in runs for key in run.settings)
    return [key for key in keys if len({repr(run.settings.get(key)) for run in runs}) > 1]


def first_part(key: str) -> str:
    """Returns the part of a key before the first dot."""
    return key.split(".")[0]


def _check_same_fires(section: str, runs: Sequence[Run]) -> None:
    """Checks that all runs of a section were evaluated on the same fires."""
    first = runs[0]
    fires = sorted(first.evaluation.results)
    for run in runs:
        if sorted(run.evaluation.results) != fires:
            raise UserError(
                f"{section}: {first.path} was evaluated on {', '.join(fires)}, "
                f"{run.path} on {', '.join(sorted(run.evaluation.results))}; "
                "evaluate them again (emberlink eval RUN)"
            )
        for fire in fires:
            if run.evaluation.held_out.get(fire) != first.evaluation.held_out.get(fire):
                raise UserError(
                    f"{section}: {first.path} and {run.path} were not evaluated on the same fires "
                    f"of {fire} (held_out in eval.json); evaluate them again (emberlink eval RUN)"
                )
