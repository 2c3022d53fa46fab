"""Trackers beside metrics.jsonl: wandb, tensorboard, csv, or none.

A tracker is a guest: whatever becomes of it, the training goes on and metrics.jsonl is whole.
"""

import os
import queue
import re
import sys
import threading
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

from torchrl.record.loggers import CSVLogger, Logger, TensorboardLogger, WandbLogger

from emberlink.envs.utils.atomic_io import inner_folder, remove_files, remove_links
from emberlink.trainers.config.compose import to_values
from emberlink.trainers.config.schema import RunConfig

from .run_folder import RunFolder

PATIENCE = 60.0
"""seconds that the end of a training waits for its tracker"""
_CONNECTING = 20.0
"""seconds that wandb may take to reach its server, where WANDB_MODE=online"""
_MEASURE = re.compile(r"\w[\w.+-]*(/\w[\w.+-]*)?")
"""names of measures, "coverage" or "fire/coverage"; each is also the path of a .csv file"""


def _wandb(config: RunConfig, run: RunFolder, episode: int) -> Logger:
    """Groups by setup and fire, tags by method and seed; offline unless WANDB_MODE says else.

    A resumed run keeps its name there: the last part of the folder that wandb made for it.
    """
    folder = inner_folder(run.path, "wandb")
    remove_links(folder)  # wandb makes its own anew
    before = sorted(folder.glob("*run-*-*"))
    import wandb

    offline = os.environ.get("WANDB_MODE", "offline") in ("", "offline", "dryrun")
    logger = WandbLogger(
        exp_name=run.path.name,
        project=os.environ.get("WANDB_PROJECT", "emberlink"),
        id=before[-1].name.rpartition("-")[2] if before else None,
        save_dir=str(run.path),
        offline=offline,
        log_env_packages=False,  # it would stand in the configuration as "env"
        settings=wandb.Settings(
            silent=offline,
            console="off",
            init_timeout=_CONNECTING,
            finish_timeout=PATIENCE / 2,
        ),
        reinit="create_new",  # seeds that train side by side are runs of their own
        group=f"{config.setup}-{config.fire.name}",
        tags=[config.method, f"seed-{config.seed}"],
    )
    logger.log_hparams(to_values(config))
    return logger


def _tensorboard(config: RunConfig, run: RunFolder, episode: int) -> Logger:
    folder = inner_folder(run.path, "tensorboard")
    remove_links(folder)
    before = any(folder.glob("events*"))
    logger = TensorboardLogger(exp_name="tensorboard", log_dir=str(run.path))
    if episode or before:
        _purge(logger, episode + 1)
    return logger


def _purge(logger: Logger, step: int) -> None:
    """Tells TensorBoard to forget what an earlier process logged from a step on."""
    from tensorboard.compat.proto import event_pb2

    made: Any = event_pb2  # its classes are made when it is imported
    start = made.Event(session_log=made.SessionLog(status=made.SessionLog.START))
    logger.experiment.file_writer.add_event(start, step)


def _csv(config: RunConfig, run: RunFolder, episode: int) -> Logger:
    """Written anew from metrics.jsonl for a resumed run: what was cut or lost there is here too."""
    for part in ("scalars", "videos", "texts"):
        remove_files(inner_folder(run.path, "csv", part), ".csv")
    logger = CSVLogger(exp_name="csv", log_dir=str(run.path))
    for line in run.lines()[:episode]:
        _log(logger, line, line["episode"])
    return logger


ENDING = "emberlink-ends-wandb"
"""the name of a thread that may go on after a tracker was given up"""

_Maker = Callable[[RunConfig, RunFolder, int], Logger]
"""of a run's tracker, which is to know what came up to an episode and nothing later"""
_TRACKERS: dict[str, _Maker] = {
    "wandb": _wandb,
    "tensorboard": _tensorboard,
    "csv": _csv,
}


