"""Runs trainings as SLURM jobs, through submitit."""

import shutil
import signal
import subprocess
import time
import warnings
from contextlib import redirect_stderr, suppress
from dataclasses import dataclass as plain_dataclass
from io import StringIO
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, PlainValidator
from pydantic.dataclasses import dataclass

from emberlink.envs.utils.atomic_io import inner_folder, write_bytes
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import STRICT, CountOrZero
from emberlink.trainers.sweep.executors import _extras
from emberlink.trainers.sweep.executors._slurm_job import Batch, end, file_of
from emberlink.trainers.sweep.executors._times import minutes
from emberlink.trainers.sweep.executors.base import (
    DIED,
    STATUS,
    STOP,
    Executor,
    Positive,
    QueueFullError,
    Task,
)

_LOOK = 10.0
"""seconds between two looks at SLURM's queue"""
_RETRY = 60.0
"""seconds after which a job that SLURM did not accept is submitted again"""
_FOR_SBATCH = ("partition", "account", "time", "cpus", "gpus", "memory", "options")
"""settings that become options of sbatch"""
_USUAL = ("None", "Priority", "Resources", "BeginTime", "Cleaning", "Prolog")
"""reasons for which every job may wait in SLURM's queue"""


def _time(value: object) -> str:
    minutes(str(value))
    return str(value)


def _option(value: object) -> str | int:
    if isinstance(value, bool) or not isinstance(value, str | int):
        raise UserError("expected text or a whole number")
    return value


@dataclass(frozen=True, kw_only=True, config=STRICT)
class SubmititConfig:
    """Stores the settings of SLURM jobs."""

    cluster: Literal["slurm", "local"] = "slurm"
    """slurm, or submitit's local processes for tests"""
    partition: str | None = None
    """partition; SLURM's default if None"""
    account: str | None = None
    """account; SLURM's default if None"""
    time: Annotated[str, BeforeValidator(_time)] = "60"
    """time of a job: minutes, or as in sbatch"""
    cpus: Positive = 1
    """cores of a job"""
    gpus: CountOrZero = 0
    """GPUs of a job"""
    memory: str | None = None
    """memory of a job, such as 4G"""
    share: Positive = 1
    """runs of a job, which share its cores and GPUs"""
    seeds: Positive = 1
    """seeds of a method that are trained in one process"""
    notice: Positive = 90
    """seconds before the end of the time at which SLURM asks a run to save"""
    requeues: CountOrZero = 100
    """how often a job is requeued because its time is over"""
    restarts: CountOrZero = 3
    """how often a run is started again after its job ended without saving"""
    workers: Positive | None = None
    """runs at a time; all if None"""
    options: dict[str, Annotated[str | int, PlainValidator(_option)]] = Field(default_factory=dict)
    """other options of sbatch"""

    def __post_init__(self) -> None:
        # SLURM sends the signal up to a minute earlier; the process must have started.
        if self.notice + 60 >= 60 * minutes(self.time):
            raise UserError(
                f"executor.notice={self.notice}: executor.time={self.time} must be more than a "
                "minute longer"
            )


@plain_dataclass(eq=False)
class _Handle:
    """A submitted task; `job` is None until its job is submitted."""

    task: Task
    job: Any = None
    seen: float = 0.0


