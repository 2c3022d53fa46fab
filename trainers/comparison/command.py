"""`emberlink compare`: prints the tables of a comparison and leaves a folder with the report."""

import shlex
import tempfile
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from emberlink.envs.utils.errors import UserError

from . import chapters, report
from .bootstrap import FEW
from .page import FLAG, Report, counts, decision, html, lines, ratio
from .rankings import Numbers, Ranking
from .record import to_json


def compare(paths: Sequence[Path], console: Console, output: Path | None = None) -> int:
    """Compares runs, prints the tables and writes the report.

    Args:
        paths: run folders, folders that hold some, or names such as `pretrained:tuned`.
        console: shows the tables.
        output: a new or empty folder; `compare`, or `compare_2`, ... if None.

    Returns:
        0, the exit status.

    Raises:
        UserError: as `report.compare`; or the folder is not empty or cannot be written.
    """
    try:
        folder = _new_folder(output)
        comparison = report.compare(paths)
        for path, why in comparison.left_out:
            console.print(Text(f"note: {path} is left out: {why}", style="yellow"))
        command = shlex.join(["emberlink", "compare", *sorted(map(str, paths))])
        _write(folder, comparison, command, console)
    except OSError as error:
        place = "" if output is None else f"--output {output}: "
        raise UserError(f"{place}cannot be written: {error.strerror or error}") from None
    for note in comparison.notes:
        console.print(Text(f"note: {note}", style="yellow"))
    for numbers in comparison.sections:
        _print(console, numbers)
    console.print(Text(str(folder / "compare.html")), soft_wrap=True)
    return 0


def _new_folder(output: Path | None) -> Path:
    """Returns a folder that is empty or not there yet."""
    if output is None:
        tried = (Path("compare" if i == 1 else f"compare_{i}") for i in range(1, 10_000))
        return next(path for path in tried if not path.exists())
    if output.is_symlink() and not output.exists():
        raise UserError(f"--output {output}: a link to what is not there; name a new folder")
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise UserError(f"--output {output}: is there and not an empty folder; name a new one")
    return output


def _write(folder: Path, comparison: report.Comparison, command: str, console: Console) -> None:
    """Writes the report to a folder that gets its name when it is complete."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".compare-") as partial:
        path = Path(partial) / "report"
        path.mkdir()
        drawn = [
            chapters.draw(path, place, numbers, comparison.notes, console)
            for place, numbers in enumerate(comparison.sections, 1)
        ]
        page = html(Report(command, drawn, comparison.left_out, comparison.notes))
        (path / "compare.html").write_text(page, encoding="utf-8")
        values = {"command": command, **comparison.to_values()}
        (path / "compare.json").write_text(to_json(values), encoding="utf-8")
        path.replace(folder)


def _print(console: Console, numbers: Numbers) -> None:
    """Prints a table for each fire, then the claims."""
    for fire, rankings in numbers.fires.items():
        trained = ", the fire trained on" if fire == numbers.section.trained_on else ""
        table = _rankings_table(rankings, f"{numbers.section.label}: on {fire}{trained}")
        if min(counts(numbers)) < FEW:
            table.caption = (
                f"{table.caption}; {FLAG} fewer than {FEW} seeds are too few for an interval"
            )
        console.print(table)
    if numbers.verdicts:
        table = Table(title=Text(f"{numbers.section.label}: the paper's claims"))
        for column in ("on", "claim", "best other", "ratio", "95 % interval", "verdict"):
            table.add_column(column)
        for verdict in numbers.verdicts:
            claim = f"{verdict.method}: {verdict.claim}"
            cells = (verdict.fire, claim, verdict.best_other, *ratio(verdict), decision(verdict))
            table.add_row(*map(Text, cells))
        console.print(table)


def _rankings_table(rankings: Sequence[Ranking], title: str) -> Table:
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
