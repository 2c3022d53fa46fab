"""The header of a state: the numbers that go with its tensors, and what they must agree with."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import ConfigDict, Field, ValidationError
from pydantic.dataclasses import dataclass

from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import describe, from_plain, shown

if TYPE_CHECKING:
    from .trainer import Trainer

Count = Annotated[int, Field(ge=0)]
Seconds = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Coverage = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Sizes = dict[Annotated[str, Field(pattern=r"^(metrics|timing)\.jsonl$")], Count]


@dataclass(frozen=True, kw_only=True, config=ConfigDict(extra="forbid", strict=True))
class Header:
    """What `Trainer.save` writes beside the tensors."""

    sha256: str
    """the seal"""
    format: int
    """of the file"""
    kind: Literal["state"]
    config: dict[str, Any]
    """of the run"""
    folders: list[str]
    """names of the run folders, one per seed"""
    files: list[Annotated[Sizes, Field(min_length=2)]]
    """bytes of each run's files of lines by then"""
    best: list[Coverage | None]
    """highest coverage of each seed so far, percent"""
    seconds: Seconds
    """of training"""
    step: Count
    """of the environments"""
    updates: Count
    """of the learner"""
    draws: Count
    """of batches from the memory"""
    rows: Count
    """in the memory"""
    losses: Count
    """updates of the episode that is not finished"""
    # States from before there were rollbacks have none of these.
    rate: Annotated[float, Field(gt=0, le=1)] = 1.0
    """share of the configuration's learning rates"""
    tries: Count = 0
    """rollbacks since a checkpoint lay beyond `furthest`"""
    furthest: Count = 0
    """the latest step that there was a rollback from"""


def parse(path: Path, header: Mapping[str, Any]) -> Header:
    """A header of the right keys, types and ranges.

    Raises:
        ValueError: it is not one; one line.
    """
    try:
        return from_plain(Header, header)
    except ValueError as error:
        reason = describe(error) if isinstance(error, ValidationError) else str(error)
        raise UserError(f"{path}: its header: {reason}") from None


def check(path: Path, header: Header, trainer: "Trainer") -> None:
    """That a header agrees with itself and with the training that is to go on from it.

    Args:
        path: of the checkpoint, for messages.
        header: of it.
        trainer: of the same configuration.

    Raises:
        ValueError: it does not; one line.
    """
    for name in ("folders", "files", "best"):
        found = getattr(header, name)
        if len(found) != trainer.teams:
            raise UserError(
                f"{path}: its header: {name}={shown(found)}: should hold {trainer.teams}, "
                "one for each seed"
            )
    step, begun = header.step, header.step - header.step % trainer.config.env.horizon
    updates = _updates(trainer, step)
    wanted = {
        "rows": min(trainer.sampler.rows, step * trainer.config.num_envs),
        "updates": updates,
        "draws": updates,
        "losses": updates - _updates(trainer, begun),
    }
    for name, value in wanted.items():
        if (found := getattr(header, name)) != value:
            raise UserError(
                f"{path}: its header: {name}={shown(found)}: should be {value} after {step} steps"
            )


def _updates(trainer: "Trainer", step: int) -> int:
    """How many updates there are in so many steps: none before the memory holds a full batch."""
    if trainer.sampler.rows < trainer.enough:
        return 0
    first = -(-trainer.enough // trainer.config.num_envs)
    return max(0, step - first + 1) * trainer.config.learner.updates_per_step