class SubmititExecutor(Executor):
    """Runs each task, or several together, as a SLURM job, which is requeued if preempted."""

    config_type = SubmititConfig
    interval = 2.0

    def __init__(self, config: SubmititConfig):
        _extras.require("submitit", "submitit", "slurm")
        self._config = config
        self.seeds, self.restarts = config.seeds, config.restarts
        self._waiting: list[_Handle] = []
        self._accepted, self._refused = False, -_RETRY
        self._queue: dict[str, str] | None = None
        self._looked = -_LOOK
        self._said: set[str] = set()

    def slots(self, tasks: int) -> int:
        if self._config.cluster == "slurm" and shutil.which("sbatch") is None:
            raise UserError(
                "executor=submitit: there is no sbatch here; SLURM's login nodes have it"
            )
        return self._config.workers or max(tasks, 1)

    def submit(self, task: Task) -> _Handle:
        handle = _Handle(task)
        self._waiting.append(handle)
        if len(self._waiting) >= self._config.share:
            try:
                self._submit()
            except UserError:
                self._waiting.remove(handle)
                raise
        return handle

    def poll(self, handle: _Handle) -> int | None:
        self._submit_rest()
        try:
            return int(file_of(handle.task, STATUS).read_text())
        except (OSError, ValueError):
            pass
        now = time.monotonic()
        if handle.job is None or self._is_known(handle.job):
            handle.seen = now
            return None
        # Another machine may show the status a little later.
        if now - handle.seen <= 3 * _LOOK and self._config.cluster == "slurm":
            return None
        _explain(handle)
        return DIED

    def cancel(self, handle: _Handle) -> None:
        write_bytes(file_of(handle.task, STOP), b"")
        if handle.job is None:
            self._waiting = [other for other in self._waiting if other is not handle]
            end(handle.task.log, 128 + signal.SIGTERM)
        elif self._config.cluster == "slurm":
            _slurm("scancel", "--state=PENDING", handle.job.job_id)

    def name_of(self, handle: _Handle) -> str:
        return f"{handle.job.job_id} {handle.task.log.absolute()}" if handle.job else ""

    def find(self, name: str) -> _Handle | None:
        number, _, log = name.partition(" ")
        task = Task((), Path(log))
        # The folder of an output that was moved is missing; a job of this number is another one.
        gone = not task.log.parent.is_dir() or file_of(task, STATUS).exists()
        if gone or self._config.cluster == "local":
            return None
        job = _extras.load("submitit").SlurmJob(folder=task.log.parent / "submitit", job_id=number)
        return _Handle(task, job, time.monotonic()) if self._is_known(job) else None

    def _submit_rest(self) -> None:
        """Submits the tasks that wait although no others have followed."""
        if not self._waiting or time.monotonic() - self._refused < _RETRY:
            return
        with suppress(QueueFullError):
            self._submit()

    def _submit(self) -> None:
        """Submits one job for the waiting tasks.

        Raises:
            QueueFullError: SLURM does not accept the job now.
            UserError: SLURM has never accepted a job.
        """
        tasks = [handle.task for handle in self._waiting]
        folder = inner_folder(tasks[0].output, "logs", "submitit")
        threads = max(self._config.cpus // self._config.share, 1)
        try:
            # submitit prints sbatch's messages, too.
            with redirect_stderr(StringIO()):
                job = self._make(folder).submit(Batch(tasks, threads))
        except (RuntimeError, OSError, ValueError, subprocess.CalledProcessError) as error:
            self._refused = time.monotonic()
            wrong = QueueFullError if self._accepted else UserError
            raise wrong(f"executor=submitit{self._given()}: {_reason(error)}") from None
        self._accepted = True
        for handle in self._waiting:
            handle.job, handle.seen = job, time.monotonic()
        self._waiting = []

    def _given(self) -> str:
        """Returns the settings that sbatch gets, for messages."""
        values = {key: getattr(self._config, key) for key in _FOR_SBATCH}
        return "".join(f" executor.{key}={value}" for key, value in values.items() if value)

    def _make(self, folder: Path) -> Any:
        submitit = _extras.load("submitit")
        config, wall = self._config, minutes(self._config.time)
        # %j is replaced by the number of the job.
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
            listed = _slurm("squeue", "--me", "--noheader", "--format=%A %r")
            self._queue = (
                None
                if listed is None
                else dict(line.split(maxsplit=1) for line in listed.splitlines())
            )
        if self._queue is None:
            return True
        self._warn(self._queue.get(job.job_id, "None"))
        return job.job_id in self._queue

    def _warn(self, reason: str) -> None:
        """Warns once of each unusual reason for which jobs wait, such as too long a time."""
        if reason not in (*_USUAL, *self._said):
            self._said.add(reason)
            message = f"jobs wait in SLURM's queue: {reason} (executor=submitit{self._given()})"
            warnings.warn(message, stacklevel=2)


def _reason(error: Exception) -> str:
    """Returns the message of sbatch in one line."""
    lines = [line.strip().removeprefix("sbatch: error: ") for line in str(error).splitlines()]
    return "; ".join(filter(None, lines))[-300:]


def _explain(handle: _Handle) -> None:
    """Writes the last line of a job's own log to the log of a training that has not begun."""
    if not _written(handle.task.log) and handle.job.paths.stderr.is_file():
        said = handle.job.paths.stderr.read_text(errors="replace").split("\n")
        line = next((line.strip() for line in reversed(said) if line.strip()), "no message")
        text = f"the training has not begun: {line} ({handle.job.paths.stderr})\n"
        write_bytes(handle.task.log, text.encode())


def _written(log: Path) -> bool:
    """Returns whether a log holds text."""
    return log.is_file() and log.stat().st_size > 0


def _slurm(*command: str) -> str | None:
    """Returns the output of a command of SLURM; None if it fails, such as for a short time."""
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return None
