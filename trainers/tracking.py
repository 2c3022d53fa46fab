"""Sends a run's numbers and figures to TorchRL's loggers: wandb, TensorBoard, CSV."""

import os
import queue
import shutil
import sys
import threading
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from emberlink.envs.utils.errors import UserError, how_to_install
from emberlink.trainers.config.compose import to_values
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.runs.run_folder import RunFolder

PATIENCE = 60.0
"""maximum seconds that a finished training waits for its tracker"""
_CONNECTING = 20.0
"""maximum seconds for wandb to connect to its server, if WANDB_MODE=online"""
WANDB_TEARDOWN = "emberlink-wandb-teardown"
"""name of the thread that shuts down a failed wandb"""


def check_installed(name: str) -> None:
    """Checks that the package of the tracker `logger=NAME` is installed.

    Raises:
        UserError: it is not installed; the message says how to install it.
    """
    if name in ("wandb", "tensorboard") and find_spec(name) is None:
        how = how_to_install(name) if name == "tensorboard" else f"pip install {name}"
        raise UserError(f"logger={name}: {name} is not installed: {how}")


class Tracker:
    """Logs the episodes and the final evaluation of one run, as `config.logger` says.

    The logger runs in a thread, since it may block on a network or a process. If it fails, there is
    a warning and nothing more is logged. metrics.jsonl does not depend on it.
    """

    def __init__(self, config: RunConfig, run: RunFolder):
        self._name, self._episodes = config.logger, config.episodes
        self._jobs: queue.SimpleQueue[Callable[[Any], None] | None] = queue.SimpleQueue()
        self._failure: str | None = None
        self._thread: threading.Thread | None = None
        if self._name == "none":
            return
        self._thread = threading.Thread(target=self._work, args=(config, run), daemon=True)
        if self._name != "wandb":  # its server has the earlier episodes
            for line in run.metrics():
                self.log(line)
        self._thread.start()

    def log(self, line: Mapping[str, float]) -> None:
        """Logs a line of metrics.jsonl, with its episode as the step."""
        numbers, step = dict(line), int(line["episode"])
        if self._name == "wandb":
            self._put(lambda at: at.log_metrics(numbers, step=step, override_global_step=True))
        else:
            self._put(lambda at: at.log_metrics(numbers, step=step))

    def log_evaluation(self, numbers: Mapping[str, float], figures: Sequence[Path]) -> None:
        """Logs the final evaluation: means by name, and PNG files."""
        log = _to_summary if self._name == "wandb" else _at_the_end
        self._put(lambda logger: log(logger, dict(numbers), figures, self._episodes))

    def close(self) -> None:
        """Closes the logger; waits at most `PATIENCE` seconds."""
        if self._thread is None:
            return
        self._jobs.put(None)
        self._thread.join(PATIENCE)
        if self._thread.is_alive() and self._failure is None:
            self._failure = f"no answer within {PATIENCE:g} s"
        if self._failure is not None:
            self._give_up(self._failure)
        self._thread = None

    def _put(self, job: Callable[[Any], None]) -> None:
        if self._thread is None:
            return
        self._jobs.put(job)
        if self._failure is not None:
            self._give_up(self._failure)

    def _work(self, config: RunConfig, run: RunFolder) -> None:
        logger = None
        try:
            logger = _LOGGERS[self._name](config, run)
            while (job := self._jobs.get()) is not None:
                job(logger)
            _finish(logger)
        except BaseException as error:  # an error of a tracker must not end the training
            self._failure = " ".join(f"{type(error).__name__}: {error}".split())
            with suppress(BaseException):
                _finish(logger)

    def _give_up(self, reason: str) -> None:
        self._thread = None
        if self._name == "wandb":
            _release_wandb()
        shown = reason if len(reason) <= 200 else reason[:200] + " ..."
        warnings.warn(
            f"logger={self._name} has stopped ({shown}); "
            "the training continues, metrics.jsonl is complete",
            stacklevel=4,
        )


