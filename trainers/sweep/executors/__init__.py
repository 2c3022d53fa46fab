"""Runs the processes of a sweep: an executor is one file here and one in configs/executor."""

from emberlink.trainers.sweep.executors.base import Executor, Task
from emberlink.trainers.sweep.executors.registry import known, make

__all__ = ["Executor", "Task", "known", "make"]
