"""Finds finished runs on disk and reads them."""

import math
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from emberlink.envs.utils.errors import UserError
from emberlink.trainers.comparison.evaluation_file import Evaluation, read_curves, read_evaluation
from emberlink.trainers.config.compose import flat, to_values
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.evaluation.results import LEARNED
from emberlink.trainers.runs import pretrained
from emberlink.trainers.runs.run_folder import RunFolder

LeftOut = tuple[str, str]
"""a folder or file that is not compared, and the reason"""


@dataclass(frozen=True)
class Run:
    """A finished run with an evaluation.

    Attributes:
        path: the run folder.
        config: configuration of the training.
        lines: lines of metrics.jsonl, one per training episode.
        evaluation: content of eval.json or of an eval_*.json.
        evaluated_with: dotted key -> value of each setting of the evaluation that differs from the
            training, such as env.radio.loss; empty for eval.json.
    """

    path: Path
    config: RunConfig
    lines: Sequence[Mapping[str, Any]]
    evaluation: Evaluation
    evaluated_with: Mapping[str, Any] = field(default_factory=dict)

    @cached_property
    def settings(self) -> dict[str, Any]:
        """The configuration by dotted key."""
        return flat(to_values(self.config))

    def mean(self, fire: str, policy: str, measure: str) -> float:
        """Returns the mean over the episodes of a policy on a fire."""
        numbers = self.evaluation.results[fire][policy][measure]
        return math.fsum(numbers) / len(numbers)


def settings_of(name: str) -> dict[str, Any] | str:
    """Returns the configuration of a run by dotted key; its name if it cannot be read."""
    try:
        return flat(to_values(RunFolder(name).config(device="cpu")))
    except UserError:
        return name


def read_all(paths: Iterable[Path | str]) -> tuple[list[Run], list[LeftOut]]:
    """Reads the runs of a comparison.

    Args:
        paths: run folders, folders of run folders, or names such as `pretrained:tuned`.

    Returns:
        The finished runs, one entry per evaluation, and the folders and files left out.

    Raises:
        UserError: a path holds no run, or a file is damaged.
    """
    runs: list[Run] = []
    left_out: list[LeftOut] = []
    for path in find(paths):
        run = read(path)
        if isinstance(run, Run):
            others, why = evaluated_otherwise(run)
            runs += [run, *others]
            left_out += why
        else:
            left_out.append((str(path), run))
    return runs, left_out


def find(paths: Iterable[Path | str]) -> list[Path]:
    """Returns the run folders among `paths` and directly within them, sorted and unique.

    Raises:
        UserError: a path is not a run folder and does not hold any.
    """
    unique: dict[Path, Path] = {}
    for name in paths:
        path = Path(name)
        if pretrained.is_name(str(name)):
            folders = pretrained.find(str(name))
        elif (path / "config.yaml").is_file():
            folders = [path]
        elif path.is_dir():
            folders = [folder.parent for folder in path.glob("*/config.yaml")]
        else:
            raise UserError(f"{path}: there is no such run folder")
        if not folders:
            raise UserError(f"{path}: neither a run folder nor a folder that holds runs")
        for folder in sorted(folders):
            known = unique.setdefault(folder.resolve(), folder)
            unique[folder.resolve()] = min(known, folder)
    return sorted(unique.values())


def read(path: Path) -> Run | str:
    """Returns a run, or the reason why it cannot be compared.

    Raises:
        UserError: a file of the run is damaged.
    """
    folder = RunFolder(path)
    config = folder.config(device="cpu")
    lines = read_curves(folder)
    if len(lines) < config.episodes:
        return f"unfinished: {len(lines)} of {config.episodes} episodes"
    again = f"emberlink eval {shlex.quote(str(path))}"
    try:
        evaluation = read_evaluation(path / "eval.json", config)
    except FileNotFoundError:
        return f"not evaluated: there is no eval.json ({again})"
    if folder.newest.exists() and not folder.evaluated():
        return f"eval.json is not of the newest checkpoint ({again})"
    return Run(path, config, lines[: config.episodes], evaluation)


def evaluated_otherwise(run: Run) -> tuple[list[Run], list[LeftOut]]:
    """Reads the evaluations of a run with changed settings, one per eval_*.json.

    Returns:
        The run with each of these evaluations, and the files left out: their checkpoint or fires
        differ from those of eval.json, or another file has the same settings.

    Raises:
        UserError: a file is damaged.
    """
    others: list[Run] = []
    left_out: list[LeftOut] = []
    names: dict[str, str] = {}
    for file in sorted(run.path.glob("eval_*.json")):
        evaluation = read_evaluation(file, run.config)
        changed = _changed_settings(run, evaluation)
        if not changed:
            continue
        why = [
            f"{name} is {getattr(evaluation, name)}, in eval.json {getattr(run.evaluation, name)}"
            for name in ("world", "checkpoint", "fires", "start_seed")
            if getattr(evaluation, name) != getattr(run.evaluation, name)
        ]
        why += [f"{key}={changed[key]}" for key in ("env.horizon", "env.grid") if key in changed]
        settings = repr(sorted(changed.items()))
        if why:
            left_out.append((str(file), f"evaluated otherwise: {', '.join(why)}"))
        elif settings in names:
            left_out.append((str(file), f"has the settings of {names[settings]}"))
        else:
            names[settings] = file.name
            others.append(replace(run, evaluation=evaluation, evaluated_with=changed))
    return others, left_out


def _changed_settings(run: Run, evaluation: Evaluation) -> dict[str, Any]:
    """Returns the settings of an evaluation that differ from the training, by dotted key."""
    learned = evaluation.communication.get(LEARNED, {})
    settings = flat({"world": evaluation.world, "env": evaluation.environment, "comm": learned})
    return {key: value for key, value in settings.items() if run.settings.get(key) != value}
