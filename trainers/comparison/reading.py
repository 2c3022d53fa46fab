"""Finds finished runs on disk and reads them, their configurations as plain values."""

import json
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, ConfigDict, Field, FiniteFloat
from pydantic.dataclasses import dataclass as checked

from emberlink.envs.utils.errors import UserError, naming
from emberlink.envs.utils.validation import from_plain
from emberlink.trainers.config.values import flat
from emberlink.trainers.evaluation.foreign import foreign_name
from emberlink.trainers.evaluation.scores import LEARNED
from emberlink.trainers.runs import pretrained
from emberlink.trainers.runs.compact_json import infinite
from emberlink.trainers.runs.run_folder import MAX_JSON, RunFolder, read_text

LeftOut = tuple[str, str]
"""a folder or file that is not compared, and the reason"""
Settings = Annotated[dict[str, Any], AfterValidator(infinite)]


@checked(frozen=True, config=ConfigDict(extra="ignore"))
class Evaluation:
    """The content of eval.json or of an eval_*.json."""

    start_seed: int
    """seed of the start positions"""
    fires: Annotated[int, Field(ge=1)]
    """episodes per policy and fire"""
    results: Annotated[dict[str, dict[str, dict[str, list[FiniteFloat]]]], Field(min_length=1)]
    """fire -> policy -> measure -> one number per episode"""
    step: int = 0
    """step of training of the checkpoint"""
    world: str = "paper"
    message_fault: str = "none"
    """`evaluation.message_fault`"""
    environment: Settings = Field(default_factory=dict)
    """settings of the environment"""
    communication: dict[str, Settings] = Field(default_factory=dict)
    """policy -> settings of the communication"""


@dataclass(frozen=True)
class EvaluatedRun:
    """A finished run with an evaluation."""

    path: Path
    name: str
    """the method, or the label that the user gave"""
    settings: Mapping[str, Any]
    """configuration of the training by dotted key"""
    lines: Sequence[Mapping[str, Any]]
    """lines of metrics.jsonl, one per training episode"""
    evaluation: Evaluation
    evaluated_with: Mapping[str, Any] = field(default_factory=dict)
    """dotted key -> value where the evaluation differs from the training; empty for eval.json"""

    @property
    def now(self) -> dict[str, Any]:
        """The settings of the evaluation by dotted key."""
        return {**self.settings, **self.evaluated_with}

    @property
    def headline(self) -> str:
        """The headline measure of the run's world."""
        return self.settings["evaluation.headline"]


def read_all(
    paths: Sequence[Path | str], labels: Sequence[str] = ()
) -> tuple[list[EvaluatedRun], list[LeftOut]]:
    """Returns the finished runs of paths, one entry per evaluation, and the runs left out."""
    if labels and len(labels) != len(paths):
        raise UserError(f"{len(labels)} labels for {len(paths)} paths: one each")
    named = zip(paths, labels or [""] * len(paths), strict=True)
    folders = {each.resolve(): (each, label) for path, label in named for each in find(path)}
    runs: list[EvaluatedRun] = []
    left_out: list[LeftOut] = []

    @contextmanager
    def or_left_out(path: Path) -> Iterator[None]:
        try:
            yield
        except (UserError, OSError) as error:
            left_out.append((str(path), str(error)))
        except KeyError as error:
            left_out.append((str(path), f"{error} is missing in its files"))

    for folder, label in sorted(folders.values()):
        with or_left_out(folder):
            run = read(folder)
            runs.append(run := replace(run, name=label or run.name))
            for file in sorted(folder.glob("eval_*.json")):
                with or_left_out(file):
                    runs += evaluated_otherwise(run, file)
    return runs, left_out


def find(path: Path | str) -> list[Path]:
    """Returns the run folder of a path, or those directly within it; a UserError without one."""
    folder = Path(path)
    if pretrained.is_name(str(path)):
        return pretrained.find(str(path))
    if (folder / "config.yaml").is_file():
        return [folder]
    if not (found := [file.parent for file in folder.glob("*/config.yaml")]):
        raise UserError(f"{folder}: neither a run folder nor a folder that holds runs")
    return found


def read(path: Path) -> EvaluatedRun:
    """Returns a run; a UserError if it is not finished or not evaluated, or a file is damaged."""
    folder = RunFolder(path)
    settings = {"edition": 1, **flat(folder.values())}
    name = foreign_name(folder)
    lines, episodes = ([], 0) if name else (folder.metrics(), settings["episodes"])
    if len(lines) < episodes:
        raise UserError(f"unfinished: {len(lines)} of {episodes} episodes")
    again = f"emberlink eval {shlex.quote(str(path))}"
    if not (path / "eval.json").exists():
        raise UserError(f"not evaluated: there is no eval.json ({again})")
    evaluation = read_evaluation(path / "eval.json")
    tested = evaluation.step
    if folder.newest.exists() and (trained := folder.step()) != tested:
        raise UserError(
            f"eval.json is of step {tested}, the newest checkpoint of {trained} ({again})"
        )
    return EvaluatedRun(path, name or settings["method"], settings, lines[:episodes], evaluation)


def read_evaluation(file: Path) -> Evaluation:
    """Returns the content of an eval.json."""
    with naming(file):
        evaluation = from_plain(Evaluation, json.loads(read_text(file, MAX_JSON)))
        if not all(LEARNED in played for played in evaluation.results.values()):
            raise UserError("has no results of the policy")
        return evaluation


def evaluated_otherwise(run: EvaluatedRun, file: Path) -> list[EvaluatedRun]:
    """Returns a run as evaluated in an eval_*.json; none if it repeats the settings of eval.json.

    A UserError if the file is damaged, or its step or fires differ from eval.json.
    """
    evaluation = read_evaluation(file)
    learned = evaluation.communication.get(LEARNED, {})
    now = flat({"world": evaluation.world, "env": evaluation.environment, "comm": learned})
    changed = {key: value for key, value in now.items() if run.settings.get(key) != value}
    if evaluation.message_fault != run.evaluation.message_fault:
        changed["evaluation.message_fault"] = evaluation.message_fault
    names = ("world", "step", "fires", "start_seed")
    apart = [n for n in names if getattr(evaluation, n) != getattr(run.evaluation, n)]
    apart += [key for key in ("env.horizon", "env.grid") if key in changed]
    if changed and apart:
        raise UserError(f"evaluated with another {', '.join(apart)} than eval.json")
    return [replace(run, evaluation=evaluation, evaluated_with=changed)] if changed else []
