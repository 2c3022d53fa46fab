"""Scripted policies: baselines that learned policies are compared with."""

from emberlink.policies.scripted.base import Scripted
from emberlink.policies.scripted.registry import SCRIPTED

__all__ = ["SCRIPTED", "Scripted"]
