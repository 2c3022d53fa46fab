"""The command `emberlink compare`: prints a comparison and writes its report."""

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from .bootstrap import FEW
from .page import FLAG, counts, decision, lines, ratio
from .rankings import Numbers
from .report import compare_runs, free_folder, write_report


def compare(paths: Sequence[Path], console: Console, output: Path | None = None) -> int:
    """Compares runs by setup and method, prints the tables, and leaves a folder with the report.

    Args:
        paths: run folders, or folders that hold some.
        console: gets the tables.
        output: a new or empty folder; `compare`, or `compare_2`, ... if left out.

    Raises:
        UserError: there is nothing to compare, the runs can't be compared, a file is damaged, or
            the folder holds something.
    """
    folder = free_folder(output)
    comparison = compare_runs(paths)
    for path, why in comparison.left_out:
        console.print(Text(f"note: {path} is left out: {why}", style="yellow"))
    comparison = write_report(
        comparison, folder, lambda text: console.print(Text(f"  {text}", style="dim"))
    )
    for note in comparison.notes:
        console.print(Text(f"note: {note}", style="yellow"))
    for one in comparison.sections:
        _print(console, one)
    console.print(Text(str(folder / "compare.html")), soft_wrap=True)
    return 0


def _print(console: Console, one: Numbers) -> None:
    for fire, rankings in one.fires.items():
        trained = ", the fire trained on" if fire == one.section.trained_on else ""
        title = f"{one.section.label}: on {fire}{trained}"
        caption = "↑ more is better, ↓ less is better"
        if min(counts(one)) < FEW:
            caption += f"; {FLAG} fewer than {FEW} seeds are too few for an interval"
        table = Table(title=Text(title), caption=caption)
        for column in ("policy", "seeds", "IQM", "95 % interval", "P(better than the next)"):
            table.add_column(column, justify="left" if column == "policy" else "right")
        for ranking in rankings:
            table.add_section()
            arrow = "↑" if ranking.higher_is_better else "↓"
            table.add_row(Text(f"{ranking.measure} {arrow}", style="bold"))
            for line in lines(ranking):
                cells = (line.name, line.seeds, line.mean, line.interval, line.improvement)
                table.add_row(*map(Text, cells), style="dim" if line.scripted else "")
        console.print(table)
    if one.verdicts:
        table = Table(title=Text(f"{one.section.label}: the paper's claims"))
        for column in ("on", "claim", "best other", "ratio", "95 % interval", "verdict"):
            table.add_column(column)
        for verdict in one.verdicts:
            about = f"{verdict.method}: {verdict.claim}"
            cells = (verdict.fire, about, verdict.best_other, *ratio(verdict), decision(verdict))
            table.add_row(*map(Text, cells))
        console.print(table)
