"""Finds communication modules by name: emberlink's own, and entry points of other packages."""

import warnings
from collections.abc import Mapping
from typing import Any

from emberlink.comm.base import CommModule
from emberlink.envs.config import WildfireConfig
from emberlink.envs.utils.plugins import Registry
from emberlink.envs.utils.validation import from_plain

_OWN = {
    "consensus": "comm.consensus:Consensus",
    "maps": "comm.maps:Maps",
    "no_comm": "comm.no_comm:NoComm",
    "positional": "comm.positional:Positional",
}
_REGISTRY = Registry(CommModule, "emberlink.comm", "comm.name", _OWN)
known, find = _REGISTRY.known, _REGISTRY.find


def build(
    name: str, world: WildfireConfig, settings: Mapping[str, Any], num_envs: int = 1
) -> CommModule:
    """Returns a new communication module.

    It warns if the world limits the bytes of messages and the module does not heed the limit.

    Args:
        settings: the keys under `comm`, without `name`.

    Raises:
        UserError: the name or a setting is not known, or a value is out of range.
    """
    module, limit = find(name), world.radio.bandwidth
    if limit is not None and module.hears and not module.heeds_bandwidth:
        warnings.warn(
            f"env.radio.bandwidth={limit}: the messages of comm.name={name} are not limited",
            stacklevel=2,
        )
    return module(world, from_plain(module.config_type, settings, "comm"), num_envs)
