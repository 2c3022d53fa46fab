"""Sends a run's numbers and figures to TorchRL's loggers: wandb, TensorBoard, CSV."""

import os
import shutil
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from emberlink.trainers.config.compose import to_values
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.runs.run_folder import RunFolder

_CONNECTING, _PATIENCE = 20.0, 30.0
"""maximum seconds for wandb to connect to its server, and at the end of a training"""


class Tracker:
    """Logs the episodes and the final evaluation of one run, as `config.logger` says.

    If the logger fails, there is a warning and nothing more is logged. metrics.jsonl does not
    depend on it.
    """

    def __init__(self, config: RunConfig, run: RunFolder):
        self._name, self._episodes = config.logger, config.episodes
        self._logger: Any = None
        if self._name == "none":
            return
        make = _wandb if self._name == "wandb" else _files
        self._logger = self._tried(lambda: make(config, run))
        if self._name != "wandb":  # its server has the earlier episodes
            for line in run.metrics():
                self.log(line)

    def log(self, line: Mapping[str, float]) -> None:
        """Logs a line of metrics.jsonl in the sections `training` and `validation`."""
        parts = {f"{'validation' if '/' in n else 'training'}/{n}": v for n, v in line.items()}
        more = {"override_global_step": True} if self._name == "wandb" else {}
        if logger := self._logger:
            self._tried(lambda: logger.log_metrics(parts, step=int(line["episode"]), **more))

    def log_evaluation(self, numbers: Mapping[str, float], figures: Sequence[Path]) -> None:
        """Logs the final evaluation: means by name, PNG files and, to wandb, GIF files."""
        if logger := self._logger:
            self._tried(lambda: _log_at_the_end(logger, dict(numbers), figures, self._episodes))

    def close(self) -> None:
        """Flushes and closes the logger."""
        if logger := self._logger:
            self._tried(logger.close)
        self._logger = None

    def _tried(self, say: Callable[[], Any]) -> Any:
        """Calls a function; an error of a tracker must not end the training."""
        try:
            return say()
        except (Exception, SystemExit) as error:
            self._logger = None
            why = " ".join(f"{type(error).__name__}: {error}".split())
            warnings.warn(
                f"logger={self._name} has stopped ({why[:200]}); the training continues, "
                "metrics.jsonl is complete",
                stacklevel=3,
            )


def _wandb(config: RunConfig, run: RunFolder) -> Any:
    """Returns a logger to wandb, offline unless WANDB_MODE is set; a resumed run keeps its id."""
    import wandb
    from torchrl.record.loggers import WandbLogger

    for path in filter(Path.is_symlink, [*run.path.glob("wandb/**/*")]):
        path.unlink()  # wandb creates its own links again
    # wandb names the folders run-TIME-ID or offline-run-TIME-ID.
    before = sorted(path.name.partition("run-")[2] for path in run.path.glob("wandb/*run-*-*"))
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
            finish_timeout=_PATIENCE,
        ),
        reinit="create_new",  # the caller may have a run of their own
        group=chosen("WANDB_RUN_GROUP") or f"{config.setup}-{config.fire.name}",
        tags=[config.method, f"seed-{config.seed}"],
    )
    logger.log_hparams(to_values(config))
    return logger


def _files(config: RunConfig, run: RunFolder) -> Any:
    """Returns a logger to RUN/csv/scalars/NAME.csv, or to event files in RUN/tensorboard.

    The files are written again in a resumed run.
    """
    from torchrl.record.loggers import get_logger

    shutil.rmtree(run.path / config.logger, ignore_errors=True)
    return get_logger(config.logger, str(run.path), config.logger)  # pyright: ignore


def _log_at_the_end(
    logger: Any, numbers: dict[str, float], figures: Sequence[Path], episode: int
) -> None:
    """Logs the final evaluation: to wandb's summary, else at the step of the last episode."""
    experiment, named = logger.experiment, {f"figures/{path.stem}": path for path in figures}
    if hasattr(experiment, "summary"):
        import wandb

        kinds = {".png": wandb.Image, ".gif": wandb.Video}
        shown = {name: kinds[path.suffix](str(path)) for name, path in named.items()}
        experiment.summary.update({**numbers, **shown})
        return
    logger.log_metrics(numbers, step=episode)
    images = {name: path for name, path in named.items() if path.suffix == ".png"}
    for name, path in images.items() if hasattr(experiment, "add_image") else ():
        pixels = np.asarray(Image.open(path).convert("RGB"))
        experiment.add_image(name, pixels, episode, dataformats="HWC")
