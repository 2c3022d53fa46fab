"""Runs trainings as SLURM jobs, through submitit: an array for the tasks of each call."""

import hashlib
import os
import shutil
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

from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import STRICT, CountOrZero
from emberlink.trainers.sweep.executors.base import DIED, Executor, Positive, Task, require

_MOST = 1000
"""jobs of an array in SLURM's default configuration (MaxArraySize)"""
_LOOK = 5.0
"""seconds between two looks at SLURM's queue"""
_GRACE = 30.0
"""seconds for which a job may be missing in the queue, such as while it is requeued"""
_UNTIL_KILLED = 120.0
"""seconds for which a job whose training was asked to save waits for its requeue or end"""
_SAVED = (128 + signal.SIGTERM, 128 + signal.SIGUSR2, -signal.SIGTERM, -signal.SIGUSR2)
_FOR_SBATCH = ("partition", "account", "time", "cpus", "gpus", "memory", "options")
"""settings that become options of sbatch"""


def minutes(text: str) -> int:
    """Returns the minutes of a time in one of the forms of sbatch, such as 90 or 1-12:00:00.

    Raises:
        UserError: it has another form, or is 0, which SLURM reads as no limit.
    """
    days, _, rest = text.rpartition("-")
    parts = rest.split(":")
    if len(parts) <= 3 and all(part.isdecimal() for part in [*parts, days or "0"]):
        numbers = [int(part) for part in parts]
        if not days and len(parts) < 3:
            numbers = [0, *numbers]
        hours, whole, seconds = [*numbers, 0, 0][:3]
        if total := (24 * int(days or 0) + hours) * 60 + whole + (seconds > 0):
            return total
    raise UserError("expected minutes, or H:MM:SS, or D-HH:MM:SS")


def _time(value: object) -> str:
    minutes(str(value))
    return str(value)


Text = Annotated[str, BeforeValidator(lambda value: str(value) if type(value) is int else value)]
"""text that may look like a number, such as an account"""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class SubmititConfig:
    """Stores the settings of SLURM jobs."""

    cluster: Literal["slurm", "local"] = "slurm"
    """slurm, or submitit's local processes for tests"""
    partition: Text | None = None
    """partition; SLURM's default if None"""
    account: Text | None = None
    """account; SLURM's default if None"""
    time: Annotated[str, BeforeValidator(_time)] = "60"
    """time of a job: minutes, or as in sbatch"""
    cpus: Positive = 1
    """cores of a job"""
    gpus: CountOrZero = 0
    """GPUs of a job"""
    memory: Text | None = None
    """memory of a job, such as 4G"""
    notice: Positive = 90
    """seconds before the end of the time at which SLURM asks a run to save"""
    requeues: CountOrZero = 100
    """how often a job is requeued because its time is over"""
    workers: Positive | None = None
    """jobs in the queue at a time; as many as an array may have if None"""
    options: dict[str, str | int] = Field(default_factory=dict)
    """other options of sbatch"""

    def __post_init__(self) -> None:
        # SLURM sends the signal up to a minute earlier; the process must have started.
        if self.notice + 60 >= 60 * minutes(self.time):
            raise UserError(
                f"executor.notice={self.notice}: executor.time={self.time} must be more than a "
                "minute longer"
            )


class _Training:
    """A training in a job of submitit.

    Args:
        task: the training.
        threads: its threads.
        until_killed: seconds for which the job waits after the training was asked to save.
    """

    def __init__(self, task: Task, threads: int, until_killed: float):
        self._arguments = task, threads, until_killed
        self._process: subprocess.Popen | None = None

    def __call__(self) -> int:
        """Trains, and returns the exit status of the training."""
        task, threads, until_killed = self._arguments
        # SLURM sends SIGTERM before it preempts a job. submitit would ignore it.
        signal.signal(signal.SIGTERM, lambda *_: self._ask_to_save())
        self._process = task.start(threads)
        while (status := self._process.poll()) is None:
            time.sleep(0.2)
        if status in _SAVED:
            time.sleep(until_killed)  # SLURM requeues the job, or ends it
        return status

    def checkpoint(self) -> Any:
        """Waits until the training has saved; submitit calls it at SIGUSR2 and requeues the job."""
        self._ask_to_save()
        with suppress(ChildProcessError):
            # Not Popen.wait: this handler may interrupt Popen.poll, which holds a lock.
            os.waitid(os.P_PID, self._process.pid if self._process else 0, os.WEXITED | os.WNOWAIT)
        return import_module("submitit").helpers.DelayedSubmission(_Training(*self._arguments))

    def _ask_to_save(self) -> None:
        if self._process:
            # Never counts as a second signal, so that the training saves in any case.
            self._process.send_signal(signal.SIGUSR2)


class _Handle:
    """A submitted task."""

    def __init__(self, task: Task, job: Any):
        self.task, self.job = task, job
        self.seen, self.cancelled = time.monotonic(), False


