"""Tables that show every cell whole, at any width."""

import re
from collections.abc import Iterator, Sequence
from itertools import zip_longest
from typing import Any

from rich.cells import cell_len
from rich.console import Console
from rich.table import Table
from rich.text import Text


def print_table(console: Console, table: Table) -> None:
    """Prints a table.

    Where it is wider than the console, names of rows such as random_waypoints are put on two lines.
    If that is not enough, it is printed in parts, one below the other: each has the first column
    and as many of the others as fit. Nothing is cut or left out. Pipes and files have no width, so
    that the table is in one part there.

    Args:
        console: a `SafeConsole`, or any other, whose width then counts.
        table: the table. The first column names the rows; a row whose other cells are empty is a
            heading. Boxes, paddings and widths are not used.
    """
    width = getattr(console, "line_width", console.width)
    columns = [_texts(table, place) for place in range(len(table.columns))]
    sizes = [max(map(cell_len, texts)) for texts in columns]
    if width is not None:
        sizes[0] = _label_size(columns[0], width - sum(sizes[1:]) - len(sizes) + 1)
    parts = _parts(sizes, width)
    for number, places in enumerate(parts, 1):
        part = f" (part {number} of {len(parts)})" if len(parts) > 1 else ""
        if table.title:
            console.print(Text(_plain(table.title) + part, "bold"), soft_wrap=width is None)
        for line, style in _lines(table, sizes, places):
            console.print(Text(line.rstrip(), style), soft_wrap=True)
    if table.caption:
        console.print(Text(_plain(table.caption), "dim"), soft_wrap=width is None)
    console.print()


def _plain(text: Any) -> str:
    return text.plain if isinstance(text, Text) else str(text)


def _rows(table: Table) -> Iterator[tuple[list[str], str]]:
    """Yields the cells of each row, and its style; a row of one text is one cell."""
    columns = [list(column.cells) for column in table.columns]
    for row, *cells in zip(table.rows, *columns, strict=True):
        texts = [_plain(cell).replace("\n", ", ") for cell in cells]
        first = cells[0].style if isinstance(cells[0], Text) else ""
        yield texts if any(texts[1:]) else texts[:1], str(row.style or first)


def _texts(table: Table, place: int) -> list[str]:
    """Returns the lines of a column's header, and its cells."""
    cells = [cells[place] for cells, _ in _rows(table) if len(cells) == len(table.columns)]
    return [*_plain(table.columns[place].header).split("\n"), *cells]


def _label_size(labels: Sequence[str], room: int) -> int:
    """Returns the size of the first column: that of its labels, or `room` if they fit on lines."""
    longest = max(map(cell_len, labels))
    words = max(cell_len(word) for label in labels for word in _words(label))
    return room if words <= room < longest else longest


def _words(label: str) -> list[str]:
    """Splits a name after each underscore; labels of several words are left whole."""
    return [label] if " " in label else re.findall(r"[^_]*_+|[^_]+", label) or [""]


def _wrapped(label: str, size: int) -> list[str]:
    """Splits a label into lines of a size."""
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
    aligned = [table.columns[place].justify == "right" for place in places]
    chosen = [sizes[place] for place in places]
    headers = [_plain(table.columns[place].header).split("\n") for place in places]
    if any(map(any, headers)):
        # Headers of fewer lines stand at the bottom.
        lines = zip_longest(*(reversed(header) for header in headers), fillvalue="")
        for line in reversed(list(lines)):
            yield _line(line, aligned, chosen), "bold"
        yield "-" * (sum(chosen) + len(chosen) - 1), ""
    for cells, style in _rows(table):
        if len(cells) < len(table.columns):
            yield cells[0], style
            continue
        label, *more = _wrapped(cells[0], sizes[0])
        yield _line([label, *(cells[place] for place in places[1:])], aligned, chosen), style
        for rest in more:
            yield rest, style


def _line(cells: Sequence[str], aligned: Sequence[bool], sizes: Sequence[int]) -> str:
    """Joins cells, each filled up to its size, at the left where it is aligned to the right."""
    padded: list[str] = []
    for cell, right, size in zip(cells, aligned, sizes, strict=True):
        space = " " * (size - cell_len(cell))
        padded.append(space + cell if right else cell + space)
    return " ".join(padded)
