"""Configurations, training, evaluation, comparison and the command line; what Python offers."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from emberlink.trainers.api import Run, TrainedPolicy, compare, evaluate, load, train
    from emberlink.trainers.build import make_env
    from emberlink.trainers.config.compose import resolve
    from emberlink.trainers.config.schema import RunConfig
    from emberlink.trainers.training.trainer import Trainer

__all__ = [
    "Run",
    "RunConfig",
    "TrainedPolicy",
    "Trainer",
    "compare",
    "evaluate",
    "load",
    "make_env",
    "resolve",
    "train",
]

_FILES = {
    "Run": "api",
    "RunConfig": "config.schema",
    "TrainedPolicy": "api",
    "Trainer": "training.trainer",
    "compare": "api",
    "evaluate": "api",
    "load": "api",
    "make_env": "build",
    "resolve": "config.compose",
    "train": "api",
}


def __getattr__(name: str) -> Any:
    # Imported when asked for, so that `emberlink --help` need not wait for torch.
    if name in _FILES:
        return getattr(import_module(f"{__name__}.{_FILES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
