"""Prints to terminals, pipes and files: text, tables and the progress of a training."""

from .console import OutputError, SafeConsole
from .progress import TrainingProgress
from .table import print_table

__all__ = [
    "OutputError",
    "SafeConsole",
    "TrainingProgress",
    "print_table",
]
