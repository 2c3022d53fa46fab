"""Runs the jobs of a sweep on an executor."""

import signal
import time
from dataclasses import dataclass, field
from typing import Any

from emberlink.envs.utils.errors import UserError
from emberlink.trainers.sweep import question
from emberlink.trainers.sweep.executors import Executor, QueueFullError, Task
from emberlink.trainers.sweep.jobs import Job
from emberlink.trainers.sweep.leases import SWEEP, TRAINING, Heart, Lease, Leases
from emberlink.trainers.sweep.manifest import Manifest
from emberlink.trainers.sweep.plan import plan
from emberlink.trainers.sweep.progress import SweepProgress
from emberlink.trainers.sweep.run_index import RunIndex
from emberlink.trainers.sweep.slots import Slots
from emberlink.trainers.sweep.worker import HELD
from emberlink.trainers.terminal.signals import Interruption

_NOTICES = (signal.SIGHUP, signal.SIGTERM, signal.SIGUSR1, signal.SIGUSR2)
_SAVED = {128 + number for number in _NOTICES}
"""exit statuses of trainings that saved after a signal from their machine"""


@dataclass
class _Running:
    """A submitted job.

    Attributes:
        handle: the executor's handle.
        leases: leases of the job's runs, until the training has them.
        newest: name of the newest checkpoint at the start.
        begun: whether the training has begun.
        task: the executor's name of the task; empty until it is known.
    """

    handle: Any
    leases: list[Lease] = field(default_factory=list)
    newest: str = ""
    begun: bool = False
    task: str = ""


