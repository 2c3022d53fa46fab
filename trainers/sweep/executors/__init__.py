"""Executors: they run the trainings of a sweep. Each is a file here and in configs/executor."""

from emberlink.trainers.sweep.executors.base import Executor, Task
from emberlink.trainers.sweep.executors.registry import known, make

__all__ = ["Executor", "Task", "known", "make"]
