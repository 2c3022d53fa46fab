"""Collects transitions: steps the environments with the exploring policy."""

from .allocator import keep_freed_memory
from .collector import make_collector
from .cuda_graphs import graphed

__all__ = ["graphed", "keep_freed_memory", "make_collector"]