def _wandb(config: RunConfig, run: RunFolder) -> Any:
    """Returns a logger to wandb, offline unless WANDB_MODE is set; a resumed run keeps its id."""
    import wandb
    from torchrl.record.loggers import WandbLogger

    folder = run.path / "wandb"
    folder.mkdir(exist_ok=True)
    for path in [*folder.rglob("*")]:
        if path.is_symlink():  # wandb creates its own links again
            path.unlink()
    # wandb names the folders run-TIME-ID or offline-run-TIME-ID.
    before = [path.name.partition("run-")[2] for path in sorted(folder.glob("*run-*-*"))]
    chosen = os.environ.get  # wandb's own variables
    mode = chosen("WANDB_MODE") or "offline"
    logger = WandbLogger(
        exp_name=chosen("WANDB_NAME") or run.path.name,
        project=chosen("WANDB_PROJECT") or "emberlink",
        id=chosen("WANDB_RUN_ID") or (before[-1].partition("-")[2] if before else None),
        save_dir=str(run.path.absolute()),
        log_env_packages=False,  # it would overwrite "env" in the configuration
        mode=mode,
        settings=wandb.Settings(
            silent=mode != "online",
            console="off",
            init_timeout=_CONNECTING,
            finish_timeout=PATIENCE / 2,
        ),
        reinit="create_new",  # the caller may have a run of their own
        group=chosen("WANDB_RUN_GROUP") or f"{config.setup}-{config.fire.name}",
        tags=[config.method, f"seed-{config.seed}"],
    )
    logger.log_hparams(to_values(config))
    return logger


def _tensorboard(_: RunConfig, run: RunFolder) -> Any:
    """Returns a logger to new event files; removes the files from before a resume."""
    from torchrl.record.loggers import TensorboardLogger

    for path in run.path.glob("tensorboard/events.*"):
        path.unlink()
    return TensorboardLogger(exp_name="tensorboard", log_dir=str(run.path))


def _csv(_: RunConfig, run: RunFolder) -> Any:
    """Returns a logger to RUN/csv/scalars/NAME.csv, which is written again in a resumed run."""
    from torchrl.record.loggers import CSVLogger

    shutil.rmtree(run.path / "csv" / "scalars", ignore_errors=True)
    return CSVLogger(exp_name="csv", log_dir=str(run.path))


_LOGGERS = {"wandb": _wandb, "tensorboard": _tensorboard, "csv": _csv}


def _to_summary(logger: Any, numbers: dict[str, float], figures: Sequence[Path], _: int) -> None:
    """Writes the final evaluation to wandb's summary, so that it takes no episode's step."""
    import wandb

    images = {f"figures/{path.stem}": wandb.Image(str(path)) for path in figures}
    logger.experiment.summary.update({**numbers, **images})


def _at_the_end(
    logger: Any, numbers: dict[str, float], figures: Sequence[Path], episode: int
) -> None:
    """Logs the final evaluation at the step of the last episode."""
    logger.log_metrics(numbers, step=episode)
    if not hasattr(logger.experiment, "add_image"):
        return
    import numpy as np
    from PIL import Image

    for path in figures:
        pixels = np.asarray(Image.open(path).convert("RGB"))
        logger.experiment.add_image(f"figures/{path.stem}", pixels, episode, dataformats="HWC")


def _finish(logger: Any) -> None:
    """Flushes and closes a logger."""
    experiment = getattr(logger, "experiment", None)
    close = getattr(experiment, "finish", None) or getattr(experiment, "close", None)
    if close is not None:
        close()


def _release_wandb() -> None:
    """Shuts wandb down in a thread, so that its exit hook does not wait for an ended service."""

    def teardown() -> None:
        with suppress(BaseException):
            sys.modules["wandb"].teardown()

    thread = threading.Thread(target=teardown, name=WANDB_TEARDOWN, daemon=True)
    thread.start()
    thread.join(2.0)
    # With this variable, a later run of this process would connect to the service that has ended.
    os.environ.pop("WANDB_SERVICE", None)
