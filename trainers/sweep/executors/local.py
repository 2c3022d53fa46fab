"""Runs trainings as processes on this machine."""

import os
import subprocess
import sys
from typing import Annotated

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from emberlink.trainers.sweep.executors.base import Executor, Task

_PROGRAM = "emberlink.trainers.sweep.executors._process"


@dataclass(frozen=True, kw_only=True, config=ConfigDict(extra="forbid", strict=True))
class LocalConfig:
    """The settings of local processes."""

    workers: Annotated[int, Field(ge=1)] | None = None
    """runs at a time; the number of cores if None"""
    threads: Annotated[int, Field(ge=1)] | None = None
    """threads of each run; if None, the number of cores divided by the runs at a time"""


class LocalExecutor(Executor):
    """Runs each task as a child process, which saves and ends when this process ends."""

    config_type = LocalConfig

    def __init__(self, config: LocalConfig):
        self._config = config
        affinity = getattr(os, "sched_getaffinity", None)
        self._cores = (len(affinity(0)) if affinity else os.cpu_count()) or 1
        self._threads = config.threads or 1

    def slots(self, tasks: int) -> int:
        workers = min(self._config.workers or self._cores, max(tasks, 1))
        self._threads = self._config.threads or max(self._cores // workers, 1)
        return workers

    def submit(self, task: Task) -> subprocess.Popen:
        settings = {"OMP_NUM_THREADS": str(self._threads), **os.environ, "COLUMNS": "120"}
        with task.log.open("x") as log:
            # In a new session, so that Ctrl-C reaches only the sweep, which cancels the tasks.
            # -P: modules of the working directory are not imported.
            return subprocess.Popen(
                [sys.executable, "-P", "-m", _PROGRAM, *task.arguments],
                stdin=subprocess.PIPE,  # closed when this process ends
                stdout=log,
                stderr=subprocess.STDOUT,
                env=settings,
                pass_fds=task.locks,
                start_new_session=True,
            )

    def poll(self, handle: subprocess.Popen) -> int | None:
        status = handle.poll()
        if status is not None and handle.stdin is not None:
            handle.stdin.close()
        return status

    def cancel(self, handle: subprocess.Popen) -> None:
        handle.terminate()
