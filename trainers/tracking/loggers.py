"""Defines experiment trackers: wandb, TensorBoard and CSV."""

import csv
import io
import os
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from PIL import Image
from torchrl.record.loggers import TensorboardLogger, WandbLogger

from emberlink.envs.utils.atomic_io import inner_folder, remove_links
from emberlink.envs.utils.errors import UserError, how_to_install
from emberlink.trainers.config.compose import to_values
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.runs.run_folder import RunFolder

PATIENCE = 60.0
"""maximum seconds that a finished training waits for its tracker"""
_CONNECTING = 20.0
"""maximum seconds for wandb to connect to its server, if WANDB_MODE=online"""
_BETWEEN_TABLES = 10.0
"""minimum seconds between two writes of metrics.csv"""
WANDB_TEARDOWN = "emberlink-wandb-teardown"
"""name of the thread that shuts down a failed wandb"""


class Tracker(Protocol):
    """Logs the metrics of one run."""

    def log(self, line: Mapping[str, float], episode: int) -> None:
        """Logs an episode's line of metrics.jsonl."""
        ...

    def log_evaluation(self, numbers: Mapping[str, float], figures: Sequence[Path]) -> None:
        """Logs the final evaluation: means by name, and PNG files."""
        ...

    def finish(self) -> None:
        """Flushes and closes the tracker."""
        ...


class Wandb:
    """Logs to wandb, grouped by setup and fire, with tags for method and seed.

    It is offline unless WANDB_MODE is set. A resumed run keeps its id.

    Args:
        config: configuration of the run.
        run: run folder that wandb writes to.
        episode: number of episodes logged before.
    """

    def __init__(self, config: RunConfig, run: RunFolder, episode: int):
        # The name of a folder that wandb created ends with the id of the run.
        folder = inner_folder(run.path, "wandb")
        remove_links(folder)  # wandb creates its own links again
        before = sorted(folder.glob("*run-*-*"))
        import wandb

        offline = os.environ.get("WANDB_MODE", "offline") in ("", "offline", "dryrun")
        self._episodes = config.episodes
        self._logger = WandbLogger(
            exp_name=run.path.name,
            project=os.environ.get("WANDB_PROJECT", "emberlink"),
            id=before[-1].name.rpartition("-")[2] if before else None,
            save_dir=str(run.path.absolute()),
            offline=offline,
            log_env_packages=False,  # it would overwrite "env" in the configuration
            settings=wandb.Settings(
                silent=offline,
                console="off",
                init_timeout=_CONNECTING,
                finish_timeout=PATIENCE / 2,
            ),
            reinit="create_new",  # each of several parallel seeds is a run
            group=f"{config.setup}-{config.fire.name}",
            tags=[config.method, f"seed-{config.seed}"],
        )
        self._logger.log_hparams(to_values(config))

    def log(self, line: Mapping[str, float], episode: int) -> None:
        """Logs an episode's line of metrics.jsonl, with the episode as wandb's step."""
        self._logger.log_metrics(dict(line), step=episode, override_global_step=True)

    def log_evaluation(self, numbers: Mapping[str, float], figures: Sequence[Path]) -> None:
        """Logs the final evaluation at the step after the last episode."""
        import wandb

        images = {f"figures/{path.stem}": wandb.Image(str(path)) for path in figures}
        self._logger.experiment.log({**numbers, **images}, step=self._episodes + 1)

    def finish(self) -> None:
        """Flushes and closes the tracker."""
        self._logger.experiment.finish()


class Tensorboard:
    """Logs to TensorBoard; arguments are those of `Wandb`."""

    def __init__(self, config: RunConfig, run: RunFolder, episode: int):
        self._episodes = config.episodes
        folder = inner_folder(run.path, "tensorboard")
        remove_links(folder)
        is_resumed = episode > 0 or any(folder.glob("events*"))
        self._logger = TensorboardLogger(exp_name="tensorboard", log_dir=str(run.path))
        if is_resumed:
            self._purge(episode + 1)

    def _purge(self, step: int) -> None:
        """Makes TensorBoard discard the events that an earlier process logged from a step on."""
        from tensorboard.compat.proto import event_pb2

        proto: Any = event_pb2  # its classes are generated when it is imported
        start = proto.Event(session_log=proto.SessionLog(status=proto.SessionLog.START))
        self._logger.experiment.file_writer.add_event(start, step)

    def log(self, line: Mapping[str, float], episode: int) -> None:
        """Logs an episode's line of metrics.jsonl, with the episode as the step."""
        for name, value in line.items():
            self._logger.log_scalar(name, float(value), step=episode)

    def log_evaluation(self, numbers: Mapping[str, float], figures: Sequence[Path]) -> None:
        """Logs the final evaluation at the step of the last episode."""
        self.log(numbers, self._episodes)
        for path in figures:
            pixels = np.asarray(Image.open(path).convert("RGB"))
            self._logger.experiment.add_image(
                f"figures/{path.stem}", pixels, self._episodes, dataformats="HWC"
            )

    def finish(self) -> None:
        """Flushes and closes the tracker."""
        self._logger.experiment.close()


class Csv:
    """Writes metrics.csv with a header; arguments are those of `Wandb`.

    The file is converted from metrics.jsonl, so that it is correct in a resumed run.
    """

    def __init__(self, config: RunConfig, run: RunFolder, episode: int):
        self._run, self._next = run, 0.0
        self._write(episode)

    def log(self, line: Mapping[str, float], episode: int) -> None:
        """Writes the file again if the last write was some seconds ago."""
        if time.monotonic() >= self._next:
            self._write(episode)

    def log_evaluation(self, numbers: Mapping[str, float], figures: Sequence[Path]) -> None:
        """Does nothing: the run folder holds eval.json and the figures."""

    def finish(self) -> None:
        """Writes all lines."""
        self._write(None)

    def _write(self, episodes: int | None) -> None:
        lines = self._run.lines()[:episodes]
        text = io.StringIO()
        names = list(dict.fromkeys(name for line in lines for name in line))
        table = csv.DictWriter(text, names, lineterminator="\n")
        table.writeheader()
        table.writerows(lines)
        self._run.write_text("metrics.csv", text.getvalue())
        self._next = time.monotonic() + _BETWEEN_TABLES


TRACKERS: dict[str, type[Wandb] | type[Tensorboard] | type[Csv]] = {
    "wandb": Wandb,
    "tensorboard": Tensorboard,
    "csv": Csv,
}
"""value of the key `logger` -> tracker"""


def check_installed(config: RunConfig) -> None:
    """Checks that the package of a configuration's tracker is installed.

    Raises:
        UserError: it is not installed; the message says how to install it.
    """
    name = config.logger
    if name in ("wandb", "tensorboard") and find_spec(name) is None:
        how = how_to_install(name) if name == "tensorboard" else f"pip install {name}"
        raise UserError(f"logger={name}: {name} is not installed: {how}")


def release_wandb() -> None:
    """Shuts wandb down, so that its exit hook does not wait for a service that has ended.

    The shutdown may block, so it runs in a thread.
    """

    def teardown() -> None:
        with suppress(BaseException):
            sys.modules["wandb"].teardown()

    thread = threading.Thread(target=teardown, name=WANDB_TEARDOWN, daemon=True)
    thread.start()
    thread.join(2.0)
    # With this variable, a later run of this process would connect to the service that has ended.
    os.environ.pop("WANDB_SERVICE", None)
