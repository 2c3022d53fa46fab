"""The trackers that a training may report to beside metrics.jsonl: wandb, TensorBoard, CSV."""

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
from emberlink.envs.utils.errors import UserError
from emberlink.trainers.config.compose import to_values
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.runs.run_folder import RunFolder

PATIENCE = 60.0
"""seconds that the end of a training waits for its tracker"""
_CONNECTING = 20.0
"""seconds that wandb may take to reach its server, where WANDB_MODE=online"""
_BETWEEN_TABLES = 10.0
"""seconds between two versions of metrics.csv"""
WANDB_TEARDOWN = "emberlink-wandb-teardown"
"""name of a thread that may outlive a wandb tracker that failed"""


class Tracker(Protocol):
    """Receives the numbers of one run."""

    def log(self, line: Mapping[str, float], episode: int) -> None:
        """Logs an episode's line of metrics.jsonl."""
        ...

    def log_evaluation(self, numbers: Mapping[str, float], figures: Sequence[Path]) -> None:
        """Logs the final evaluation: its means by name, and PNG files."""
        ...

    def finish(self) -> None:
        """Writes what is left; the tracker is not used afterwards."""
        ...


class Wandb:
    """Logs to wandb: grouped by setup and fire, tagged by method and seed.

    Offline, unless WANDB_MODE says otherwise. A resumed run keeps its id.

    Args:
        config: of the run.
        run: where wandb writes.
        episode: number of episodes that were logged before.
    """

    def __init__(self, config: RunConfig, run: RunFolder, episode: int):
        # The id is the last part of the name of the folder that wandb made.
        folder = inner_folder(run.path, "wandb")
        remove_links(folder)  # wandb makes its own again
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
        self._logger.log_hparams(to_values(config))

    def log(self, line: Mapping[str, float], episode: int) -> None:
        """See `Tracker`; the step of wandb's history is the episode."""
        self._logger.log_metrics(dict(line), step=episode, override_global_step=True)

    def log_evaluation(self, numbers: Mapping[str, float], figures: Sequence[Path]) -> None:
        """See `Tracker`; the step is the one after the last episode."""
        import wandb

        images = {f"figures/{path.stem}": wandb.Image(str(path)) for path in figures}
        self._logger.experiment.log({**numbers, **images}, step=self._episodes + 1)

    def finish(self) -> None:
        """See `Tracker`."""
        self._logger.experiment.finish()


class Tensorboard:
    """Logs to TensorBoard; the arguments are those of `Wandb`."""

    def __init__(self, config: RunConfig, run: RunFolder, episode: int):
        self._episodes = config.episodes
        folder = inner_folder(run.path, "tensorboard")
        remove_links(folder)
        is_resumed = episode > 0 or any(folder.glob("events*"))
        self._logger = TensorboardLogger(exp_name="tensorboard", log_dir=str(run.path))
        if is_resumed:
            self._purge(episode + 1)

    def _purge(self, step: int) -> None:
        """Tells TensorBoard to forget what an earlier process logged from a step on."""
        from tensorboard.compat.proto import event_pb2

        made: Any = event_pb2  # its classes are made when it is imported
        start = made.Event(session_log=made.SessionLog(status=made.SessionLog.START))
        self._logger.experiment.file_writer.add_event(start, step)

    def log(self, line: Mapping[str, float], episode: int) -> None:
        """See `Tracker`; the step is the episode."""
        for name, value in line.items():
            self._logger.log_scalar(name, float(value), step=episode)

    def log_evaluation(self, numbers: Mapping[str, float], figures: Sequence[Path]) -> None:
        """See `Tracker`; the step is the last episode."""
        self.log(numbers, self._episodes)
        for path in figures:
            pixels = np.asarray(Image.open(path).convert("RGB"))
            self._logger.experiment.add_image(
                f"figures/{path.stem}", pixels, self._episodes, dataformats="HWC"
            )

    def finish(self) -> None:
        """See `Tracker`."""
        self._logger.experiment.close()


class Csv:
    """Writes metrics.csv, with a header; the arguments are those of `Wandb`.

    The file is made of metrics.jsonl, so that it is right after a run was resumed, too.
    """

    def __init__(self, config: RunConfig, run: RunFolder, episode: int):
        self._run, self._next = run, 0.0
        self._write(episode)

    def log(self, line: Mapping[str, float], episode: int) -> None:
        """See `Tracker`; the file is written again after some seconds."""
        if time.monotonic() >= self._next:
            self._write(episode)

    def log_evaluation(self, numbers: Mapping[str, float], figures: Sequence[Path]) -> None:
        """Does nothing: eval.json and figures/ are beside the file."""

    def finish(self) -> None:
        """See `Tracker`."""
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
"""the trackers by the value of the key `logger`"""


def check_installed(config: RunConfig) -> None:
    """Checks that the package of a configuration's tracker is installed.

    Raises:
        UserError: it is not; the message says how to install it.
    """
    name = config.logger
    if name in ("wandb", "tensorboard") and find_spec(name) is None:
        extra = ".[tensorboard]" if name == "tensorboard" else name
        raise UserError(f"logger={name}: {name} is not installed: pip install '{extra}'")


def release_wandb() -> None:
    """Undoes wandb's hook at the end of the program, which would wait for a process that is gone.

    The call itself may wait, so a thread makes it.
    """

    def teardown() -> None:
        with suppress(BaseException):
            sys.modules["wandb"].teardown()

    ending = threading.Thread(target=teardown, name=WANDB_TEARDOWN, daemon=True)
    ending.start()
    ending.join(2.0)
    # By this variable, a later run of this process would look for the one that is gone.
    os.environ.pop("WANDB_SERVICE", None)