class Scheduler:
    """Submits jobs when slots are free, follows them, and stops or leaves them if interrupted.

    If another process holds the lease of a run, its job waits until it is free or finished.

    Args:
        jobs: all jobs of the sweep, from `plan`.
        index: run folders in the output folder.
        executor: runs the jobs.
        progress: shows the progress.
        manifest: gets the states of the runs.
    """

    def __init__(
        self,
        jobs: list[Job],
        index: RunIndex,
        executor: Executor,
        progress: SweepProgress,
        manifest: Manifest,
    ):
        self.jobs = jobs
        self.left = 0
        """number of trainings that still run after `work`"""
        self._index, self._executor, self._progress = index, executor, progress
        self._manifest, self._leases, self._heart = manifest, Leases(index.output), Heart()
        self._waiting = [job for job in jobs if not job.finished]
        self._slots = Slots(executor.slots(len(self._waiting)))
        self._accepted = False
        self._running: dict[Job, _Running] = {}
        self._blocked: set[Job] = set()
        self._planned_with = index.size
        self._stopping = self._interrupted = False

    def work(self) -> int:
        """Runs all jobs and returns the exit status of the sweep.

        Returns:
            0; 1 if a job failed; 128 and the number of the signal that interrupted the sweep.
        """
        interruption = Interruption(self._interrupt)
        self._manifest.load(self.jobs)
        self._heart.start()
        try:
            with interruption, self._progress:
                self._find_left()
                while self._running or (self._waiting and not self._stopping):
                    self._submit()
                    time.sleep(self._executor.interval)
                    if self._interrupted:
                        self._answer(interruption)
                    self._look()
        finally:
            self._stop()  # after a second signal, the trainings end at once
            self._wait()
            self._heart.close()
        if interruption.received:
            return interruption.status
        return int(any(job.failed for job in self.jobs))

    def _wait(self) -> None:
        """Waits for running jobs and releases their leases."""
        for job, running in self._running.items():
            while self._executor.poll(running.handle) is None:
                time.sleep(self._executor.interval / 10)
            self._heart.release(running.leases, "stopped")
            self._manifest.set(job, "finished" if job.finished else "stopped")

    def _find_left(self) -> None:
        """Follows trainings that an earlier sweep has left running or queued."""
        for job in list(self._waiting):
            name = self._manifest.task(job)
            held = [self._holder(run) for run in job.names]
            handle = self._executor.find(name) if name and SWEEP not in held else None
            if handle is not None:
                self._waiting.remove(job)
                job.log = self._index.output / next(iter(self._manifest.of(job))).log
                self._running[job] = _Running(handle, newest=job.newest_state)

    def _holder(self, run: str) -> str:
        """Returns the role of the process that holds a run, or an empty text."""
        record = self._leases.newest(run)
        return record.role if record and self._leases.is_held(run, record) else ""

    def _submit(self) -> None:
        """Submits jobs that no other process holds until all slots are taken."""
        while not self._stopping and self._slots.has_room(len(self._running)):
            taken = self._claim_next()
            if taken is None:
                return
            job, leases = taken
            if job.finished:
                self._heart.release(leases, "finished")
                self._manifest.set(job, "finished")
                self._progress.end(job, "finished by another sweep")
            else:
                self._start(job, leases)

    def _claim_next(self) -> tuple[Job, list[Lease]] | None:
        """Takes the leases of the first waiting job that is free; returns None if none is."""
        for job in self._waiting:
            leases = self._leases.take_all(job.names, SWEEP)
            if leases is None:
                if job not in self._blocked:
                    self._progress.wait(job)
                self._blocked.add(job)
                continue
            # Another sweep may have trained some of the runs since the last update.
            self._index.update()
            if self._index.size != self._planned_with:
                self._heart.release(leases, "planned again")
                self._plan_again()
                return self._claim_next()
            self._waiting.remove(job)
            return job, leases
        return None

    def _plan_again(self) -> None:
        """Adapts the waiting jobs to the runs of other sweeps."""
        self._planned_with = self._index.size
        others = [job for job in self.jobs if job not in self._waiting]
        self._waiting = plan(self._waiting, self._index.runs)
        self.jobs = [*others, *self._waiting]

    def _start(self, job: Job, leases: list[Lease]) -> None:
        """Submits a job.

        Raises:
            UserError: a file cannot be written, or the first of all jobs cannot be submitted.
        """
        self._heart.add(leases)
        try:
            handle = self._executor.submit(self._task(job, leases))
        except (OSError, UserError) as error:
            job.drop_log()
            self._heart.release(leases, "not started")
            if isinstance(error, OSError):
                where = error.filename or job.output
                raise UserError(f"{where}: {error.strerror or error}") from None
            if not (isinstance(error, QueueFullError) and (self._accepted or self._running)):
                raise
            self._waiting.insert(0, job)
            if self._slots.refused(len(self._running), str(error)):
                self._progress.say(job, f"waits, {error}")
            return
        self._accepted = True
        task = self._executor.name_of(handle)
        self._running[job] = _Running(handle, leases, job.newest_state, task=task)
        self._manifest.set(
            job,
            "queued",
            executor=self._manifest.executor,
            task=task,
            log=str(job.log.relative_to(job.output)),
            restarts=job.restarts,
            note="",
        )

    def _task(self, job: Job, leases: list[Lease]) -> Task:
        """Returns the task of a job, whose run folders are created first if it is new."""
        if not job.found:
            created = job.create_folders()
            self._index.update()
            # Folders of other sweeps may have been found, too: the next job is planned again.
            self._planned_with += created
            job.find_runs(self._index.runs)
        job.open_log()
        tokens = {lease.run: lease.record.token for lease in leases}
        output, restarts = job.output.absolute(), self._executor.restarts
        return Task(job.arguments, job.log.absolute(), tokens, output, restarts)

    def _look(self) -> None:
        """Updates the progress of running jobs and handles those that have ended."""
        for job, running in list(self._running.items()):
            if not running.begun and TRAINING in map(self._holder, job.names):
                running.begun = True
                self._manifest.set(job, "running")
                self._progress.begin(job)
            task = running.task or self._executor.name_of(running.handle)
            if task != running.task:  # known when the job of several tasks is submitted
                running.task = task
                self._manifest.set(job, "running" if running.begun else "queued", task=task)
            self._progress.follow(job)
            status = self._executor.poll(running.handle)
            if status is not None:
                del self._running[job]
                self._heart.release(running.leases, f"exit status {status}")
                self._end(job, status, running)

    def _end(self, job: Job, status: int, running: _Running) -> None:
        self._index.update()
        job.find_runs(self._index.runs)
        if job.finished:
            self._manifest.set(job, "finished")
            self._progress.end(job, "finished")
        elif self._stopping:
            self._manifest.set(job, "stopped")
            self._progress.end(job, "stopped", again=True)
        elif status == HELD:
            self._again(job, "waits, another sweep is training it")
        elif self._may_restart(job, status, running):
            what = "ended without saving" if status < 0 else "was interrupted and has saved"
            self._again(job, f"{what}, is started again")
        else:
            after = f" after {job.restarts} restarts" if job.restarts else ""
            job.failed = f"exit status {status}{after}: {job.last_line()} (log: {job.log})"
            self._manifest.set(job, "failed", note=job.failed, restarts=job.restarts)
            self._progress.end(job, job.failed)

    def _again(self, job: Job, why: str) -> None:
        """Puts a job back into the queue."""
        self._blocked.add(job)
        self._waiting.append(job)
        self._manifest.set(job, "queued", restarts=job.restarts)
        self._progress.end(job, why, again=True)

    def _may_restart(self, job: Job, status: int, running: _Running) -> bool:
        """Returns whether a job that has ended may be started again, and counts the restart.

        Trainings that were interrupted and have saved some progress are not counted.
        """
        if status in _SAVED and job.newest_state > running.newest:
            return True
        for lease in running.leases[:1]:  # the cluster may have started it again, too
            self._leases.newest(lease.run)
            job.restarts += max(self._leases.deaths(lease.run, lease.record.token) - 1, 0)
        if (status >= 0 and status not in _SAVED) or job.restarts >= self._executor.restarts:
            return False
        job.restarts += 1
        return True

    def _interrupt(self) -> None:
        self._interrupted = True

    def _answer(self, interruption: Interruption) -> None:
        """Stops or leaves the running jobs, as the user chooses after Ctrl-C."""
        self._interrupted = False
        answer = question.STOP
        if interruption.received == signal.SIGINT and self._running and not self._stopping:
            answer = question.ask(self._progress, len(self._running), self._executor.may_leave)
        if answer == question.STOP:
            self._stop()
        elif answer == question.CONTINUE:
            interruption.received = None
        else:
            self._stopping = True
            self.left = len(self._running)
            for running in self._running.values():
                self._executor.leave(running.handle)
                self._heart.release(running.leases, "left running")
            self._running.clear()

    def _stop(self) -> None:
        self._stopping = True
        for running in self._running.values():
            self._executor.cancel(running.handle)
