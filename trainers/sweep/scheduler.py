"""Runs the jobs of a sweep on an executor."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from emberlink.envs.utils.atomic_io import inner_folder
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.publish import free_name
from emberlink.trainers.sweep.claims import Claim, claim
from emberlink.trainers.sweep.executors import Executor, Task
from emberlink.trainers.sweep.jobs import Job
from emberlink.trainers.sweep.plan import plan
from emberlink.trainers.sweep.progress import SweepProgress
from emberlink.trainers.sweep.run_index import RunIndex
from emberlink.trainers.terminal.signals import Interruption

_INTERVAL = 0.5
"""seconds between polls of processes and run folders"""


@dataclass
class _Running:
    """A submitted job.

    Attributes:
        handle: the executor's handle.
        claim: locks of the job's runs.
    """

    handle: Any
    claim: Claim


class Scheduler:
    """Submits jobs when slots are free, shows their progress, and cancels them if interrupted.

    If another sweep has locked the runs of a job, the job waits until they are free or finished.

    Args:
        jobs: all jobs of the sweep, from `plan`.
        index: run folders in the output folder.
        executor: runs the jobs.
        progress: shows the progress.
    """

    def __init__(
        self, jobs: list[Job], index: RunIndex, executor: Executor, progress: SweepProgress
    ):
        self.jobs = jobs
        self._index, self._executor, self._progress = index, executor, progress
        self._waiting = [job for job in jobs if not job.finished]
        self._slots = executor.slots(len(self._waiting))
        self._running: dict[Job, _Running] = {}
        self._blocked: set[Job] = set()
        self._planned_with = index.size
        self._stopping = False

    def work(self) -> int:
        """Runs all jobs and returns the exit status of the sweep.

        Returns:
            0; 1 if a job failed; 130 or 143 after a signal.
        """
        interruption = Interruption(self._stop)
        try:
            with interruption, self._progress:
                while self._running or (self._waiting and not self._stopping):
                    self._submit()
                    time.sleep(_INTERVAL)
                    self._look()
        finally:
            self._stop()  # after a second signal, the trainings end at once
            self._wait()
        if interruption.received:
            return interruption.status
        return int(any(job.failed for job in self.jobs))

    def _wait(self) -> None:
        """Waits for running jobs and releases their locks."""
        for running in self._running.values():
            while self._executor.poll(running.handle) is None:
                time.sleep(_INTERVAL / 10)
            running.claim.release()

    def _submit(self) -> None:
        """Submits jobs that no other sweep has locked until all slots are taken."""
        while not self._stopping and len(self._running) < self._slots:
            taken = self._claim_next()
            if taken is None:
                return
            job, locks = taken
            if job.finished:
                locks.release()
                self._progress.end(job, "finished by another sweep")
            else:
                self._start(job, locks)

    def _claim_next(self) -> tuple[Job, Claim] | None:
        """Locks and returns the first waiting job that is not locked; None if there is none."""
        for job in self._waiting:
            locks = claim(job.output, job.identities)
            if locks is None:
                if job not in self._blocked:
                    self._progress.wait(job)
                self._blocked.add(job)
                continue
            # Another sweep may have trained some of the runs since the last update.
            self._index.update()
            if self._index.size != self._planned_with:
                locks.release()
                self._plan_again()
                return self._claim_next()
            self._waiting.remove(job)
            return job, locks
        return None

    def _plan_again(self) -> None:
        """Adapts the waiting jobs to the runs of other sweeps."""
        self._planned_with = self._index.size
        others = [job for job in self.jobs if job not in self._waiting]
        self._waiting = plan(self._waiting, self._index.runs)
        self.jobs = [*others, *self._waiting]

    def _start(self, job: Job, locks: Claim) -> None:
        seeds = "-".join(str(config.seed) for config in job.configs)
        first = job.configs[0]
        stem = f"{first.setup}_{first.world}_{job.method}_s{seeds}"
        try:
            logs = inner_folder(job.output, "logs")
            job.log = Path(f"{free_name(logs, stem, ['.txt'])}.txt")
            handle = self._executor.submit(Task(job.arguments, job.log, locks.handles))
        except OSError as error:
            locks.release()
            raise UserError(f"{error.filename or job.output}: {error.strerror or error}") from None
        self._running[job] = _Running(handle, locks)
        self._progress.begin(job)

    def _look(self) -> None:
        """Updates the progress of running jobs and handles those that have ended."""
        if any(len(job.found) < len(job.configs) for job in self._running):
            self._index.update()
        for job, running in list(self._running.items()):
            job.find_runs(self._index.runs)
            self._progress.follow(job)
            status = self._executor.poll(running.handle)
            if status is not None:
                del self._running[job]
                running.claim.release()
                self._end(job, status)

    def _end(self, job: Job, status: int) -> None:
        self._index.update()
        job.find_runs(self._index.runs)
        finished = job.finished
        if not finished and not self._stopping:
            job.failed = f"exit status {status}: {_last_line(job.log)} (log: {job.log})"
        self._progress.end(job, job.failed or ("finished" if finished else "stopped"))

    def _stop(self) -> None:
        self._stopping = True
        for running in self._running.values():
            self._executor.cancel(running.handle)


def _last_line(log: Path) -> str:
    if not log.is_file():  # an executor may fail before its task writes
        return "there is no log"
    lines = [line.strip() for line in log.read_text(errors="replace").splitlines()]
    return next((line for line in reversed(lines) if line), "the log is empty")
