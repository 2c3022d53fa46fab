"""Compares runs and writes the report."""

import os
import shlex
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from emberlink.envs.utils.errors import UserError
from emberlink.trainers.comparison import chapters
from emberlink.trainers.comparison.groups import gather
from emberlink.trainers.comparison.page import Report, html
from emberlink.trainers.comparison.rankings import Numbers, numbers
from emberlink.trainers.comparison.record import to_json, to_values
from emberlink.trainers.comparison.runs import LeftOut, read_all
from emberlink.trainers.terminal import OutputError


@dataclass(frozen=True)
class Comparison:
    """The results of a comparison.

    Attributes:
        paths: compared folders, as given.
        sections: rankings, verdicts and training curves for each setup and training fire.
        notes: differences between runs.
        left_out: folders and files that are not compared, with the reason.
    """

    paths: tuple[Path, ...]
    sections: tuple[Numbers, ...]
    notes: tuple[str, ...]
    left_out: tuple[LeftOut, ...]

    @property
    def command(self) -> str:
        """The command line of the comparison."""
        return shlex.join(["emberlink", "compare", *sorted(map(str, self.paths))])

    def to_values(self) -> dict[str, Any]:
        """Returns all results as plain values, the content of compare.json."""
        return to_values(self.command, self.sections, self.left_out, self.notes)


def compare_runs(paths: Sequence[Path]) -> Comparison:
    """Compares runs by setup, training fire and method.

    Args:
        paths: run folders, folders of run folders, or names such as `pretrained:tuned`.

    Raises:
        UserError: there is no finished run, runs of a section were evaluated on different fires,
            or a file is damaged.
    """
    runs, left_out = read_all(paths)
    if not runs:
        reasons = "".join(f"; {path}: {why}" for path, why in left_out[:1])
        raise UserError(f"no finished run among {len(left_out)}: nothing to compare{reasons}")
    sections, notes = gather(runs)
    results = [numbers(section) for section in sections]
    notes += [note for result in results for note in result.notes]
    return Comparison(tuple(paths), tuple(results), tuple(notes), tuple(left_out))


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
        raise UserError(f"--output {output}: cannot be written: {error.strerror}") from None
    if dangling:
        raise UserError(f"--output {output}: a link to a missing folder; name a new folder")
    if taken:
        raise UserError(f"--output {output}: exists and is not an empty folder; name a new one")
    return output


def write_report(
    comparison: Comparison, folder: Path, say: Callable[[str], None] = lambda _: None
) -> Comparison:
    """Writes compare.html, compare.json and the figures into a new or empty folder.

    Args:
        comparison: result of `compare_runs`.
        folder: result of `free_folder`; it is created when the report is complete.
        say: called with a line of text before each figure.

    Returns:
        The comparison, with a note for each method without a timelapse.

    Raises:
        UserError: the folder cannot be written.
    """
    notes = list(comparison.notes)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".compare-") as partial:
            path = Path(partial) / "report"
            path.mkdir()
            drawn = [
                chapters.draw(path, place, section, notes, say)
                for place, section in enumerate(comparison.sections, 1)
            ]
            whole = replace(comparison, notes=tuple(notes))
            page = html(Report(whole.command, drawn, whole.left_out, notes))
            (path / "compare.html").write_text(page, encoding="utf-8")
            (path / "compare.json").write_text(to_json(whole.to_values()), encoding="utf-8")
            path.replace(folder)
    except OutputError:
        raise
    except OSError as error:
        raise UserError(
            f"--output {folder}: cannot be written: {error.strerror or error}"
        ) from None
    return whole
