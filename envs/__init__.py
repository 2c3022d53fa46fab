"""The wildfire environment, for TorchRL and for PettingZoo."""

from emberlink.envs.config import RewardConfig, WildfireConfig
from emberlink.envs.fire.generator import FireConfig
from emberlink.envs.fire_files.reader import FileFireConfig
from emberlink.envs.pettingzoo import parallel_env
from emberlink.envs.wildfire import WildfireEnv

__all__ = [
    "FileFireConfig",
    "FireConfig",
    "RewardConfig",
    "WildfireConfig",
    "WildfireEnv",
    "parallel_env",
]
