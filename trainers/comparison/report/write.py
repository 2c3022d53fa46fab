"""Writes compare.html, compare.json, the figures and the replays of a comparison."""

import errno
import os
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from urllib.parse import quote

from emberlink.envs.utils.errors import UserError
from emberlink.trainers.comparison.record import to_json
from emberlink.trainers.comparison.report import chapters
from emberlink.trainers.comparison.report.page import Report, html
from emberlink.trainers.comparison.results import Comparison
from emberlink.trainers.terminal.console import OutputError


def free_folder(output: Path | None) -> Path:
    """Returns a folder for a report: `output`, or the first free of `compare`, `compare_2`, ...

    Raises:
        UserError: `output` is a file, a dangling link, or not empty.
    """
    if output is None:
        tried = (Path("compare" if i == 1 else f"compare_{i}") for i in range(1, 10_000))
        return next(path for path in tried if not os.path.lexists(path))
    try:
        dangling = output.is_symlink() and not output.exists()
        taken = output.exists() and (not output.is_dir() or any(output.iterdir()))
    except OSError as error:
        raise UserError(f"output {output}: cannot be written: {error.strerror}") from None
    if dangling:
        raise UserError(f"output {output}: a link to a missing folder; name a new folder")
    if taken:
        raise UserError(f"output {output}: exists and is not an empty folder; name a new one")
    return output


def _replays(comparison: Comparison, folder: Path) -> dict[Path, str]:
    """Returns the address of each run's replay, relative to the folder of the report."""
    runs = (run for numbers in comparison.sections for run in numbers.section.runs)
    pages = {run.path: run.path / "figures" / "replay.html" for run in runs}
    return {
        path: quote(os.fsencode(os.path.relpath(page.resolve(), folder.resolve())))
        for path, page in pages.items()
        if page.is_file()
    }


def _move(made: Path, folder: Path, *, fill: bool) -> None:
    """Moves a folder to a new place, or its content into the empty folder that it is made in.

    Raises:
        FileExistsError: there is something else in that place by now.
    """
    if len(list(folder.iterdir())) > 1 if fill else os.path.lexists(folder):
        raise FileExistsError(errno.EEXIST, "there is something by now", str(folder))
    if fill:  # a link, the working folder and a mount point stay what they are
        for part in made.iterdir():
            part.rename(folder / part.name)
    else:
        made.rename(folder)


def write_report(
    comparison: Comparison, folder: Path, say: Callable[[str], None] = lambda _: None
) -> Comparison:
    """Writes compare.html, compare.json, figures and replays into a new or empty folder.

    Args:
        comparison: result of `compare_runs`.
        folder: result of `free_folder`; it is created, or filled, when the report is complete.
        say: called with a line of text before each figure.

    Returns:
        The comparison, with a note for each method without a timelapse.

    Raises:
        UserError: the folder cannot be written.
    """
    notes = list(comparison.notes)
    try:
        fill = folder.is_dir()
        beside = folder if fill else folder.parent
        beside.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=beside, prefix=".compare-") as partial:
            path = Path(partial) / "report"
            path.mkdir()
            drawn = [
                chapters.draw(path, place, section, notes, say)
                for place, section in enumerate(comparison.sections, 1)
            ]
            whole = replace(comparison, notes=tuple(notes))
            replays = _replays(comparison, folder)
            page = html(Report(whole.command, drawn, whole.left_out, notes, replays))
            numbers = to_json(whole.to_values())
            for name, text in ("compare.html", page), ("compare.json", numbers):
                # Names of folders may hold bytes that are no characters.
                (path / name).write_text(text, encoding="utf-8", errors="backslashreplace")
            _move(path, folder, fill=fill)
    except OutputError:
        raise
    except OSError as error:
        raise UserError(f"output {folder}: cannot be written: {error.strerror or error}") from None
    return whole
