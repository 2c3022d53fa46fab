"""Runs trainings as SLURM jobs, through submitit."""

import shutil
import signal
import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass as plain_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, ConfigDict, Field
from pydantic.dataclasses import dataclass

from emberlink.envs.utils.atomic_io import inner_folder, write_bytes
from emberlink.envs.utils.errors import UserError
from emberlink.trainers.sweep.executors import _extras, _process
from emberlink.trainers.sweep.executors._times import minutes
from emberlink.trainers.sweep.executors.base import DIED, Executor, QueueFullError, Task

_STATUS, _STOP = ".status", ".stop"
"""suffixes of files beside a log: the exit status of the task; a request to save and end"""
_SAVED = (128 + signal.SIGTERM, 128 + signal.SIGUSR2, -signal.SIGTERM, -signal.SIGUSR2)
_GRACE = 120.0
"""seconds for which a job waits for its end after its runs were interrupted"""
_LOOK = 10.0
"""seconds between two looks at SLURM's queue"""


def _time(value: object) -> str:
    minutes(str(value))
    return str(value)


Positive = Annotated[int, Field(ge=1)]
CountOrZero = Annotated[int, Field(ge=0)]


@dataclass(frozen=True, kw_only=True, config=ConfigDict(extra="forbid", strict=True))
class SubmititConfig:
    """The settings of SLURM jobs."""

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
    options: dict[str, str | int] = Field(default_factory=dict)
    """other options of sbatch"""

    def __post_init__(self) -> None:
        if self.notice >= 60 * minutes(self.time):
            raise UserError(
                f"executor.notice={self.notice}: must be shorter than executor.time={self.time}"
            )


class _Batch:
    """Trains the runs of a job; submitit runs it.

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
            if not _file(task, _STATUS).exists():
                self._running[task.log] = _process.start(task, self._threads)
        try:
            self._follow()
        except utils.UncompletedJobError:  # submitit does not requeue the job again
            for log in self._running:
                _end(log, 128 + signal.SIGUSR2)
            raise

    def checkpoint(self) -> Any:
        """Waits until the trainings have saved; called by submitit at SIGUSR2."""
        self._ask_to_save()
        for process in self._running.values():
            process.wait()
        return _extras.load("submitit").helpers.DelayedSubmission(
            _Batch(self._tasks, self._threads)
        )

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
                stop = log.with_suffix(_STOP).exists()
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
                _end(log, status)


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
        self._queue: set[str] | None = None
        self._looked = 0.0

    def slots(self, tasks: int) -> int:
        if self._config.cluster == "slurm" and shutil.which("sbatch") is None:
            raise UserError(
                "executor=submitit: there is no sbatch here; SLURM's login nodes have it"
            )
        return self._config.workers or max(tasks, 1)

    def submit(self, task: Task) -> _Handle:
        handle = _Handle(task)
        self._waiting.append(handle)
        if len(self._waiting) == self._config.share:
            try:
                self._submit()
            except UserError:
                self._waiting.remove(handle)
                raise
        return handle

    def poll(self, handle: _Handle) -> int | None:
        if self._waiting:
            self._submit()
        try:
            return int(_file(handle.task, _STATUS).read_text())
        except (OSError, ValueError):
            pass
        now = time.monotonic()
        if handle.job is None or self._is_known(handle.job):
            handle.seen = now
            return None
        # Another machine may show the status a little later.
        return DIED if now - handle.seen > 3 * _LOOK or self._config.cluster == "local" else None

    def cancel(self, handle: _Handle) -> None:
        write_bytes(_file(handle.task, _STOP), b"")
        if handle.job is None:
            self._waiting = [other for other in self._waiting if other is not handle]
            _end(handle.task.log, 128 + signal.SIGTERM)
        elif self._config.cluster == "slurm":
            _slurm("scancel", "--state=PENDING", handle.job.job_id)

    def name_of(self, handle: _Handle) -> str:
        return f"{handle.job.job_id} {handle.task.log.absolute()}" if handle.job else ""

    def find(self, name: str) -> _Handle | None:
        number, _, log = name.partition(" ")
        task = Task((), Path(log))
        if self._config.cluster == "local" or _file(task, _STATUS).exists():
            return None
        job = _extras.load("submitit").SlurmJob(folder=task.log.parent / "submitit", job_id=number)
        return _Handle(task, job, time.monotonic()) if self._is_known(job) else None

    def _submit(self) -> None:
        """Submits one job for the waiting tasks.

        Raises:
            QueueFullError: SLURM does not accept the job.
        """
        tasks = [handle.task for handle in self._waiting]
        folder = inner_folder(tasks[0].output, "logs", "submitit")
        try:
            executor = self._make(folder)
            job = executor.submit(_Batch(tasks, max(self._config.cpus // self._config.share, 1)))
        except (RuntimeError, OSError, subprocess.CalledProcessError) as error:
            output = getattr(error, "stderr", None) or str(error)
            text = output.decode(errors="replace") if isinstance(output, bytes) else output
            raise QueueFullError(f"executor=submitit: {' '.join(text.split())[-300:]}") from None
        for handle in self._waiting:
            handle.job, handle.seen = job, time.monotonic()
        self._waiting = []

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
            listed = _slurm("squeue", "--me", "--noheader", "--format=%A")
            self._queue = None if listed is None else set(listed.split())
        return self._queue is None or job.job_id in self._queue


def _file(task: Task, suffix: str) -> Path:
    return task.log.with_suffix(suffix)


def _end(log: Path, status: int) -> None:
    write_bytes(log.with_suffix(_STATUS), str(status).encode())


def _slurm(*command: str) -> str | None:
    """Returns the output of a command of SLURM; None if it fails, such as for a short time."""
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return None
