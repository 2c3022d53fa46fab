"""Defines the console of the command line."""

import os
import sys
from collections.abc import Iterator
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.table import Table

from emberlink.trainers.terminal.table import print_table

_CONTROL_CODES = (
    *(code for code in range(0x20) if chr(code) not in "\t\n"),
    *range(0x7F, 0xA0),
    *range(0x202A, 0x202F),  # these and the next change the direction of text
    *range(0x2066, 0x206A),
)
_NO_CONTROL = dict.fromkeys(_CONTROL_CODES, "?")
_WITHOUT_TERMINAL = 1000
"""columns of a pipe or a file"""


class OutputError(OSError):
    """Reports that standard output cannot be written, for example to a closed pipe or full disk."""


class SafeConsole(Console):
    """A console on standard output.

    Differences from rich's console: control characters in names, such as escape sequences, are
    replaced, as are characters that the encoding lacks; tables have the style of `print_table`;
    lines of pipes and files are as long as the text; an output that cannot be written to raises
    `OutputError`.
    """

    def __init__(self) -> None:
        output: Any = _Output()
        super().__init__(markup=False, emoji=False, highlight=False, file=output)
        if not self.is_terminal and not os.environ.get("COLUMNS", "").isdigit():
            self.width = _WITHOUT_TERMINAL
        elif self.width < 1:  # COLUMNS=0
            self.width = 80

    def print(self, *objects: Any, **options: Any) -> None:
        """Prints as rich does, but tables with `print_table`."""
        if len(objects) == 1 and isinstance(objects[0], Table):
            print_table(self, objects[0])
        else:
            super().print(*objects, **options)

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterator[Segment]:
        """Renders as rich does, with control characters in the text replaced."""
        for text, style, control in super().render(renderable, options):
            yield Segment(text if control else text.translate(_NO_CONTROL), style, control)


class _Output:
    """Forwards to the current `sys.stdout`."""

    def write(self, text: str) -> int:
        try:
            encoding = sys.stdout.encoding or "utf-8"
            return sys.stdout.write(text.encode(encoding, "replace").decode(encoding))
        except OSError as error:
            raise _named(error) from None

    def flush(self) -> None:
        try:
            sys.stdout.flush()
        except OSError as error:
            raise _named(error) from None

    def __getattr__(self, name: str) -> Any:
        return getattr(sys.stdout, name)


def _named(error: OSError) -> OutputError:
    return OutputError(error.errno, error.strerror or str(error), "standard output")
