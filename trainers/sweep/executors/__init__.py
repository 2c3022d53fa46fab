"""Executors: they run the trainings of a sweep. Each is a file here and in configs/executor."""

from emberlink.trainers.sweep.executors.base import DIED, Executor, QueueFullError, Task
from emberlink.trainers.sweep.executors.registry import from_texts, known, make

__all__ = ["DIED", "Executor", "QueueFullError", "Task", "from_texts", "known", "make"]
