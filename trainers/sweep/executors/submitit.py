"""Runs trainings as SLURM jobs, through submitit: an array for the tasks of each call."""

import os
import signal
import subprocess
import time
from collections.abc import Sequence
from contextlib import redirect_stderr, suppress
from importlib import import_module
from io import StringIO
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field
from pydantic.dataclasses import dataclass

from emberlink.envs.utils.errors import UserError, require
from emberlink.envs.utils.validation import STRICT, CountOrZero
from emberlink.trainers.sweep.executors.base import DIED, Executor, Positive, Task

_MOST = 1000
"""jobs of an array in SLURM's default configuration (MaxArraySize)"""
_LOOK = 5.0
"""seconds between two looks at SLURM's queue"""
_GRACE = 30.0
"""seconds for which a job may be missing in the queue, or its result on this machine"""
_UNTIL_KILLED = 120.0
"""seconds for which a job whose training was asked to save waits for its requeue or end"""
_SAVED = (128 + signal.SIGTERM, 128 + signal.SIGUSR2, -signal.SIGTERM, -signal.SIGUSR2)

Text = Annotated[str, BeforeValidator(lambda value: str(value) if type(value) is int else value)]
"""text that may look like a number, such as an account"""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class SubmititConfig:
    """Stores the settings of SLURM jobs."""

    cluster: Literal["slurm", "local"] = "slurm"
    """slurm, or submitit's processes on this machine, to try a sweep"""
    partition: Text | None = None
    """partition; SLURM's default if None"""
    account: Text | None = None
    """account; SLURM's default if None"""
    time: Positive = 60
    """minutes of a job"""
    cpus: Positive = 1
    """cores of a job"""
    gpus: CountOrZero = 0
    """GPUs of a job"""
    memory: Text | None = None
    """memory of a job, such as 4G"""
    notice: Positive = 90
    """seconds before the end of the time at which SLURM asks a run to save, or a minute earlier"""
    requeues: CountOrZero = 100
    """how often a job is requeued because its time is over"""
    workers: Positive | None = None
    """jobs in the queue at a time; as many as an array may have if None"""
    options: dict[str, str | int] = Field(default_factory=dict)
    """other options of sbatch"""


class _Training:
    """A training in a SLURM job, with the `checkpoint` that submitit calls."""

    def __init__(self, task: Task, threads: int):
        self._task, self._threads = task, threads
        self._process: subprocess.Popen | None = None

    def __call__(self) -> int:
        """Trains, and returns the exit status of the training."""
        # SLURM sends SIGTERM before it preempts a job. submitit would ignore it.
        signal.signal(signal.SIGTERM, lambda *_: self._ask_to_save())
        self._process = self._task.start(self._threads)
        while (status := self._process.poll()) is None:
            time.sleep(0.2)
        if status in _SAVED:
            time.sleep(_UNTIL_KILLED)  # SLURM requeues the job, or ends it
        return status

    def checkpoint(self) -> Any:
        """Waits until the training has saved; submitit calls it at SIGUSR2 and requeues the job."""
        self._ask_to_save()
        with suppress(ChildProcessError):
            # Not Popen.wait: this handler may interrupt Popen.poll, which holds a lock.
            os.waitid(os.P_PID, self._process.pid if self._process else 0, os.WEXITED | os.WNOWAIT)
        return import_module("submitit").helpers.DelayedSubmission(
            _Training(self._task, self._threads)
        )

    def _ask_to_save(self) -> None:
        if self._process:
            # Never counts as a second signal, so that the training saves in any case.
            self._process.send_signal(signal.SIGUSR2)


class _Handle:
    """A submitted task; `seen` is when its job was last in the queue."""

    def __init__(self, task: Task, job: Any):
        self.task, self.job, self.seen, self.grace = task, job, time.monotonic(), _GRACE


class SubmititExecutor(Executor):
    """Runs each task as a job of an array, which SLURM requeues if it is preempted."""

    config_type = SubmititConfig

    def __init__(self, config: SubmititConfig):
        require("submitit", "slurm", "executor=submitit")
        # submitit starts Python with -m, which would import a random.py of the working directory.
        os.environ.setdefault("PYTHONSAFEPATH", "1")
        self.workers = min(config.workers or _MOST, _MOST)
        self._config = config
        self._queue: set[str] | None = None
        self._looked = -_LOOK

    def submit(self, tasks: Sequence[Task]) -> Sequence[_Handle]:
        try:
            executor = self._make(tasks[0].log.parent / "submitit")
            # submitit also prints sbatch's messages.
            with redirect_stderr(StringIO()), executor.batch():
                jobs = [executor.submit(_Training(task, self._config.cpus)) for task in tasks]
        except (RuntimeError, OSError, ValueError, subprocess.CalledProcessError) as error:
            lines = [line.removeprefix("sbatch: error: ") for line in str(error).splitlines()]
            raise UserError(f"executor=submitit: {'; '.join(lines)[-300:]}") from None
        return [_Handle(task, job) for task, job in zip(tasks, jobs, strict=True)]

    def _make(self, folder: Path) -> Any:
        """Returns submitit's executor, which writes to a folder; a RuntimeError without SLURM."""
        config = self._config
        executor = import_module("submitit").AutoExecutor(
            folder, config.cluster, slurm_max_num_timeout=config.requeues
        )
        executor.update_parameters(
            name="emberlink",
            timeout_min=config.time,
            cpus_per_task=config.cpus,
            gpus_per_node=config.gpus or None,
            slurm_partition=config.partition,
            slurm_account=config.account,
            slurm_mem=config.memory,
            slurm_signal_delay_s=config.notice,
            slurm_array_parallelism=_MOST,
            slurm_additional_parameters={"requeue": True, **config.options},
        )
        return executor

    def poll(self, handle: _Handle) -> int | None:
        job, now = handle.job, time.monotonic()
        if job.paths.result_pickle.exists():
            try:
                return job.result()
            except Exception as error:  # whatever the training's process has raised
                said = str(error)
        elif not job.done() if self._config.cluster == "local" else self._is_queued(job.job_id):
            handle.seen = now
            return None
        elif now - handle.seen < handle.grace:
            return None
        else:
            said = job.stderr() or ""
        with handle.task.log.open("a") as log:
            log.write(f"{next(filter(str.strip, said.splitlines()[::-1]), 'the job has ended')}\n")
        return DIED

    def _is_queued(self, job: str) -> bool:
        """Returns whether a job is queued or running, by the last answer of SLURM."""
        # Not by submitit, whose sacct needs a cluster with accounting.
        if time.monotonic() - self._looked > _LOOK:
            self._looked = time.monotonic()
            command = ["squeue", "--me", "--noheader", "--array", "--format=%F_%K %A"]
            listed = subprocess.run(command, capture_output=True, text=True, check=False)
            if listed.returncode == 0:  # else the last answer counts
                self._queue = {*listed.stdout.split()}
        return self._queue is None or job in self._queue

    def cancel(self, handle: _Handle) -> None:
        handle.grace = 0.0
        handle.job.cancel(check=False)
