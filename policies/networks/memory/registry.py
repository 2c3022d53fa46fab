"""Finds memories by name: emberlink's own, and entry points of other packages."""

from emberlink.envs.utils.plugins import Registry
from emberlink.policies.networks.memory.base import Memory

_OWN = {
    "gru": "policies.networks.memory.gru:GRU",
    "none": "policies.networks.memory.none:NoMemory",
}
_REGISTRY = Registry(Memory, "emberlink.memory", "policy.memory", _OWN)
known, find = _REGISTRY.known, _REGISTRY.find
