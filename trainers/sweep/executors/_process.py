"""Starts the process of a task; the process ends with its parent."""

import os
import subprocess
from contextlib import suppress

from emberlink.envs.utils.atomic_io import open_in_place
from emberlink.trainers.sweep.executors.base import Task


def start(task: Task, threads: int, gpu: int | None = None) -> subprocess.Popen:
    """Starts a task as a child process, whose output is appended to the log.

    The child saves and ends when its standard input is closed, as it is when this process ends.

    Args:
        task: the task.
        threads: threads of the training; `OMP_NUM_THREADS` overrides it.
        gpu: the only GPU that the training sees; None for all.

    Raises:
        OSError: the log cannot be written.
    """
    settings = {"OMP_NUM_THREADS": str(threads), **os.environ, "COLUMNS": "120"}
    if gpu is not None:
        seen = os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",")
        settings["CUDA_VISIBLE_DEVICES"] = seen[gpu] if gpu < len(seen) and seen[gpu] else str(gpu)
    with open_in_place(task.log, create=True) as log:
        # In a new session, so that Ctrl-C reaches only the sweep, which cancels the tasks.
        return subprocess.Popen(
            task.command,
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=subprocess.STDOUT,
            env=settings,
            cwd=task.place,
            start_new_session=True,
        )


def leave(process: subprocess.Popen) -> None:
    """Lets a child go on when this process ends."""
    if process.stdin is not None:
        with suppress(BrokenPipeError):  # it has ended
            process.stdin.write(b"-")
            process.stdin.close()
