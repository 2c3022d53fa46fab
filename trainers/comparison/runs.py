"""Finished runs from disk, gathered by setup, fire trained on and method."""

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass as checked

from emberlink.envs import metrics
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import describe
from emberlink.trainers.config.compose import flat, resolve, to_values
from emberlink.trainers.config.schema import NOT_LEARNT_WITH, RunConfig
from emberlink.trainers.evaluation.results import CURVES, LEARNED
from emberlink.trainers.runs import pretrained
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.runs.safe_read import MAX_JSON, read_text
from emberlink.trainers.runs.seal import check_trained_with

LARGEST = 1e12
"""of a measure; what is beyond it is damage"""
Measured = Annotated[float, Field(ge=-LARGEST, le=LARGEST, allow_inf_nan=False)]
_MEASURE = TypeAdapter(Measured)
NOT_COMPARED = ("seed", "seeds", "output", "evaluation", "baseline_comm", *NOT_LEARNT_WITH)
"""keys in which the runs of a group may differ: none changes what is trained"""
NAMELESS = ("seed", "seeds", "output", "baseline_comm")
"""those of them that nobody need be told of"""


@checked(frozen=True, config=ConfigDict(extra="ignore"))
class Evaluation:
    """What eval.json holds."""

    method: str
    setup: str
    seed: int
    start_seed: int
    """of the start positions"""
    checkpoint: str
    fires: Annotated[int, Field(ge=1)]
    """episodes of every policy on every fire"""
    results: dict[str, dict[str, dict[str, list[Measured]]]]
    """fire -> policy -> measure -> one number per episode"""
    held_out: dict[str, Any] = Field(default_factory=dict)
    """fire -> what the fires were made from"""
    environment: dict[str, Any] = Field(default_factory=dict)
    """settings of the environment"""
    communication: dict[str, dict[str, Any]] = Field(default_factory=dict)
    """policy -> settings of the communication"""


@dataclass(frozen=True)
class Run:
    """A finished run with its evaluation."""

    path: Path
    config: RunConfig
    lines: Sequence[Mapping[str, Any]]
    """of metrics.jsonl, one an episode"""
    evaluation: Evaluation
    evaluated_with: Mapping[str, Any] = field(default_factory=dict)
    """dotted key -> value, where the evaluation's is not the one trained with"""

    @cached_property
    def values(self) -> dict[str, Any]:
        """The configuration by dotted key."""
        return flat(to_values(self.config))

    def mean(self, fire: str, policy: str, measure: str) -> float:
        """The run's one number: the mean over its episodes."""
        numbers = self.evaluation.results[fire][policy][measure]
        return math.fsum(numbers) / len(numbers)


@dataclass(frozen=True)
class Group:
    """Runs that differ in nothing but the seed."""

    label: str
    """the method, and what sets it apart from another group of that method"""
    runs: tuple[Run, ...]
    """by seed, each seed once"""

    @property
    def as_trained(self) -> bool:
        """Whether the evaluation was in the world that the runs were trained in."""
        return not self.runs[0].evaluated_with

    @property
    def method(self) -> str:
        return self.runs[0].config.method

    @property
    def seeds(self) -> list[int]:
        return [run.config.seed for run in self.runs]


@dataclass(frozen=True)
class Section:
    """The groups of one setup that were trained on the same fire."""

    label: str
    groups: tuple[Group, ...]

    @property
    def as_trained(self) -> list[Group]:
        """The groups of which each is a training of its own."""
        return [group for group in self.groups if group.as_trained]

    @property
    def runs(self) -> list[Run]:
        return [run for group in self.groups for run in group.runs]

    @property
    def trained_on(self) -> str:
        """What the evaluation calls the fire trained on."""
        run = self.runs[0]
        name = run.config.fire.name
        known = run.evaluation.results
        return next((fire for fire in (f"{name}_as_trained", name) if fire in known), "")


def find(paths: Iterable[Path]) -> list[Path]:
    """The run folders among `paths` and directly in them, each once, in order of their names.

    A path may also be the name of trained policies, as `pretrained:tuned`.

    Raises:
        ValueError: a path is neither a run folder nor holds one.
    """
    found: dict[Path, Path] = {}
    for path in paths:
        if pretrained.is_name(str(path)):
            folders = pretrained.find(str(path))
        elif (path / "config.yaml").is_file():
            folders = [path]
        elif path.is_dir():
            folders = [folder.parent for folder in path.glob("*/config.yaml")]
        else:
            raise UserError(f"{path}: there is no such run folder")
        if not folders:
            raise UserError(f"{path}: neither a run folder nor a folder that holds runs")
        for folder in sorted(folders):
            known = found.setdefault(folder.resolve(), folder)
            found[folder.resolve()] = min(known, folder)
    return sorted(found.values())


