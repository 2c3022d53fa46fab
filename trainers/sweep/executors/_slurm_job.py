"""Runs the trainings of a SLURM job; submitit calls it on the node of the job."""

import signal
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from emberlink.envs.utils.atomic_io import write_bytes
from emberlink.trainers.sweep.executors import _extras, _process
from emberlink.trainers.sweep.executors.base import STATUS, STOP, Task

_SAVED = (128 + signal.SIGTERM, 128 + signal.SIGUSR2, -signal.SIGTERM, -signal.SIGUSR2)
_GRACE = 120.0
"""seconds for which a job waits for its end after its runs were interrupted"""


class Batch:
    """Trains the runs of a job.

    Args:
        tasks: the trainings.
        threads: threads of each training.
    """

    def __init__(self, tasks: Sequence[Task], threads: int):
        self._tasks, self._threads = tasks, threads
        self._running: dict[Path, subprocess.Popen] = {}

    def __call__(self) -> None:
        """Runs the trainings that have not ended."""
        utils = _extras.load("submitit.core.utils")

        # SLURM sends SIGTERM before it preempts a job. submitit would ignore it.
        signal.signal(signal.SIGTERM, lambda *_: self._ask_to_save())
        for task in self._tasks:
            if not file_of(task, STATUS).exists():
                self._running[task.log] = _process.start(task, self._threads)
        try:
            self._follow()
        except utils.UncompletedJobError:  # submitit does not requeue the job again
            for log in self._running:
                end(log, 128 + signal.SIGUSR2)
            raise

    def checkpoint(self) -> Any:
        """Waits until the trainings have saved; called by submitit at SIGUSR2."""
        self._ask_to_save()
        for process in self._running.values():
            process.wait()
        return _extras.load("submitit").helpers.DelayedSubmission(Batch(self._tasks, self._threads))

    def _ask_to_save(self) -> None:
        for process in self._running.values():
            # Never counts as a second signal, so that the training saves in any case.
            process.send_signal(signal.SIGUSR2)

    def _follow(self) -> None:
        """Waits until the trainings have ended, and stops those that are to be stopped."""
        told: set[Path] = set()
        ended: dict[Path, float] = {}
        while self._running:
            time.sleep(0.5)
            for log, process in list(self._running.items()):
                stop = log.with_suffix(STOP).exists()
                if stop and log not in told:
                    told.add(log)
                    process.terminate()
                status = process.poll()
                if status is None:
                    continue
                since = time.monotonic() - ended.setdefault(log, time.monotonic())
                if status in _SAVED and not stop and since < _GRACE:
                    continue  # SLURM requeues the job, or ends it
                del self._running[log]
                end(log, status)


def file_of(task: Task, suffix: str) -> Path:
    """Returns a file beside the log of a task."""
    return task.log.with_suffix(suffix)


def end(log: Path, status: int) -> None:
    """Records the exit status of the task with a log."""
    write_bytes(log.with_suffix(STATUS), str(status).encode())
