"""Tables that show every cell whole, at any width."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import zip_longest

from rich.cells import cell_len
from rich.console import Console
from rich.text import Text


@dataclass(frozen=True)
class Column:
    """A column of a table."""

    title: str
    """may have several lines"""
    right: bool = True
    """whether cells are aligned to the right"""


@dataclass(frozen=True)
class Row:
    """A row of a table; a row with fewer cells than columns is a heading."""

    cells: Sequence[str]
    style: str = ""


@dataclass
class Table:
    """A table whose first column names the rows."""

    title: str
    columns: Sequence[Column]
    rows: list[Row] = field(default_factory=list)
    caption: str = ""


def print_table(console: Console, table: Table) -> None:
    """Prints a table.

    Where it is wider than the console, names of rows are put on two lines; if it is still too wide,
    it is printed in parts, one below the other: each has the first column and as many of the others
    as fit. Nothing is cut or left out. Pipes and files have no width, so that the table is in one
    part there.

    Args:
        console: a `SafeConsole`, or any other, whose width then counts.
        table: the table.
    """
    width = getattr(console, "line_width", console.width)
    columns = [_cells(table, place) for place in range(len(table.columns))]
    sizes = [max(map(cell_len, lines)) for lines in columns]
    if width is not None:
        sizes[0] = _label_size(columns[0], width - sum(sizes[1:]) - len(sizes) + 1)
    parts = _parts(sizes, width)
    for number, places in enumerate(parts, 1):
        part = f" (part {number} of {len(parts)})" if len(parts) > 1 else ""
        console.print(Text(table.title + part, "bold"), soft_wrap=width is None)
        for line, style in _lines(table, sizes, places):
            console.print(Text(line.rstrip(), style), soft_wrap=True)
    if table.caption:
        console.print(Text(table.caption, "dim"), soft_wrap=width is None)
    console.print()


def _cells(table: Table, place: int) -> list[str]:
    """Returns the lines of a column's title, and its cells."""
    cells = [row.cells[place] for row in table.rows if len(row.cells) == len(table.columns)]
    return [*table.columns[place].title.split("\n"), *cells]


def _label_size(labels: Sequence[str], room: int) -> int:
    """Returns the size of the first column: that of its labels, or `room` if they fit on lines."""
    longest = max(map(cell_len, labels))
    words = max(cell_len(word) for label in labels for word in _words(label))
    return room if words <= room < longest else longest


def _words(label: str) -> list[str]:
    """Splits a label after each underscore and space."""
    return re.findall(r"[^_ ]*[_ ]+|[^_ ]+", label) or [""]


def _wrapped(label: str, size: int) -> list[str]:
    """Splits a label into lines of a size, between words."""
    lines = [""]
    for word in _words(label):
        if lines[-1] and cell_len(lines[-1] + word.rstrip()) > size:
            lines.append("")
        lines[-1] += word
    return lines


def _parts(sizes: Sequence[int], width: int | None) -> list[list[int]]:
    """Returns which columns are side by side: the first one, and others as long as they fit."""
    parts = [[0]]
    used = sizes[0]
    for place, size in enumerate(sizes[1:], 1):
        if width is not None and len(parts[-1]) > 1 and used + 1 + size > width:
            parts.append([0])
            used = sizes[0]
        parts[-1].append(place)
        used += 1 + size
    return parts


def _lines(table: Table, sizes: Sequence[int], places: Sequence[int]) -> Iterator[tuple[str, str]]:
    """Yields the lines of some columns, each with its style."""
    columns = [table.columns[place] for place in places]
    chosen = [sizes[place] for place in places]
    titles = [column.title.split("\n") for column in columns]
    # Titles of fewer lines stand at the bottom of the head.
    for line in reversed(list(zip_longest(*(reversed(title) for title in titles), fillvalue=""))):
        yield _line(line, columns, chosen), "bold"
    yield "-" * (sum(chosen) + len(chosen) - 1), ""
    for row in table.rows:
        if len(row.cells) < len(table.columns):
            yield " ".join(row.cells), row.style
            continue
        label, *more = _wrapped(row.cells[0], sizes[0])
        yield (
            _line([label, *(row.cells[place] for place in places[1:])], columns, chosen),
            row.style,
        )
        for rest in more:
            yield rest, row.style


def _line(cells: Sequence[str], columns: Sequence[Column], sizes: Sequence[int]) -> str:
    padded: list[str] = []
    for cell, column, size in zip(cells, columns, sizes, strict=True):
        space = " " * (size - cell_len(cell))
        padded.append(space + cell if column.right else cell + space)
    return " ".join(padded)