class Trackers:
    """Hands each episode's numbers to the tracker that the configuration names, for every run.

    It works in a thread of its own, for a tracker may wait for a network or for a process that is
    gone. Where it fails, one warning says so and it is told nothing more.

    Args:
        configs: of the runs; all name the same tracker.
        runs: where each one's tracker writes.
        episode: the last one that a resumed run has behind it.
    """

    def __init__(
        self, configs: Sequence[RunConfig], runs: Sequence[RunFolder], *, episode: int = 0
    ):
        self._name, self._episode = configs[0].logger, episode
        self._pairs = list(zip(configs, runs, strict=True))
        self._lines: queue.SimpleQueue[tuple[Sequence[Mapping[str, Any]], int] | None]
        self._lines = queue.SimpleQueue()
        self._failure: str | None = None
        self._thread: threading.Thread | None = None
        self.given_up = False
        """whether it has failed, and a warning has said so"""
        if make := _TRACKERS.get(self._name):
            self._thread = threading.Thread(target=self._work, args=(make,), daemon=True)
            self._thread.start()

    def log(self, lines: Sequence[Mapping[str, Any]], step: int) -> None:
        """One episode's line of metrics.jsonl of every run; numbers only."""
        if self._thread is None:
            return
        self._lines.put(([dict(line) for line in lines], step))
        if self._failure is not None:
            self._give_up(self._failure)

    def close(self) -> None:
        """Writes what is left, if `PATIENCE` lasts; the trackers are not used afterwards."""
        if self._thread is None:
            return
        self._lines.put(None)
        self._thread.join(PATIENCE)
        if self._thread.is_alive() and self._failure is None:
            self._failure = f"no answer within {PATIENCE:g} s"
        if self._failure is not None:
            self._give_up(self._failure)
        self._thread = None

    def _work(self, make: _Maker) -> None:
        loggers: list[Logger] = []
        try:
            for config, run in self._pairs:
                loggers.append(make(config, run, self._episode))
            while (episode := self._lines.get()) is not None:
                lines, step = episode
                for logger, line in zip(loggers, lines, strict=True):
                    _log(logger, line, step)
            while loggers:
                _finish(loggers.pop())
        except BaseException as error:  # none of a tracker's errors is the training's
            self._failure = " ".join(f"{type(error).__name__}: {error}".split())
            for logger in loggers:
                with suppress(BaseException):
                    _finish(logger)

    def _give_up(self, reason: str) -> None:
        self._thread, self.given_up = None, True
        if self._name == "wandb":
            _release_wandb()
        shown = reason if len(reason) <= 200 else reason[:200] + " ..."
        warnings.warn(
            f"logger={self._name} has stopped ({shown}); "
            "the training goes on, metrics.jsonl holds everything",
            stacklevel=3,
        )


def _log(logger: Logger, line: Mapping[str, Any], step: int) -> None:
    if isinstance(logger, WandbLogger):
        # All in one row of the history, whose step is the episode.
        logger.log_metrics(dict(line), step=step, override_global_step=True)
        return
    for name, value in line.items():
        if isinstance(logger, CSVLogger) and not _MEASURE.fullmatch(name):
            raise ValueError(f"{name!r} is no name of a measure")  # it would be a file's
        logger.log_scalar(name, float(value), step=step)


def _finish(logger: Logger) -> None:
    if isinstance(logger, WandbLogger):
        logger.experiment.finish()
    elif isinstance(logger, TensorboardLogger):
        logger.experiment.close()


def _release_wandb() -> None:
    """Takes back what wandb would do when the program ends: wait for a process that is gone."""

    def teardown() -> None:
        with suppress(BaseException):
            sys.modules["wandb"].teardown()

    ending = threading.Thread(target=teardown, name=ENDING, daemon=True)
    ending.start()
    ending.join(2.0)
    # By which a later run of this process would look for the one that is gone.
    os.environ.pop("WANDB_SERVICE", None)
