"""Reads and validates the evaluation and the training curves of a run folder."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from emberlink.envs import metrics
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import describe
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.evaluation.results import CURVES, LEARNED
from emberlink.trainers.runs.compact_json import infinite
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.runs.safe_read import MAX_JSON, check_parts, read_text

MAX_VALUE = 1e12
"""maximum absolute value of a measure"""
Measured = Annotated[float, Field(ge=-MAX_VALUE, le=MAX_VALUE, allow_inf_nan=False)]
_MEASURE = TypeAdapter(Measured)
Settings = Annotated[dict[str, Any], AfterValidator(infinite)]


@dataclass(frozen=True, config=ConfigDict(extra="ignore"))
class Evaluation:
    """The content of eval.json."""

    method: str
    setup: str
    world: str
    seed: int
    start_seed: int
    """seed of the start positions"""
    checkpoint: str
    """file name of the checkpoint that was evaluated"""
    fires: Annotated[int, Field(ge=1)]
    """episodes per policy and fire"""
    results: dict[str, dict[str, dict[str, list[Measured]]]]
    """fire -> policy -> measure -> one number per episode"""
    held_out: Settings = Field(default_factory=dict)
    """fire -> description of the held-out fires"""
    environment: Settings = Field(default_factory=dict)
    """settings of the environment"""
    communication: dict[str, Settings] = Field(default_factory=dict)
    """policy -> settings of the communication"""


def read_evaluation(file: Path, config: RunConfig) -> Evaluation:
    """Returns the content of an eval.json.

    Args:
        file: path of the file.
        config: configuration of its run.

    Raises:
        FileNotFoundError: there is no such file.
        UserError: the file is damaged, incomplete, or of another run.
    """
    text = read_text(file, MAX_JSON)
    try:
        check_parts(text)
        evaluation = TypeAdapter(Evaluation).validate_json(text)
    except ValidationError as error:
        raise UserError(f"{file}: {' '.join(describe(error).split())[:300]}") from None
    except UserError as error:
        raise UserError(f"{file}: {error}") from None
    for key in ("method", "setup", "seed"):
        actual, expected = getattr(evaluation, key), getattr(config, key)
        if actual != expected:
            raise UserError(f"{file}: {key}={actual}, but the run's config.yaml says {expected}")
    _check_results(file, evaluation)
    return evaluation


def _check_results(file: Path, evaluation: Evaluation) -> None:
    """Checks that every policy has all measures of all episodes."""
    if not evaluation.results:
        raise UserError(f"{file}: results has no fire")
    for fire, policies in evaluation.results.items():
        if LEARNED not in policies:
            raise UserError(f"{file}: results.{fire} has no policy {LEARNED!r}")
        for policy, measured in policies.items():
            for name in metrics.NAMES:
                if name not in measured:
                    raise UserError(f"{file}: results.{fire}.{policy} lacks {name}")
                if len(measured[name]) != evaluation.fires:
                    raise UserError(
                        f"{file}: results.{fire}.{policy}.{name} has {len(measured[name])} "
                        f"episodes; fires={evaluation.fires}"
                    )


def read_curves(folder: RunFolder) -> list[dict[str, Any]]:
    """Returns the lines of metrics.jsonl, one per episode of training.

    Raises:
        UserError: an episode is missing or out of order, or a measure is not a finite number.
    """
    file = folder.path / "metrics.jsonl"
    try:
        lines = folder.metrics()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{file}: cannot be read: {error}") from None
    for number, line in enumerate(lines, 1):
        if line.get("episode") != number:
            raise UserError(f"{file}: line {number} is not of episode {number}")
        for name in CURVES:
            value = line.get(name)
            try:
                _MEASURE.validate_python(value, strict=True)
            except ValidationError:
                raise UserError(
                    f"{file}: line {number}: {name}={value} is no finite number up to {MAX_VALUE:g}"
                ) from None
    return lines
