"""Reads and writes training states, from which a run can be resumed exactly."""

from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from torch import Tensor

from emberlink.envs.utils.errors import UserError
from emberlink.trainers.runs import checkpoint_file
from emberlink.trainers.training.non_finite import FIRE_TIMES, first_non_finite
from emberlink.trainers.training.rollback import Rollbacks
from emberlink.trainers.training.setup import TrainingSetup


@dataclass(frozen=True, kw_only=True)
class RunState:
    """The part of a training state that is not tensors."""

    step: int
    """steps of the batch of environments so far"""
    config: dict[str, Any]
    """configuration of the run, as plain values"""
    folders: list[str]
    """names of the run folders, one per seed"""
    sizes: list[dict[str, int]]
    """file -> size in bytes of the .jsonl files of each folder"""
    best: list[float | None]
    """best headline measure of each seed so far"""
    seconds: float
    """seconds of training so far"""
    rollbacks: dict[str, Any]
    """see `Rollbacks`"""
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
        run = RunState(**{field.name: header[field.name] for field in fields(RunState)})
    except KeyError as error:
        raise UserError(f"{path}: a checkpoint of another version: it has no {error}") from None
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
    if name := first_non_finite(tensors):
        raise UserError(f"{path}: {name} holds NaN or infinite numbers")
    try:
        _check_margins(setup, tensors)
        setup.load_state_dict(tensors, run.step)
        rollbacks = Rollbacks(**run.rollbacks)
    except (ValueError, KeyError, RuntimeError, TypeError, IndexError) as error:
        reason = " ".join(str(error).split())[:200]
        raise UserError(f"{path}: does not fit this training: {reason}") from None
    setup.learner.scale_lr(rollbacks.lr_scale)
    return rollbacks


def _check_margins(setup: TrainingSetup, tensors: dict[str, Tensor]) -> None:
    """Checks that times of fires are NaN in the padding around the grid, and only there."""
    for name, fresh in setup.env.base_env.state_dict().items():
        if name.endswith(FIRE_TIMES) and not fresh.isnan().equal(
            tensors[f"environments/{name}"].isnan()
        ):
            raise UserError(f"environments/{name} holds NaN within the grid")
