"""Defines the base class of executors, which run the trainings of a sweep."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar


@dataclass(frozen=True)
class Task:
    """A training to run.

    Attributes:
        arguments: arguments of `emberlink train`.
        log: a new file for the output.
        locks: file descriptors that a process on this machine must inherit and keep open. The sweep
            closes its own descriptors when the task has ended.
    """

    arguments: Sequence[str]
    log: Path
    locks: Sequence[int] = field(default=())


class Executor(ABC):
    """Runs trainings, several at a time.

    Args:
        config: an instance of `config_type`.
    """

    config_type: ClassVar[type]
    """a dataclass; its fields are the keys of configs/executor/NAME.yaml without `name`"""

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
        """

    @abstractmethod
    def poll(self, handle: Any) -> int | None:
        """Returns the exit status of a task, or None if it has not ended."""

    @abstractmethod
    def cancel(self, handle: Any) -> None:
        """Requests that a task saves and ends, without waiting; has no effect if it has ended."""
