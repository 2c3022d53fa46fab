"""Finds memories by name: files of this folder, and entry points of other packages."""

from emberlink.envs.utils.plugins import Registry
from emberlink.policies.networks.memory.base import Memory

_REGISTRY = Registry(
    Memory, "emberlink.policies.networks.memory", "policy.memory", group="emberlink.memory"
)
known, find = _REGISTRY.known, _REGISTRY.find
