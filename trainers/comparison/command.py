"""Runs `emberlink compare`: prints the tables of a comparison and writes the report."""

from collections.abc import Collection, Sequence
from pathlib import Path

from rich import table as rich_table
from rich.console import Console
from rich.text import Text

from emberlink.trainers.comparison.page import NUMBERS, Table, tables
from emberlink.trainers.comparison.report import free_folder, write_report
from emberlink.trainers.comparison.results import compare_runs


def compare(
    paths: Sequence[Path],
    console: Console,
    output: Path | None = None,
    labels: Sequence[str] = (),
    extras: Collection[str] = (),
) -> int:
    """Compares runs, prints the tables and writes the report.

    Args:
        paths: run folders, folders of run folders, or names such as `pretrained:tuned`.
        console: prints the tables.
        output: a new or empty folder; if None, `compare`, `compare_2` and so on.
        labels: a name for the runs of each path, in place of their method.
        extras: see `write_report`.

    Returns:
        The exit status 0.

    Raises:
        UserError: there is no run to compare, or the folder is not empty or not writable.
    """
    folder = free_folder(output)
    comparison = compare_runs(paths, labels)

    def say(text: str, style: str = "yellow") -> None:
        console.print(Text(text, style=style), soft_wrap=True)

    for path, why in comparison.left_out:
        say(f"note: {path} is left out: {why}")
    write_report(comparison, folder, lambda text: say(f"  {text}", "dim"), extras)
    for note in comparison.notes:
        say(f"note: {note}")
    for section in comparison.sections:
        for table in tables(comparison, section):
            console.print(_printed(table, section))
    say(str(folder / "compare.html"), "")
    return 0


def _printed(table: Table, section: str) -> rich_table.Table:
    printed = rich_table.Table(title=Text(f"{section}: {table.title}"), caption=table.caption)
    for column in table.columns:
        printed.add_column(column, justify="right" if column in NUMBERS else "left")
    for heading, rows in table.groups:
        printed.add_section()
        printed.add_row(Text(heading, style="bold"))
        for cells, scripted in rows:
            printed.add_row(*map(Text, cells), style="dim" if scripted else "")
    return printed
