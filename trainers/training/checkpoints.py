"""Reads and writes training states, from which a run can be resumed exactly."""

from dataclasses import asdict, fields
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field
from pydantic.dataclasses import dataclass
from torch import Tensor

from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import STRICT, CountOrZero, from_plain
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.runs import checkpoint_file
from emberlink.trainers.training.folders import LINES
from emberlink.trainers.training.non_finite import FIRE_TIMES, first_non_finite
from emberlink.trainers.training.rollback import Rollbacks
from emberlink.trainers.training.setup import TrainingSetup

_Number = Annotated[float, Field(allow_inf_nan=False)]


@dataclass(frozen=True, kw_only=True, config=STRICT)
class RunState:
    """The part of a training state that is not tensors."""

    step: CountOrZero
    """steps of the batch of environments so far"""
    config: dict[str, Any]
    """configuration of the run, as plain values"""
    folders: list[str]
    """names of the run folders, one per seed"""
    sizes: list[dict[str, CountOrZero]]
    """file -> size in bytes of the .jsonl files of each folder"""
    best: list[_Number | None]
    """best headline measure of each seed so far"""
    seconds: Annotated[_Number, Field(ge=0)]
    """seconds of training so far"""
    rollbacks: Rollbacks
    """rollbacks so far"""
    tensors: int
    """number of tensors in the checkpoint"""
    versions: dict[str, str]
    """of the packages that it was made with"""


def write(path: Path, run: RunState, tensors: dict[str, Tensor]) -> None:
    """Writes a training state completely, or not at all.

    Raises:
        UserError: it cannot be written, such as to a full disk.
    """
    checkpoint_file.write(path, tensors, {"kind": "state", **asdict(run)})


def read(path: Path) -> tuple[RunState, dict[str, Tensor]]:
    """Returns the numbers and tensors of a training state.

    Raises:
        UserError: the file cannot be read, is damaged, or is not a training state.
    """
    header, tensors = checkpoint_file.read(path)
    if header.get("kind") != "state":
        raise UserError(f"{path}: holds networks alone; nothing can be resumed from it")
    try:
        values = {field.name: header[field.name] for field in fields(RunState)}
    except KeyError as error:
        raise UserError(f"{path}: a checkpoint of another version: it has no {error}") from None
    try:
        run = from_plain(RunState, values)
    except UserError as error:
        raise UserError(f"{path}: a checkpoint of another version, or damaged: {error}") from None
    if len(tensors) != run.tensors:
        raise UserError(f"{path}: holds {len(tensors)} tensors; expected {run.tensors}")
    return run, tensors


def restore(
    path: Path, setup: TrainingSetup, run: RunState, tensors: dict[str, Tensor]
) -> Rollbacks:
    """Restores a new setup from a training state and returns the rollbacks of the state.

    Raises:
        UserError: the tensors do not fit the setup, or are not finite.
    """
    try:
        if name := first_non_finite(tensors):
            raise UserError(f"{name} holds NaN or infinite numbers")
        _check_teams(setup, run)
        _check_margins(setup, tensors)
        setup.load_state_dict(tensors, run.step)
    except (ValueError, KeyError, RuntimeError, TypeError, IndexError) as error:
        reason = " ".join(str(error).split())[:200]
        raise UserError(f"{path}: does not fit this training: {reason}") from None
    setup.learner.scale_lr(run.rollbacks.lr_scale)
    return run.rollbacks


def best(run: RunState, config: RunConfig) -> list[float | None]:
    """Returns the best headline measure of each seed; None if it is now measured in another way."""
    before, now = run.config["evaluation"], config.evaluation
    compared = ("headline", "huygens", "interval_episodes")
    same = all(before[key] == getattr(now, key) for key in compared)
    on_the_same_fires = (before["interval"] > 0) == (now.interval > 0)
    return list(run.best) if same and on_the_same_fires else [None] * len(run.best)


def _check_teams(setup: TrainingSetup, run: RunState) -> None:
    """Checks that the state is one of the setup's seeds, made at a decision."""
    if not len(run.folders) == len(run.sizes) == len(run.best) == setup.teams:
        raise UserError(f"of {len(run.folders)} seeds; expected {setup.teams}")
    if any(set(sizes) != set(LINES) for sizes in run.sizes):
        raise UserError(f"the sizes of other files than {', '.join(LINES)}")
    if run.step % setup.config.policy.hold:
        raise UserError(f"step={run.step}: within a decision")


def _check_margins(setup: TrainingSetup, tensors: dict[str, Tensor]) -> None:
    """Checks that times of fires are NaN in the padding around the grid, and only there."""
    for name, fresh in setup.env.base_env.state_dict().items():
        if name.endswith(FIRE_TIMES) and not fresh.isnan().equal(
            tensors[f"environments/{name}"].isnan()
        ):
            raise UserError(f"environments/{name} holds NaN within the grid")
