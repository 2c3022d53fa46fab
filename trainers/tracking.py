"""Sends a run's numbers and figures to TorchRL's loggers: wandb, TensorBoard, CSV."""

import os
import shutil
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from emberlink.envs.utils.errors import UserError, how_to_install
from emberlink.trainers.config.compose import to_values
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.runs.run_folder import RunFolder

_CONNECTING, _PATIENCE = 20.0, 30.0
"""maximum seconds for wandb to connect to its server, and at the end of a training"""


def check_installed(name: str) -> None:
    """Checks that the package of the tracker `logger=NAME` is installed."""
    if name in ("wandb", "tensorboard") and find_spec(name) is None:
        how = how_to_install(name) if name == "tensorboard" else f"pip install {name}"
        raise UserError(f"logger={name}: {name} is not installed: {how}")


class Tracker:
    """Logs the episodes and the final evaluation of one run, as `config.logger` says.

    If the logger fails, there is a warning and nothing more is logged. metrics.jsonl does not
    depend on it.
    """

    def __init__(self, config: RunConfig, run: RunFolder):
        self._name, self._episodes = config.logger, config.episodes
        self._logger: Any = None
        if self._name != "none":
            with self._at_most_a_warning():
                self._logger = _LOGGERS[self._name](config, run)
        if self._name != "wandb":  # its server has the earlier episodes
            for line in run.metrics() if self._logger else ():
                self.log(line)

    def log(self, line: Mapping[str, float]) -> None:
        """Logs a line of metrics.jsonl, with its episode as the step."""
        more = {"override_global_step": True} if self._name == "wandb" else {}
        with self._at_most_a_warning():
            if self._logger is not None:
                self._logger.log_metrics(dict(line), step=int(line["episode"]), **more)

    def log_evaluation(self, numbers: Mapping[str, float], figures: Sequence[Path]) -> None:
        """Logs the final evaluation: means by name, and PNG files."""
        with self._at_most_a_warning():
            if self._logger is not None:
                _log_at_the_end(self._logger, dict(numbers), figures, self._episodes)

    def close(self) -> None:
        """Flushes and closes the logger."""
        with self._at_most_a_warning():
            experiment = getattr(self._logger, "experiment", None)
            close = getattr(experiment, "finish", None) or getattr(experiment, "close", None)
            if close is not None:
                close()
        self._logger = None

    @contextmanager
    def _at_most_a_warning(self) -> Iterator[None]:
        try:
            yield
        except (Exception, SystemExit) as error:  # an error of a tracker must not end the training
            self._logger = None
            why = " ".join(f"{type(error).__name__}: {error}".split())
            warnings.warn(
                f"logger={self._name} has stopped ({why[:200]}); the training continues, "
                "metrics.jsonl is complete",
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
            finish_timeout=_PATIENCE,
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


def _log_at_the_end(
    logger: Any, numbers: dict[str, float], figures: Sequence[Path], episode: int
) -> None:
    """Logs the final evaluation: to wandb's summary, else at the step of the last episode."""
    experiment, images = logger.experiment, {f"figures/{path.stem}": path for path in figures}
    if hasattr(experiment, "summary"):
        import wandb

        pictures = {name: wandb.Image(str(path)) for name, path in images.items()}
        experiment.summary.update({**numbers, **pictures})
        return
    logger.log_metrics(numbers, step=episode)
    for name, path in images.items() if hasattr(experiment, "add_image") else ():
        pixels = np.asarray(Image.open(path).convert("RGB"))
        experiment.add_image(name, pixels, episode, dataformats="HWC")
