"""Finds communication modules: the files beside this one, and those of other packages."""

from collections.abc import Mapping
from typing import Any

from emberlink.comm.base import CommModule
from emberlink.envs.config import WildfireConfig
from emberlink.envs.utils.plugins import Registry
from emberlink.envs.utils.validation import from_plain

_REGISTRY = Registry(CommModule, "emberlink.comm", "comm.name")
known, find = _REGISTRY.known, _REGISTRY.find


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
        UserError: an unknown name or setting, or a value out of range.
    """
    module = find(name)
    return module(world, from_plain(module.config_type, settings, "comm"), num_envs)