class SubmititExecutor(Executor):
    """Runs each task as a job of an array, which SLURM requeues if it is preempted."""

    config_type = SubmititConfig

    def __init__(self, config: SubmititConfig):
        require("submitit", "submitit", "slurm")
        if config.cluster == "slurm" and shutil.which("sbatch") is None:
            raise UserError(
                "executor=submitit: there is no sbatch here; SLURM's login nodes have it"
            )
        # submitit starts Python with -m, which would import a random.py of the working directory.
        os.environ.setdefault("PYTHONSAFEPATH", "1")
        self.workers = min(config.workers or _MOST, _MOST)
        self._config = config
        self._queue: set[str] | None = None
        self._looked = -_LOOK

    def submit(self, tasks: Sequence[Task]) -> Sequence[_Handle]:
        folder = _without_patterns(tasks[0].log.parent / "submitit")
        wait = _UNTIL_KILLED if self._config.cluster == "slurm" else 0.0
        trainings = [_Training(task, self._config.cpus, wait) for task in tasks]
        try:
            executor = self._make(folder)
            # submitit prints sbatch's messages, too.
            with redirect_stderr(StringIO()), executor.batch():
                jobs = [executor.submit(training) for training in trainings]
        except (RuntimeError, OSError, ValueError, subprocess.CalledProcessError) as error:
            values = {key: getattr(self._config, key) for key in _FOR_SBATCH}
            given = "".join(f" executor.{key}={value}" for key, value in values.items() if value)
            lines = [line.removeprefix("sbatch: error: ") for line in str(error).splitlines()]
            raise UserError(f"executor=submitit{given}: {'; '.join(lines)[-300:]}") from None
        return [_Handle(task, job) for task, job in zip(tasks, jobs, strict=True)]

    def poll(self, handle: _Handle) -> int | None:
        job, now = handle.job, time.monotonic()
        if job.paths.result_pickle.exists():
            try:
                return job.result()
            except Exception as error:  # whatever the training's process has raised
                return _explain(handle, str(error))
        if self._is_known(job):
            handle.seen = now
            return None
        # Another machine may show the result a little later.
        if self._config.cluster == "slurm" and not handle.cancelled and now - handle.seen < _GRACE:
            return None
        return _explain(handle, job.stderr() or "")

    def cancel(self, handle: _Handle) -> None:
        handle.cancelled = True
        if self._config.cluster == "slurm":
            _slurm("scancel", handle.job.job_id)
        else:  # the number of the process that submitit has started
            with suppress(ProcessLookupError):
                os.kill(int(handle.job.job_id), signal.SIGTERM)

    def _make(self, folder: Path) -> Any:
        submitit = import_module("submitit")
        config, wall = self._config, minutes(self._config.time)
        if config.cluster == "local":
            local = submitit.LocalExecutor(folder, max_num_timeout=config.requeues)
            local.update_parameters(
                timeout_min=wall, gpus_per_node=config.gpus, signal_delay_s=config.notice
            )
            return local
        slurm = submitit.SlurmExecutor(folder, max_num_timeout=config.requeues)
        options = {
            "partition": config.partition,
            "account": config.account,
            "gpus_per_node": config.gpus or None,
            "mem": config.memory,
        }
        slurm.update_parameters(
            time=wall,
            cpus_per_task=config.cpus,
            job_name="emberlink",
            signal_delay_s=config.notice,
            array_parallelism=_MOST,
            additional_parameters={"requeue": True, **config.options},
            **{key: value for key, value in options.items() if value is not None},
        )
        return slurm

    def _is_known(self, job: Any) -> bool:
        """Returns whether a job is queued or running, as far as known."""
        if self._config.cluster == "local":
            return not job.done()
        if time.monotonic() - self._looked > _LOOK:
            self._looked = time.monotonic()
            listed = _slurm("squeue", "--me", "--noheader", "--array", "--format=%F_%K %A")
            self._queue = None if listed is None else {*listed.split()}
        return self._queue is None or job.job_id in self._queue


def _without_patterns(folder: Path) -> Path:
    """Returns the folder, or a link to it if submitit and SLURM would replace parts of its path."""
    folder.mkdir(exist_ok=True)
    if "%" not in str(folder):
        return folder
    name = hashlib.sha256(str(folder).encode()).hexdigest()[:16]
    link = Path.home() / ".cache" / "emberlink" / "submitit" / name
    link.parent.mkdir(parents=True, exist_ok=True)
    with suppress(FileExistsError):
        link.symlink_to(folder)
    return link


def _explain(handle: _Handle, said: str) -> int:
    """Appends what the job has said last to the log of its training, and returns `DIED`."""
    with handle.task.log.open("a") as log:
        log.write(f"{next(filter(str.strip, said.splitlines()[::-1]), 'the job has ended')}\n")
    return DIED


def _slurm(*command: str) -> str | None:
    """Returns the output of a command of SLURM; None if it fails, such as for a short time."""
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return None
