"""Executors: they run the trainings of a sweep. Each is a file here and in configs/executor."""

from emberlink.trainers.sweep.executors.base import DIED, Executor, QueueFullError, Task
from emberlink.trainers.sweep.executors.registry import known, make

__all__ = ["DIED", "Executor", "QueueFullError", "Task", "known", "make"]
