"""The wildfire environment, for TorchRL and for PettingZoo."""

from typing import TYPE_CHECKING

from emberlink.envs.utils.lazy import lazy

if TYPE_CHECKING:
    from emberlink.envs.config import RewardConfig, WildfireConfig
    from emberlink.envs.fire.generator import FireConfig
    from emberlink.envs.fire.reaction import ReactionConfig
    from emberlink.envs.fire_files.config import FileFireConfig
    from emberlink.envs.pettingzoo import parallel_env
    from emberlink.envs.wildfire import WildfireEnv

__all__ = [
    "FileFireConfig",
    "FireConfig",
    "ReactionConfig",
    "RewardConfig",
    "WildfireConfig",
    "WildfireEnv",
    "parallel_env",
]

__getattr__ = lazy(
    __name__,
    {
        "config": "RewardConfig WildfireConfig",
        "fire.generator": "FireConfig",
        "fire.reaction": "ReactionConfig",
        "fire_files.config": "FileFireConfig",
        "pettingzoo": "parallel_env",
        "wildfire": "WildfireEnv",
    },
)
