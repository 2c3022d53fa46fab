"""The interface between a sweep and the place where its trainings run."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar


@dataclass(frozen=True)
class Task:
    """A training to run.

    Attributes:
        arguments: of `emberlink train`.
        log: a new file for its output.
        locks: file descriptors that its process keeps open as long as it runs, if it runs on this
            machine; the sweep closes its own when the task has ended.
    """

    arguments: Sequence[str]
    log: Path
    locks: Sequence[int] = field(default=())


class Executor(ABC):
    """Runs trainings somewhere, several at a time.

    Args:
        config: of type `config_type`.
    """

    config_type: ClassVar[type]
    """a dataclass whose fields are the keys of configs/executor/NAME.yaml but `name`"""

    @abstractmethod
    def __init__(self, config: Any): ...

    @abstractmethod
    def slots(self, tasks: int) -> int:
        """Returns how many tasks to submit at a time.

        Args:
            tasks: how many there are in all.
        """

    @abstractmethod
    def submit(self, task: Task) -> Any:
        """Starts a task and returns a handle on it, without waiting.

        Raises:
            OSError: the task cannot be started, such as for a log that cannot be written.
        """

    @abstractmethod
    def poll(self, handle: Any) -> int | None:
        """Returns the exit status of a task, or None while it waits or runs."""

    @abstractmethod
    def cancel(self, handle: Any) -> None:
        """Asks a task to save and end; a task that has ended is left alone. Does not wait."""
