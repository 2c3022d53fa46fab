"""Prints tables without cutting cells, at any width."""

import re
from collections.abc import Iterator, Sequence
from itertools import zip_longest
from typing import Any

from rich.cells import cell_len
from rich.console import Console
from rich.table import Table
from rich.text import Text


def print_table(console: Console, table: Table) -> None:
    """Prints a table completely.

    If the table is too wide for the console, the first column is wrapped. If it still is, it is
    printed in parts, each with the first column and as many other columns as fit.
    Pipes and files have no width, so the table has one part.

    Args:
        console: a `SafeConsole`, or another console.
        table: the table. The first column holds the row names; a row whose other cells are empty is
            a heading. Boxes, padding and column widths are ignored.
    """
    width = getattr(console, "line_width", console.width)
    columns = [_texts(table, place) for place in range(len(table.columns))]
    sizes = [max(map(cell_len, texts)) for texts in columns]
    if width is not None:
        sizes[0] = _label_size(columns[0], width - sum(sizes[1:]) - len(sizes) + 1, width)
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
    """Yields the cells and the style of each row; a heading has one cell."""
    columns = [list(column.cells) for column in table.columns]
    for row, *cells in zip(table.rows, *columns, strict=True):
        texts = [_plain(cell).replace("\n", ", ") for cell in cells]
        first = cells[0].style if isinstance(cells[0], Text) else ""
        yield texts if any(texts[1:]) else texts[:1], str(row.style or first)


def _texts(table: Table, place: int) -> list[str]:
    """Returns the header lines and the cells of a column."""
    cells = [cells[place] for cells, _ in _rows(table) if len(cells) == len(table.columns)]
    return [*_plain(table.columns[place].header).split("\n"), *cells]


def _label_size(labels: Sequence[str], room: int, width: int) -> int:
    """Returns the width of the first column: that of its labels, or less if they wrap.

    Args:
        labels: texts of the column.
        room: width that the other columns leave. If no wrapping fits in it, the table has parts.
        width: width of the console.
    """
    longest = max(map(cell_len, labels))
    words = [_indent(label) + word.rstrip() for label in labels for word in _words(label)]
    least = max(map(cell_len, words))
    return min(longest, max(least, room if least <= room else width // 3))


def _words(label: str) -> list[str]:
    """Splits a label after each space, or a name without spaces after each underscore."""
    end = " " if " " in label else "_"
    return re.findall(f"[^{end}]*{end}+|[^{end}]+", label) or [""]


def _indent(label: str) -> str:
    """Returns the beginning of the second line of a label."""
    return "  " if " " in label else ""


def _wrapped(label: str, size: int) -> list[str]:
    """Wraps a label to lines of a width."""
    lines = [""]
    for word in _words(label):
        if lines[-1].strip() and cell_len(lines[-1] + word.rstrip()) > size:
            lines.append(_indent(label))
        lines[-1] += word
    return lines


def _parts(sizes: Sequence[int], width: int | None) -> list[list[int]]:
    """Returns the columns of each part: the first column and as many others as fit."""
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
    """Yields the lines of a part of the table, each with its style."""
    aligned = [table.columns[place].justify == "right" for place in places]
    chosen = [sizes[place] for place in places]
    headers = [_plain(table.columns[place].header).split("\n") for place in places]
    if any(map(any, headers)):
        # Headers with fewer lines are aligned at the bottom.
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
    """Joins cells, each padded to its width."""
    padded: list[str] = []
    for cell, right, size in zip(cells, aligned, sizes, strict=True):
        space = " " * (size - cell_len(cell))
        padded.append(space + cell if right else cell + space)
    return " ".join(padded)
