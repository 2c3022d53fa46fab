"""Runs trainings as processes on this machine."""

import os
import subprocess
from collections.abc import Sequence

from pydantic.dataclasses import dataclass

from emberlink.envs.utils.validation import STRICT
from emberlink.trainers.sweep.executors.base import Executor, Positive, Task


@dataclass(frozen=True, kw_only=True, config=STRICT)
class LocalConfig:
    """Stores the settings of local processes."""

    workers: Positive | None = None
    """runs at a time; the number of cores if None"""
    threads: Positive | None = None
    """threads of each run; if None, the number of cores divided by the runs at a time"""
    gpus: Positive | None = None
    """GPUs that share the runs in turn; if None, `device` alone chooses the GPU"""


class LocalExecutor(Executor):
    """Runs each task as a child process, which saves and ends when this process ends."""

    config_type = LocalConfig

    def __init__(self, config: LocalConfig):
        affinity = getattr(os, "sched_getaffinity", None)
        self._cores = (len(affinity(0)) if affinity else os.cpu_count()) or 1
        self.workers = config.workers or self._cores
        self._config, self._threads = config, config.threads
        self._started: list[tuple[subprocess.Popen, int | None]] = []

    def submit(self, tasks: Sequence[Task]) -> Sequence[subprocess.Popen]:
        # The first tasks are all, or as many as run at a time.
        self._threads = self._threads or max(self._cores // len(tasks), 1)
        for task in tasks:  # each on the GPU with the fewest tasks, if the GPUs are shared
            busy = [gpu for process, gpu in self._started if process.poll() is None]
            gpu = min(range(self._config.gpus or 0), key=busy.count, default=None)
            self._started.append((task.start(self._threads, gpu), gpu))
        return [process for process, _ in self._started[-len(tasks) :]]

    def poll(self, handle: subprocess.Popen) -> int | None:
        return handle.poll()

    def cancel(self, handle: subprocess.Popen) -> None:
        handle.terminate()
