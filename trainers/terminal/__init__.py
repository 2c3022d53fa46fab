"""Prints text, tables, warnings and the progress of trainings to terminals, pipes and files."""

from typing import TYPE_CHECKING

from emberlink.envs.utils.lazy import lazy

if TYPE_CHECKING:
    from emberlink.trainers.terminal.console import OutputError, SafeConsole
    from emberlink.trainers.terminal.progress import TrainingProgress
    from emberlink.trainers.terminal.table import print_table

__all__ = [
    "OutputError",
    "SafeConsole",
    "TrainingProgress",
    "print_table",
]

__getattr__ = lazy(
    __name__,
    {
        "OutputError": "console",
        "SafeConsole": "console",
        "TrainingProgress": "progress",
        "print_table": "table",
    },
)
