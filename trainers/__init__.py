"""Configuration, training, evaluation and comparison of policies; the Python API of emberlink."""

from typing import TYPE_CHECKING

from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.lazy import lazy

if TYPE_CHECKING:
    from emberlink.trainers.api import Run, compare, evaluate, resume, train
    from emberlink.trainers.build import make_env
    from emberlink.trainers.config.compose import resolve
    from emberlink.trainers.config.schema import RunConfig
    from emberlink.trainers.evaluation.export import export
    from emberlink.trainers.evaluation.policy import TrainedPolicy, load
    from emberlink.trainers.training.trainer import Trainer

__all__ = [
    "Run",
    "RunConfig",
    "TrainedPolicy",
    "Trainer",
    "UserError",
    "compare",
    "evaluate",
    "export",
    "load",
    "make_env",
    "resolve",
    "resume",
    "train",
]

__getattr__ = lazy(
    __name__,
    {
        "api": "Run compare evaluate resume train",
        "build": "make_env",
        "config.compose": "resolve",
        "config.schema": "RunConfig",
        "evaluation.export": "export",
        "evaluation.policy": "TrainedPolicy load",
        "training.trainer": "Trainer",
    },
)
