"""Prints text, tables and the progress of trainings to terminals, pipes and files."""

from emberlink.trainers.terminal.console import OutputError, SafeConsole
from emberlink.trainers.terminal.progress import TrainingProgress
from emberlink.trainers.terminal.table import print_table

__all__ = [
    "OutputError",
    "SafeConsole",
    "TrainingProgress",
    "print_table",
]
