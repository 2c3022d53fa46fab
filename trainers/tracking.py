"""Trackers beside metrics.jsonl: wandb, tensorboard, csv, or none."""

import importlib
import os
from collections.abc import Callable, Mapping
from typing import Any

from torchrl.record.loggers import CSVLogger, Logger, TensorboardLogger, WandbLogger

from .config import RunConfig, to_values
from .run_folder import RunFolder


def _wandb(config: RunConfig, run: RunFolder) -> Logger:
    """Groups by setup and fire, tags by method and seed; offline unless WANDB_MODE says else."""
    import wandb

    offline = os.environ.get("WANDB_MODE", "offline") != "online"
    logger = WandbLogger(
        exp_name=run.path.name,
        project=os.environ.get("WANDB_PROJECT", "emberlink"),
        save_dir=str(run.path),
        offline=offline,
        log_env_packages=False,  # it would stand in the configuration as "env"
        settings=wandb.Settings(silent=offline, console="off"),
        reinit="create_new",  # seeds that train side by side are runs of their own
        group=f"{config.setup}-{config.fire.name}",
        tags=[config.method, f"seed-{config.seed}"],
    )
    logger.log_hparams(to_values(config))
    return logger


def _tensorboard(config: RunConfig, run: RunFolder) -> Logger:
    return TensorboardLogger(exp_name="tensorboard", log_dir=str(run.path))


def _csv(config: RunConfig, run: RunFolder) -> Logger:
    return CSVLogger(exp_name="csv", log_dir=str(run.path))


_TRACKERS: dict[str, Callable[[RunConfig, RunFolder], Logger]] = {
    "wandb": _wandb,
    "tensorboard": _tensorboard,
    "csv": _csv,
}


_PACKAGES = ("wandb", "tensorboard")
"""the trackers that are a package of their own"""


def check(logger: str) -> None:
    """Tries what a tracker needs, before a run folder is made.

    Raises:
        ValueError: it is not installed; the message says how to install it.
    """
    if logger not in _PACKAGES:
        return
    try:
        importlib.import_module(logger)
    except ImportError as error:
        raise ValueError(
            f"logger={logger}: {error}; install it with: pip install {logger}"
        ) from None


class Tracker:
    """Hands each episode's numbers to the tracker that the configuration names.

    Args:
        config: of the run.
        run: where the tracker writes.
    """

    def __init__(self, config: RunConfig, run: RunFolder):
        make = _TRACKERS.get(config.logger)
        self.logger = make(config, run) if make else None

    def log(self, line: Mapping[str, Any], step: int) -> None:
        """One episode's line of metrics.jsonl; numbers only."""
        if isinstance(self.logger, WandbLogger):
            # All in one row of the history, whose step is the episode.
            self.logger.log_metrics(dict(line), step=step, override_global_step=True)
        elif self.logger is not None:
            for name, value in line.items():
                self.logger.log_scalar(name, float(value), step=step)

    def close(self) -> None:
        """Writes what is left; the tracker is not used afterwards."""
        if isinstance(self.logger, WandbLogger):
            self.logger.experiment.finish()
        elif isinstance(self.logger, TensorboardLogger):
            self.logger.experiment.close()
