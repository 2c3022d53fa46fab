"""Finds communication modules: the files beside this one, and those of other packages."""

from collections.abc import Mapping
from typing import Any

from emberlink.envs.config import WildfireConfig
from emberlink.envs.utils.plugins import Registry
from emberlink.envs.utils.validation import from_plain

from .base import CommModule

_REGISTRY = Registry(CommModule, "emberlink.comm", "comm.name")
known, find = _REGISTRY.known, _REGISTRY.find


def build(name: str, world: WildfireConfig, settings: Mapping[str, Any]) -> CommModule:
    """Returns a communication module with its settings.

    Raises:
        UserError: an unknown name or setting, or a value out of range.
    """
    module = find(name)
    return module(world, from_plain(module.config_type, settings, "comm"))
