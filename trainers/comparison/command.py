"""Runs `emberlink compare`: prints the tables of a comparison and writes the report."""

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from emberlink.trainers.comparison.bootstrap import FEW
from emberlink.trainers.comparison.rankings import Numbers, Ranking
from emberlink.trainers.comparison.report import free_folder, write_report
from emberlink.trainers.comparison.report.page import FLAG, counts, decision, lines, ratio, worth
from emberlink.trainers.comparison.results import compare_runs


def compare(paths: Sequence[Path], console: Console, output: Path | None = None) -> int:
    """Compares runs, prints the tables and writes the report.

    Args:
        paths: run folders, folders of run folders, or names such as `pretrained:tuned`.
        console: prints the tables.
        output: a new or empty folder; if None, `compare`, `compare_2` and so on.

    Returns:
        The exit status 0.

    Raises:
        UserError: the runs cannot be compared, or the folder is not empty or not writable.
    """
    folder = free_folder(output)
    comparison = compare_runs(paths)
    for path, why in comparison.left_out:
        console.print(Text(f"note: {path} is left out: {why}", style="yellow"), soft_wrap=True)
    comparison = write_report(
        comparison,
        folder,
        lambda text: console.print(Text(f"  {text}", style="dim"), soft_wrap=True),
    )
    for note in comparison.notes:
        console.print(Text(f"note: {note}", style="yellow"), soft_wrap=True)
    for numbers in comparison.sections:
        _print_section(console, numbers)
    console.print(Text(str(folder / "compare.html")), soft_wrap=True)
    return 0


def _print_section(console: Console, numbers: Numbers) -> None:
    """Prints a table of rankings for each fire, the value of communication and the claims."""
    for fire, rankings in numbers.fires.items():
        trained = ", the fire trained on" if fire == numbers.section.trained_on else ""
        table = _rankings_table(rankings, f"{numbers.section.label}: on {fire}{trained}")
        if min(counts(numbers)) < FEW:
            table.caption = (
                f"{table.caption}; {FLAG} fewer than {FEW} seeds are too few for an interval"
            )
        console.print(table)
    if numbers.communication:
        console.print(_communication_table(numbers))
    if numbers.verdicts:
        console.print(_claims_table(numbers))


def _claims_table(numbers: Numbers) -> Table:
    """Returns a table of the verdicts, with a section for each group of the claims' method."""
    table = Table(title=Text(f"{numbers.section.label}: the paper's claims"))
    for column in ("claim", "on", "ratio", "95 % interval", "verdict", "best other"):
        table.add_column(
            column, justify="right" if column in ("ratio", "95 % interval") else "left"
        )
    for method, verdicts in groupby(numbers.verdicts, lambda verdict: verdict.method):
        table.add_row(Text(method, style="bold"))
        for told in verdicts:
            cells = (told.claim, told.fire, *ratio(told), decision(told), told.best_other)
            table.add_row(*map(Text, cells))
    return table


def _communication_table(numbers: Numbers) -> Table:
    """Returns a table of the values of communication, with a section for each fire."""
    measure = numbers.communication[0].measure
    table = Table(
        title=Text(f"{numbers.section.label}: the value of communication, by {measure}"),
        caption="gain: with radio - off; value: gain / (no limits - off); intervals over the fires",
    )
    left, ends = ("policy", "radios"), "95 %\ninterval"
    for column in (*left, "off", "with\nradio", "no\nlimits", "gain", ends, "value", ends):
        table.add_column(column, justify="left" if column in left else "right")
    for fire, values in groupby(numbers.communication, lambda value: value.fire):
        table.add_row(Text(fire, style="bold"))
        for value in values:
            name = value.policy.replace("_", " ") if value.how == "scripted" else value.policy
            table.add_row(*map(Text, (name, value.how, *worth(value))))
    return table


def _rankings_table(rankings: Sequence[Ranking], title: str) -> Table:
    """Returns a table of rankings, with a section for each measure."""
    table = Table(title=Text(title), caption="↑ more is better, ↓ less is better")
    for column in ("policy", "seeds", "IQM", "95 % interval", "P(better than the next)"):
        table.add_column(column, justify="left" if column == "policy" else "right")
    for ranking in rankings:
        arrow = "↑" if ranking.higher_is_better else "↓"
        if ranking.not_ranked:
            arrow = ""
            why = f"{ranking.measure} is not ranked: {ranking.not_ranked}"
            table.caption = f"{table.caption}; {why}"
        table.add_section()
        table.add_row(Text(f"{ranking.measure} {arrow}", style="bold"))
        for line in lines(ranking):
            cells = (line.name, line.seeds, line.mean, line.interval, line.probability)
            table.add_row(*map(Text, cells), style="dim" if line.scripted else "")
    return table