def read(path: Path) -> Run | str:
    """A run, or why it can be no part of a comparison.

    Raises:
        ValueError: a file of it is damaged.
    """
    folder = RunFolder(path)
    config = folder.config(device="cpu")
    lines = _lines(folder)
    if len(lines) < config.episodes:
        return f"unfinished: {len(lines)} of {config.episodes} episodes"
    try:
        evaluation = _evaluation(path / "eval.json", config)
    except FileNotFoundError:
        return f"not evaluated: there is no eval.json (emberlink eval {path})"
    newest = checkpoint(path)
    if newest is not None and newest.name != evaluation.checkpoint:
        return (
            f"eval.json is of {evaluation.checkpoint}, the newest checkpoint is {newest.name} "
            f"(emberlink eval {path})"
        )
    if newest is not None:
        check_trained_with(newest, config)
    return Run(path, config, lines, evaluation)


def evaluated_otherwise(run: Run) -> tuple[list[Run], list[tuple[str, str]]]:
    """The same run in other worlds, such as with messages lost: one for each eval_*.json that is.

    Returns:
        What there is, and what is left out: file, why.

    Raises:
        ValueError: a file is damaged.
    """
    found: list[Run] = []
    left_out: list[tuple[str, str]] = []
    for file in sorted(run.path.glob("eval_*.json")):
        evaluation = _evaluation(file, run.config)
        world = {"env": evaluation.environment}
        world["comm"] = evaluation.communication.get(LEARNED, {})
        other = {key: value for key, value in flat(world).items() if run.values.get(key) != value}
        why = [
            f"{name} is {getattr(evaluation, name)}, in eval.json {getattr(run.evaluation, name)}"
            for name in ("checkpoint", "fires", "start_seed")
            if getattr(evaluation, name) != getattr(run.evaluation, name)
        ]
        why += [f"{key}={other[key]}" for key in ("env.horizon", "env.grid") if key in other]
        if other and not why:
            found.append(replace(run, evaluation=evaluation, evaluated_with=other))
        elif other:
            left_out.append((str(file), f"evaluated otherwise: {', '.join(why)}"))
    return found, left_out


def _evaluation(file: Path, config: RunConfig) -> Evaluation:
    try:
        evaluation = TypeAdapter(Evaluation).validate_json(read_text(file, MAX_JSON))
    except ValidationError as error:
        raise UserError(f"{file}: {' '.join(describe(error).split())[:300]}") from None
    _check_evaluation(file, evaluation, config)
    return evaluation


def checkpoint(path: Path) -> Path | None:
    """A run folder's newest checkpoint, if it still has one."""
    try:
        return RunFolder(path).checkpoint()
    except ValueError:
        return None


def _lines(folder: RunFolder) -> list[dict[str, Any]]:
    file = folder.path / "metrics.jsonl"
    try:
        lines = folder.lines()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{file}: cannot be read: {error}") from None
    for number, line in enumerate(lines, 1):
        episode = line.get("episode") if isinstance(line, dict) else None
        if episode != number:
            raise UserError(f"{file}: line {number} is not that of episode {number}")
        for name in CURVES:
            value = line.get(name)
            try:
                _MEASURE.validate_python(value, strict=True)
            except ValidationError:
                raise UserError(
                    f"{file}: line {number}: {name}={value} is no finite number up to {LARGEST:g}"
                ) from None
    return lines


def _check_evaluation(file: Path, evaluation: Evaluation, config: RunConfig) -> None:
    for key in ("method", "setup", "seed"):
        found, expected = getattr(evaluation, key), getattr(config, key)
        if found != expected:
            raise UserError(f"{file}: {key}={found}, but the run's config.yaml says {expected}")
    if not evaluation.results:
        raise UserError(f"{file}: results holds no fire")
    for fire, policies in evaluation.results.items():
        if LEARNED not in policies:
            raise UserError(f"{file}: results.{fire} holds no policy {LEARNED!r}")
        for policy, measured in policies.items():
            for name in metrics.NAMES:
                if name not in measured:
                    raise UserError(f"{file}: results.{fire}.{policy} lacks {name}")
                if len(measured[name]) != evaluation.fires:
                    raise UserError(
                        f"{file}: results.{fire}.{policy}.{name} has {len(measured[name])} "
                        f"episodes; fires={evaluation.fires}"
                    )


def gather(runs: Sequence[Run]) -> tuple[list[Section], list[str]]:
    """Runs by setup and fire trained on, then by method, and notes on what sets runs apart.

    Runs of a group have equal configurations but for `NOT_COMPARED`. Of runs with the same seed the
    last by name is taken.

    Raises:
        ValueError: runs were not evaluated alike.
    """
    runs = sorted(runs, key=lambda run: (run.config.seed, run.path.name, run.path))
    _check_alike(runs)
    notes: list[str] = []
    sections: list[Section] = []
    by_section = _split(runs, lambda run: [run.config.setup, to_values(run.config)["fire"]])
    named = [
        (f"setup {m[0].config.setup}, trained on {m[0].config.fire.name}", m) for m in by_section
    ]
    labels = _labels(named, lambda key: key.startswith("fire."))
    for name, members in sorted(zip(labels, by_section, strict=True), key=lambda pair: pair[0]):
        groups = _groups(name, members, notes)
        _check_same_fires(name, members)
        sections.append(Section(name, tuple(groups)))
    return sections, notes


