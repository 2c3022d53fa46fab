"""Defines the base class of executors, which run the trainings of a sweep, and finds them."""

import os
import subprocess
import sys
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar

from pydantic import Field

from emberlink.envs.utils.config_files import read
from emberlink.envs.utils.errors import UserError, unknown
from emberlink.envs.utils.plugins import Plugins
from emberlink.envs.utils.validation import from_plain
from emberlink.trainers.config.values import parse

Positive = Annotated[int, Field(ge=1)]
DIED = -9
"""status of a task that ended without reporting one, for example because its node failed"""


@dataclass(frozen=True)
class Task:
    """A training to run. The same task may be run again: it resumes the run."""

    run: Path
    """the run folder; an absolute path"""
    overrides: Sequence[str]
    """`key=value` of keys that a resumed training may change"""
    log: Path
    """file to which the output is appended; an absolute path"""
    place: Path = field(default_factory=Path.cwd)
    """working directory, to which paths in the configuration are relative"""

    def start(self, threads: int, gpu: int | None = None) -> subprocess.Popen:
        """Starts the training as a child process; it saves and ends when this process ends.

        It has as many threads unless `OMP_NUM_THREADS` is set, and sees `gpu` alone, or all.
        """
        settings = {"OMP_NUM_THREADS": str(threads), **os.environ, "COLUMNS": "120"}
        if gpu is not None:
            seen = os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",")
            settings["CUDA_VISIBLE_DEVICES"] = seen[gpu] if gpu < len(seen) > 1 else str(gpu)
        # -P: modules of the working directory are not imported.
        worker = [sys.executable, "-P", "-m", "emberlink.trainers.sweep.worker"]
        with self.log.open("ab") as log:
            # In a new session, so that Ctrl-C reaches only the sweep, which cancels its tasks.
            return subprocess.Popen(
                [*worker, str(self.run), *self.overrides],
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=settings,
                cwd=self.place,
                start_new_session=True,
            )


class Executor(ABC):
    """Runs trainings; made of an instance of `config_type`."""

    config_type: ClassVar[type]
    """a dataclass; its fields are the keys of configs/executor/NAME.yaml without `name`"""
    workers: int | None = None
    """tasks that are submitted at a time; all if None"""

    @abstractmethod
    def __init__(self, config: Any): ...

    @abstractmethod
    def submit(self, tasks: Sequence[Task]) -> Sequence[Any]:
        """Starts or queues tasks and returns a handle of each; a UserError if it takes no more."""

    @abstractmethod
    def poll(self, handle: Any) -> int | None:
        """Returns the exit status of a task, or None if it has not ended."""

    @abstractmethod
    def cancel(self, handle: Any) -> None:
        """Requests that a task saves and ends, without waiting; has no effect if it has ended."""


EXECUTORS = Plugins(Executor, "emberlink.executors", "executor")


def make(arguments: Sequence[str]) -> Executor:
    """Returns the executor of `executor=NAME` (`local` if missing) and `executor.KEY=VALUE`."""
    given = dict(map(parse, arguments))
    name = str(given.pop("executor", "local"))
    executor = EXECUTORS.find(name)
    values = {key: value for key, value in read("executor", name).items() if key != "name"}
    for key, value in given.items():
        first, _, option = key.removeprefix("executor.").partition(".")
        if first not in values:
            raise UserError(f"key {unknown(key, [f'executor.{known}' for known in values])}")
        values[first] = {**(values[first] or {}), option: value} if option else value
    return executor(from_plain(executor.config_type, values, "executor"))
