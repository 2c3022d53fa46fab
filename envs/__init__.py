"""The wildfire environment, for TorchRL and for PettingZoo."""

from .config import WildfireConfig
from .fire import FireConfig
from .fire_file import FileFireConfig
from .parallel import parallel_env
from .reward import RewardConfig
from .wildfire import WildfireEnv

__all__ = [
    "FileFireConfig",
    "FireConfig",
    "RewardConfig",
    "WildfireConfig",
    "WildfireEnv",
    "parallel_env",
]
