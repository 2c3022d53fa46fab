"""Policies that learn nothing, to which learned ones are compared."""

from .base import Scripted
from .registry import SCRIPTED

__all__ = ["SCRIPTED", "Scripted"]