def _groups(section: str, runs: Sequence[Run], notes: list[str]) -> list[Group]:
    members = _split(runs, lambda run: [run.config.method, _trained(run), run.evaluated_with])
    apart = (*NOT_COMPARED, "method")
    named = [(m[0].config.method, m) for m in members]
    labels = [
        label + "".join(f", evaluated with {_typed(*one)}" for one in m[0].evaluated_with.items())
        for label, m in zip(
            _labels(named, lambda key: key.split(".")[0] not in apart), members, strict=True
        )
    ]
    groups: list[Group] = []
    for label, together in sorted(zip(labels, members, strict=True), key=lambda pair: pair[0]):
        by_seed = {run.config.seed: run for run in together}
        for run in together:
            taken = by_seed[run.config.seed]
            if run is not taken:
                notes.append(
                    f"{section}, {label}: seed {run.config.seed} was trained twice; "
                    f"{taken.path} is taken, {run.path} is left out"
                )
        kept = tuple(by_seed[seed] for seed in sorted(by_seed))
        differing = [key for key in _differing(kept) if key.split(".")[0] not in NAMELESS]
        if differing:
            notes.append(f"{section}, {label}: taken together though {', '.join(differing)} differ")
        groups.append(Group(label, kept))
    first = [group.runs[0] for group in groups]
    what = ("method", "replay", "comm", *NOT_COMPARED)
    for key in _differing(first):
        if key.split(".")[0] not in what:
            each = ", ".join(f"{g.label} {g.runs[0].values.get(key)}" for g in groups)
            notes.append(f"{section}: not all methods have the same {key}: {each}")
    return groups


def _trained(run: Run) -> dict[str, Any]:
    """What a run's training depends on, but for the seed."""
    return {k: v for k, v in run.values.items() if k.split(".")[0] not in NOT_COMPARED}


def _split(runs: Iterable[Run], key: Callable[[Run], Any]) -> list[list[Run]]:
    found: dict[str, list[Run]] = {}
    for run in runs:
        found.setdefault(json.dumps(key(run), sort_keys=True), []).append(run)
    return list(found.values())


def _typed(key: str, value: Any) -> str:
    """A setting as one types it."""
    words = {None: "null", True: "true", False: "false"}
    return f"{key}={words[value] if value is None or isinstance(value, bool) else value}"


def _labels(named: Sequence[tuple[str, Sequence[Run]]], wanted: Callable[[str], bool]) -> list[str]:
    """The names; where one stands for several lists of runs, with the keys that set them apart.

    Keys that are as in the recipe are left out.
    """
    labels: list[str] = []
    for name, members in named:
        alike = [other[0] for same, other in named if same == name]
        keys = [key for key in _differing(alike) if wanted(key)]
        own, recipe = members[0].values, _recipe(members[0].config) if keys else {}
        apart = ", ".join(
            _typed(key, own.get(key))
            for key in keys
            if key not in recipe or own.get(key) != recipe[key]
        )
        labels.append(f"{name} ({apart})" if apart else name)
    return labels


def _recipe(config: RunConfig) -> dict[str, Any]:
    """What a run's method, setup and fire are without further settings, by dotted key."""
    try:
        choices = [f"setup={config.setup}", f"fire={config.fire.name}"]
        return flat(to_values(resolve(config.method, choices)))
    except ValueError:  # no longer known
        return {}


def _differing(runs: Sequence[Run]) -> list[str]:
    keys = dict.fromkeys(key for run in runs for key in run.values)
    return [key for key in keys if len({repr(run.values.get(key)) for run in runs}) > 1]


def _check_alike(runs: Sequence[Run]) -> None:
    """All runs have played equally many episodes, of equal length, from the same starts."""
    facts = {
        "env.horizon": lambda run: run.config.env.horizon,
        "env.grid": lambda run: list(run.config.env.grid),
        "the number of held-out fires": lambda run: run.evaluation.fires,
        "start_seed of the evaluation": lambda run: run.evaluation.start_seed,
    }
    for name, fact in facts.items():
        for run in runs:
            if fact(run) != fact(runs[0]):
                raise UserError(
                    f"{runs[0].path} and {run.path} cannot be compared: {name} is "
                    f"{fact(runs[0])} and {fact(run)}"
                )


def _check_same_fires(section: str, runs: Sequence[Run]) -> None:
    first = runs[0]
    for run in runs:
        one, other = (sorted(r.evaluation.results) for r in (first, run))
        if one != other:
            raise UserError(
                f"{section}: {first.path} was evaluated on {', '.join(one)}, "
                f"{run.path} on {', '.join(other)}; evaluate them alike (emberlink eval RUN)"
            )
        for fire in one:
            if run.evaluation.held_out.get(fire) != first.evaluation.held_out.get(fire):
                raise UserError(
                    f"{section}: {first.path} and {run.path} were not evaluated on the same fires "
                    f"of {fire} (held_out in eval.json); evaluate them alike (emberlink eval RUN)"
                )
