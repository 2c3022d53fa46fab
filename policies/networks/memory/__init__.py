"""What a network remembers from decision to decision; one kind per file."""

from emberlink.policies.networks.memory.base import Memory
from emberlink.policies.networks.memory.registry import find, known

__all__ = ["Memory", "find", "known"]
