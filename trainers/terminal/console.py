"""Defines the console of the command line and the style of its tables."""

import os
from collections.abc import Iterator
from functools import partial

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

plain_table = partial(
    Table,
    box=box.SIMPLE_HEAD,
    show_edge=False,
    pad_edge=False,
    title_justify="left",
    title_style="bold",
    caption_justify="left",
)
"""Returns a table without a frame."""


class SafeConsole(Console):
    """A console on standard output, without markup; lines of pipes are as long as the text.

    Control characters in names, such as escape sequences, are replaced.
    """

    def __init__(self) -> None:
        super().__init__(markup=False, emoji=False, highlight=False)
        if not self.is_terminal and "COLUMNS" not in os.environ:
            self.width = _WITHOUT_TERMINAL

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterator[Segment]:
        """Renders as rich does, with control characters in the text replaced."""
        for text, style, control in super().render(renderable, options):
            yield Segment(text if control else text.translate(_NO_CONTROL), style, control)
