"""The wildfire environment, for TorchRL and for PettingZoo."""

from .config import RewardConfig, WildfireConfig
from .fire import FireConfig
from .fire_file import FileFireConfig
from .parallel import parallel_env
from .wildfire import WildfireEnv

__all__ = [
    "FileFireConfig",
    "FireConfig",
    "RewardConfig",
    "WildfireConfig",
    "WildfireEnv",
    "parallel_env",
]
