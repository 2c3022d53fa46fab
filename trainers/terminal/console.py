"""Defines a rich console that supports any encoding, width and text."""

import errno
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
_PLAIN = {
    **{"→": "->", "←": "<-", "↑": "^", "↓": "v", "…": "...", "±": "+/-", "\u00d7": "x"},
    **{"≥": ">=", "≤": "<=", "≈": "~", "°": " deg"},
    **dict.fromkeys("\u2212\u2013\u2014", "-"),  # minus sign and dashes
}


class OutputError(OSError):
    """Reports that standard output cannot be written, for example to a closed pipe or full disk."""


class SafeConsole(Console):
    """A console on standard output.

    Differences from rich's console:

    - Characters that the output's encoding lacks are replaced, so no print fails on them.
    - Control characters in the text, such as escape sequences in a file's name, are replaced.
    - Brackets and colons in the text are printed as they are.
    - A width of 0 (`COLUMNS=0`) is ignored.
    - A table that is wider than the output is printed in parts, see `print_table`.
    - An output that cannot be written to raises `OutputError`.
    """

    def __init__(self) -> None:
        environ = dict(os.environ)
        if environ.get("COLUMNS", "").isdigit() and int(environ["COLUMNS"]) == 0:
            del environ["COLUMNS"]
        output: Any = _StandardOutput()
        super().__init__(markup=False, emoji=False, highlight=False, file=output, _environ=environ)
        self._is_limited = self.is_terminal or environ.get("COLUMNS", "").isdigit()

    @property
    def line_width(self) -> int | None:
        """The width of a line in columns; None for a pipe or a file without `COLUMNS`."""
        return self.width if self._is_limited else None

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
        for segment in super().render(renderable, options):
            text, style, control = segment
            yield segment if control else Segment(text.translate(_NO_CONTROL), style)


class _StandardOutput:
    """Forwards to the current `sys.stdout` at each write; see `SafeConsole`."""

    def write(self, text: str) -> int:
        stream = _stdout()
        if stream is None:  # `>&-` in a shell
            raise OutputError(errno.EBADF, "it is closed", "standard output")
        try:
            return stream.write(_encodable(text, getattr(stream, "encoding", None) or "utf-8"))
        except OSError as error:
            raise _output_error(error) from None

    def flush(self) -> None:
        try:
            if (stream := _stdout()) is not None:
                stream.flush()
        except OSError as error:
            raise _output_error(error) from None

    def __getattr__(self, name: str) -> Any:
        return getattr(_stdout(), name)


def _stdout() -> Any:
    # While rich shows a progress bar, it replaces sys.stdout.
    return getattr(sys.stdout, "rich_proxied_file", sys.stdout)


def _output_error(error: OSError) -> OutputError:
    return OutputError(error.errno, error.strerror or str(error), "standard output")


def _encodable(text: str, encoding: str) -> str:
    """Replaces characters that cannot be encoded by similar ASCII or a question mark."""

    def fits(characters: str) -> bool:
        try:
            characters.encode(encoding)
        except UnicodeEncodeError:
            return False
        return True

    return text if fits(text) else "".join(c if fits(c) else _PLAIN.get(c, "?") for c in text)
