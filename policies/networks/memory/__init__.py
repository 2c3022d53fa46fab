"""Memories of networks, which carry information from one decision to the next; one per file."""

from emberlink.policies.networks.memory.base import Memory
from emberlink.policies.networks.memory.registry import find, known

__all__ = ["Memory", "find", "known"]
