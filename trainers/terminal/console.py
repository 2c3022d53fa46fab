"""Defines the console of the command line and the style of its tables."""

import os
from copy import copy
from functools import partial
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

plain_table = partial(
    Table,
    box=box.SIMPLE_HEAD,
    show_edge=False,
    padding=0,
    title_justify="left",
    title_style="bold",
    caption_justify="left",
)
"""Returns a table without a frame."""


class PlainConsole(Console):
    """A console on standard output, without markup; lines of pipes are as long as the text.

    A table that is too wide is printed in parts, with the first column and some of the others.
    """

    def __init__(self) -> None:
        super().__init__(markup=False, emoji=False, highlight=False)
        if not self.is_terminal and "COLUMNS" not in os.environ:
            self.width = 1000  # columns of a pipe or a file

    def print(self, *objects: Any, **options: Any) -> None:
        tables = [part for item in objects if isinstance(item, Table) for part in self._parts(item)]
        for printed in [(table,) for table in tables] or [objects]:
            super().print(*printed, **options)

    def _parts(self, table: Table) -> list[Table]:
        """Splits a table that is too wide; words of a column, and its numbers, are not broken."""
        first, *others = table.columns
        for column in table.columns:
            cells = [str(cell) for cell in (column.header, *column.cells)]
            is_list = column is first and not table.show_header  # of names and texts
            column.no_wrap = is_list or column.justify == "right" or " " not in "".join(cells)
            words = (cell.split("\n" if column.no_wrap else None) for cell in cells)
            column.min_width = max((len(word) for cell in words for word in cell), default=0)
            column.overflow = "fold"
        wide, parts = self.options.update(width=10_000), [copy(table)]
        parts[0].columns = [first]
        for column in others:
            wider = copy(parts[-1])
            wider.columns = [*wider.columns, column]
            narrowest = self.measure(wider, options=wide).minimum
            if narrowest > self.width and len(parts[-1].columns) > 1:
                parts[-1].caption = wider.title = None
                wider.columns = [first, column]
                parts.append(wider)
            else:
                parts[-1] = wider
        for part in parts:  # rich may narrow a column below its words, and then cut another
            for column in part.columns:
                if self.measure(part, options=wide).maximum > self.width and not column.no_wrap:
                    column.max_width = column.min_width
        return parts
