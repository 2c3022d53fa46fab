"""Collects transitions: steps the environments with the exploring policy."""

from .allocator import keep_freed_memory
from .collector import StepCollector
from .cuda_graphs import graphed

__all__ = ["StepCollector", "graphed", "keep_freed_memory"]
