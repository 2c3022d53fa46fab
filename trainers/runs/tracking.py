"""Runs trackers in a thread of their own, so that none can hold up or end a training."""

import queue
import threading
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.runs import loggers
from emberlink.trainers.runs.loggers import Tracker
from emberlink.trainers.runs.run_folder import RunFolder

_Job = Callable[[int, Tracker], None]
"""called with the number of a run and its tracker"""


class Trackers:
    """Hands the numbers of several runs to their trackers.

    A tracker may wait for a network, or for a process that is gone, so all of them work in a
    thread. If one fails, one warning says so and no tracker is told anything more; metrics.jsonl
    holds everything in any case.

    Args:
        configs: of the runs; all name the same tracker.
        runs: where each one's tracker writes.
        episode: number of episodes that were logged before, for a resumed run.
    """

    def __init__(
        self, configs: Sequence[RunConfig], runs: Sequence[RunFolder], *, episode: int = 0
    ):
        self._name, self._episode = configs[0].logger, episode
        self._pairs = list(zip(configs, runs, strict=True))
        self._jobs: queue.SimpleQueue[_Job | None] = queue.SimpleQueue()
        self._failure: str | None = None
        self._thread: threading.Thread | None = None
        self.given_up = False
        """whether a tracker has failed, and a warning has said so"""
        if self._name in loggers.TRACKERS:
            self._thread = threading.Thread(target=self._work, daemon=True)
            self._thread.start()

    def log(self, lines: Sequence[Mapping[str, float]], episode: int) -> None:
        """Logs an episode's line of metrics.jsonl of every run."""
        copies = [dict(line) for line in lines]
        self._put(lambda place, tracker: tracker.log(copies[place], episode))

    def log_evaluation(
        self, numbers: Sequence[Mapping[str, float]], figures: Sequence[Sequence[Path]]
    ) -> None:
        """Logs the final evaluation of every run: means by name, and PNG files."""
        self._put(lambda place, tracker: tracker.log_evaluation(numbers[place], figures[place]))

    def close(self) -> None:
        """Writes what is left, if that takes no longer than `PATIENCE` seconds."""
        if self._thread is None:
            return
        self._jobs.put(None)
        self._thread.join(loggers.PATIENCE)
        if self._thread.is_alive() and self._failure is None:
            self._failure = f"no answer within {loggers.PATIENCE:g} s"
        if self._failure is not None:
            self._give_up(self._failure)
        self._thread = None

    def _put(self, job: _Job) -> None:
        if self._thread is None:
            return
        self._jobs.put(job)
        if self._failure is not None:
            self._give_up(self._failure)

    def _work(self) -> None:
        trackers: list[Tracker] = []
        try:
            for config, run in self._pairs:
                trackers.append(loggers.TRACKERS[self._name](config, run, self._episode))
            while (job := self._jobs.get()) is not None:
                for place, tracker in enumerate(trackers):
                    job(place, tracker)
            while trackers:
                trackers.pop().finish()
        except BaseException as error:  # no error of a tracker is one of the training
            self._failure = " ".join(f"{type(error).__name__}: {error}".split())
            for tracker in trackers:
                with suppress(BaseException):
                    tracker.finish()

    def _give_up(self, reason: str) -> None:
        self._thread, self.given_up = None, True
        if self._name == "wandb":
            loggers.release_wandb()
        shown = reason if len(reason) <= 200 else reason[:200] + " ..."
        warnings.warn(
            f"logger={self._name} has stopped ({shown}); "
            "the training goes on, metrics.jsonl holds everything",
            stacklevel=4,
        )
