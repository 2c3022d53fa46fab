"""Policies that learn nothing, to which learned ones are compared."""

from emberlink.policies.scripted.base import Scripted
from emberlink.policies.scripted.registry import SCRIPTED

__all__ = ["SCRIPTED", "Scripted"]
