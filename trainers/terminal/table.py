"""Prints rich's tables in one style, and in parts if they are too wide."""

from copy import copy
from math import ceil

from rich import box
from rich.cells import cell_len
from rich.console import Console
from rich.table import Column, Table


def print_table(console: Console, table: Table) -> None:
    """Prints a table; if it is too wide, in parts with the first column and some of the others.

    Numbers and the words of the first column are never broken.
    """
    title, caption = table.title, table.caption
    table.box, table.show_edge, table.padding = box.SIMPLE_HEAD, False, 0
    table.title = table.caption = None
    first, *others = table.columns
    words = [word for cell in (first.header, *first.cells) for word in str(cell).split()]
    first.min_width = max(map(cell_len, words), default=0)
    first.no_wrap = not table.show_header  # a list of names and texts
    for column in others:
        column.no_wrap = column.justify == "right"
        column.overflow = "fold"
    parts = [table]
    for count in range(1, len(others) + 1):
        parts = _parts(table, ceil(len(others) / count))
        if not any(_is_too_wide(console, part) for part in parts):
            break
    for number, part in enumerate(parts, 1):
        if title:
            of = f" (part {number} of {len(parts)})" if len(parts) > 1 else ""
            console.print(f"{title}{of}", style="bold")
        Console.print(console, part)  # that of SafeConsole calls this function
    if caption:
        console.print(caption, style="dim")


def _parts(table: Table, size: int) -> list[Table]:
    """Returns tables with the first column and `size` of the others."""
    first, *others = table.columns
    return [
        _with_columns(table, [first, *others[start : start + size]])
        for start in range(0, len(others), size)
    ]


def _with_columns(table: Table, columns: list[Column]) -> Table:
    part = copy(table)
    part.columns = columns
    return part


def _is_too_wide(console: Console, table: Table) -> bool:
    options = console.options.update(width=10_000)
    return console.measure(table, options=options).minimum > console.width
