"""Defines the console of the command line, and how it prints tables."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from copy import copy
from typing import Any

from rich import box
from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.table import Table

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
        encoding = sys.stdout.encoding or "utf-8"
        with _named():
            return sys.stdout.write(text.encode(encoding, "replace").decode(encoding))

    def flush(self) -> None:
        with _named():
            sys.stdout.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(sys.stdout, name)


@contextmanager
def _named() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OutputError(error.errno, error.strerror or str(error), "standard output") from None


def print_table(console: Console, table: Table) -> None:
    """Prints a table; if it is too wide, in parts with the first column and some of the others.

    Numbers and the words of the first column are never broken.
    """
    title, caption = table.title, table.caption
    table.box, table.show_edge, table.padding = box.SIMPLE_HEAD, False, 0
    table.title = table.caption = None
    first, *others = table.columns
    words = [word for cell in (first.header, *first.cells) for word in str(cell).split()]
    first.min_width = max(map(len, words), default=0)
    first.no_wrap = not table.show_header  # a list of names and texts
    for column in others:
        column.no_wrap = column.justify == "right"
        column.overflow = "fold"
    if title:
        console.print(title, style="bold")
    part, unlimited = copy(table), console.options.update(width=10_000)
    part.columns = [first]
    for column in others:
        wider = copy(table)
        wider.columns = [*part.columns, column]
        too_wide = console.measure(wider, options=unlimited).minimum > console.width
        if too_wide and len(part.columns) > 1:
            Console.print(console, part)  # that of SafeConsole calls this function
            wider.columns = [first, column]
        part = wider
    Console.print(console, part)
    if caption:
        console.print(caption, style="dim")
