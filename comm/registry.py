"""The communication modules that there are: the files beside this one."""

import importlib
from collections.abc import Mapping
from pathlib import Path
from pkgutil import iter_modules
from typing import Any

from emberlink.envs.config import WildfireConfig
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import from_plain

from .base import CommModule

_OWN_FILES = ("base", "registry")


def known() -> list[str]:
    """The names of the modules, in alphabetical order."""
    beside = iter_modules([str(Path(__file__).parent)])
    return sorted(
        module.name
        for module in beside
        if module.name not in _OWN_FILES and not module.name.startswith("_")
    )


def find(name: str) -> type[CommModule]:
    """The module's class.

    Raises:
        ValueError: there is no such file; the message lists those there are.
    """
    if name not in known():
        raise UserError(f"comm.name={name!r} is not known; known: {', '.join(known())}")
    file = importlib.import_module(f"{__package__}.{name}")
    found = [
        item
        for item in vars(file).values()
        if isinstance(item, type)
        and issubclass(item, CommModule)
        and item.__module__ == file.__name__
    ]
    if len(found) != 1:
        raise UserError(f"comm/{name}.py defines {len(found)} communication modules; 1 is needed")
    return found[0]


def build(
    name: str, world: WildfireConfig, settings: Mapping[str, Any], num_envs: int = 1
) -> CommModule:
    """Returns a communication module with its settings.

    Args:
        name: of the communication method.
        world: the environment's constants.
        settings: what stands under `comm` but the name.
        num_envs: environments that run side by side.

    Raises:
        ValueError: an unknown name or setting, or a value out of range.
    """
    module = find(name)
    return module(world, from_plain(module.config_type, settings), num_envs)
