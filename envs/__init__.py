"""The wildfire environment, for TorchRL and for PettingZoo."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from emberlink.envs.config import RewardConfig, WildfireConfig
    from emberlink.envs.fire.generator import FireConfig
    from emberlink.envs.fire_files.config import FileFireConfig
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

_FILES = {
    "FileFireConfig": "fire_files.reader",
    "FireConfig": "fire.generator",
    "RewardConfig": "config",
    "WildfireConfig": "config",
    "WildfireEnv": "wildfire",
    "parallel_env": "pettingzoo",
}


def __getattr__(name: str) -> Any:
    # Imported when asked for: `emberlink.envs.utils` is used where torch is not needed.
    if name in _FILES:
        return getattr(import_module(f"{__name__}.{_FILES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
