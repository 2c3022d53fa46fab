"""Runs trainings as processes on this machine."""

import os
import subprocess
from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass

from emberlink.envs.utils.validation import STRICT, CountOrZero
from emberlink.trainers.sweep.executors import _process
from emberlink.trainers.sweep.executors.base import Executor, Task


@dataclass(frozen=True, kw_only=True, config=STRICT)
class LocalConfig:
    """Stores the settings of local processes."""

    workers: Annotated[int, Field(ge=1)] | None = None
    """runs at a time; the number of cores if None"""
    threads: Annotated[int, Field(ge=1)] | None = None
    """threads of each run; if None, the number of cores divided by the runs at a time"""
    seeds: Annotated[int, Field(ge=1)] = 1
    """seeds of a method that are trained in one process"""
    gpus: Annotated[int, Field(ge=1)] | None = None
    """GPUs that share the runs in turn; if None, `device` alone chooses the GPU"""
    restarts: CountOrZero = 3
    """how often a run is started again after it was killed"""


class LocalExecutor(Executor):
    """Runs each task as a child process, which saves and ends when this process ends."""

    config_type = LocalConfig

    def __init__(self, config: LocalConfig):
        self._config = config
        self.seeds, self.restarts = config.seeds, config.restarts
        affinity = getattr(os, "sched_getaffinity", None)
        self._cores = (len(affinity(0)) if affinity else os.cpu_count()) or 1
        self._threads = config.threads or 1
        self._gpus: list[tuple[subprocess.Popen, int]] = []

    def slots(self, tasks: int) -> int:
        workers = min(self._config.workers or self._cores, max(tasks, 1))
        self._threads = self._config.threads or max(self._cores // workers, 1)
        return workers

    def submit(self, task: Task) -> subprocess.Popen:
        gpus = range(self._config.gpus or 0)
        running = [gpu for handle, gpu in self._gpus if handle.poll() is None]
        gpu = min(gpus, key=running.count, default=None)
        handle = _process.start(task, self._threads, gpu)
        if gpu is not None:
            self._gpus.append((handle, gpu))
        return handle

    def poll(self, handle: subprocess.Popen) -> int | None:
        status = handle.poll()
        if status is not None and handle.stdin is not None:
            handle.stdin.close()
        return status

    def cancel(self, handle: subprocess.Popen) -> None:
        handle.terminate()

    def leave(self, handle: subprocess.Popen) -> None:
        _process.leave(handle)
