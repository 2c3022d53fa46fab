"""Runs experiment trackers in a thread, so that they cannot delay or end a training."""

import queue
import threading
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.tracking import loggers
from emberlink.trainers.tracking.loggers import Tracker

_Job = Callable[[int, Tracker], None]
"""called with the index of a run and its tracker"""


class Trackers:
    """Passes the metrics of several runs to their trackers.

    All trackers run in one thread, since they may block on a network or a process. If one fails,
    there is a warning, and all trackers are stopped. metrics.jsonl does not depend on trackers.

    Args:
        configs: configurations of the runs, with the same `logger`.
        runs: the run folders.
        episode: number of episodes logged before, for a resumed run.
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
        """whether a tracker has failed"""
        if self._name in loggers.TRACKERS:
            self._thread = threading.Thread(target=self._work, daemon=True)
            self._thread.start()

    def log(self, lines: Sequence[Mapping[str, float]], episode: int) -> None:
        """Logs an episode's line of metrics.jsonl for each run."""
        copies = [dict(line) for line in lines]
        self._put(lambda place, tracker: tracker.log(copies[place], episode))

    def log_evaluation(
        self, numbers: Sequence[Mapping[str, float]], figures: Sequence[Sequence[Path]]
    ) -> None:
        """Logs the final evaluation of each run: means by name, and PNG files."""
        self._put(lambda place, tracker: tracker.log_evaluation(numbers[place], figures[place]))

    def close(self) -> None:
        """Closes the trackers; waits at most `PATIENCE` seconds."""
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
        except BaseException as error:  # an error of a tracker must not end the training
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
            "the training continues, metrics.jsonl is complete",
            stacklevel=4,
        )
