"""Defines the base class of executors, which run the trainings of a sweep."""

import json
import sys
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar

from pydantic import Field

from emberlink.envs.utils.errors import UserError

Positive = Annotated[int, Field(ge=1)]

DIED = -9
"""status of a task that ended without reporting one, for example because its node failed"""
STATUS, STOP = ".status", ".stop"
"""suffixes of files beside a log: the exit status of the task; a request to save and end"""
_WORKER = "emberlink.trainers.sweep.worker"


class QueueFullError(UserError):
    """Reports that a cluster takes no task now; those that it has taken go on."""


@dataclass(frozen=True)
class Task:
    """A training to run. The same task may be run again: it resumes the run.

    Attributes:
        arguments: arguments of `emberlink train`.
        log: file for the output; an absolute path.
        leases: run -> token of the lease that the sweep holds; see trainers/sweep/leases.py.
        output: folder of the run folders; an absolute path.
        restarts: how often the run may be started again after it ended without saving.
        place: working directory, to which paths in the arguments are relative.
    """

    arguments: Sequence[str]
    log: Path
    leases: Mapping[str, str] = field(default_factory=dict)
    output: Path = Path()
    restarts: int = 3
    place: Path = field(default_factory=Path.cwd)

    @property
    def command(self) -> list[str]:
        """The command that runs the training while it holds the leases of its runs."""
        settings = {
            "output": str(self.output),
            "leases": dict(self.leases),
            "restarts": self.restarts,
        }
        # -P: modules of the working directory are not imported.
        return [sys.executable, "-P", "-m", _WORKER, json.dumps(settings), *self.arguments]


class Executor(ABC):
    """Runs trainings, several at a time.

    Args:
        config: an instance of `config_type`.
    """

    config_type: ClassVar[type]
    """a dataclass; its fields are the keys of configs/executor/NAME.yaml without `name`"""
    interval: ClassVar[float] = 0.5
    """seconds between two polls"""
    restarts: int = 3
    """how often a run may be started again after it ended without saving"""
    seeds: int = 1
    """seeds of a method that are trained in one process"""

    may_leave: bool = True
    """whether tasks can go on when this process ends"""

    @abstractmethod
    def __init__(self, config: Any): ...

    @abstractmethod
    def slots(self, tasks: int) -> int:
        """Returns the number of tasks to run at a time.

        Args:
            tasks: number of all tasks.
        """

    @abstractmethod
    def submit(self, task: Task) -> Any:
        """Starts a task without waiting for it and returns a handle.

        Raises:
            OSError: the task cannot be started, for example because the log cannot be written.
            QueueFullError: the cluster takes no task now.
        """

    @abstractmethod
    def poll(self, handle: Any) -> int | None:
        """Returns the exit status of a task, or None if it has not ended.

        The status is negative if the task reported none, as a process that was killed.
        """

    @abstractmethod
    def cancel(self, handle: Any) -> None:
        """Requests that a task saves and ends, without waiting; has no effect if it has ended."""

    def leave(self, handle: Any) -> None:
        """Lets a task go on when this process ends; has no effect if tasks do so anyway."""
        return

    def name_of(self, handle: Any) -> str:
        """Returns a name by which `find` finds a task from another process; may be empty."""
        return ""

    def find(self, name: str) -> Any:
        """Returns the handle of a task that was left, or None if it has ended or is not known."""
        return None
