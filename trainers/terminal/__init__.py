"""Prints to terminals, pipes and files: text, tables and the progress of a training."""

from .console import OutputError, SafeConsole
from .progress import TrainingProgress
from .table import Column, Row, Table, print_table

__all__ = [
    "Column",
    "OutputError",
    "Row",
    "SafeConsole",
    "Table",
    "TrainingProgress",
    "print_table",
]
