"""Runs the processes of a sweep: an executor is one file here and one in configs/executor."""

from .base import Executor, Task
from .registry import known, make

__all__ = ["Executor", "Task", "known", "make"]
