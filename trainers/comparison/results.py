"""Compares runs and holds the results."""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from emberlink.envs.utils.errors import UserError
from emberlink.trainers.comparison.groups import gather
from emberlink.trainers.comparison.rankings import Numbers, numbers
from emberlink.trainers.comparison.record import to_values
from emberlink.trainers.comparison.runs import LeftOut, read_all


@dataclass(frozen=True)
class Comparison:
    """The results of a comparison.

    Attributes:
        paths: compared folders, as given.
        sections: rankings, verdicts and training curves for each setup, world and training fire.
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
    """Compares runs by setup, world, training fire and method.

    Args:
        paths: run folders, folders of run folders, or names such as `pretrained:tuned`.

    Raises:
        UserError: there is no finished run, runs of a section were evaluated on different fires,
            or a file is damaged.
    """
    if not paths:
        raise UserError("nothing to compare: expected at least one run folder")
    runs, left_out = read_all(paths)
    if not runs:
        reasons = "".join(f"; {path}: {why}" for path, why in left_out[:1])
        raise UserError(f"no finished run among {len(left_out)}: nothing to compare{reasons}")
    sections, notes = gather(runs)
    results = [numbers(section) for section in sections]
    notes += [note for result in results for note in result.notes]
    return Comparison(tuple(paths), tuple(results), tuple(notes), tuple(left_out))
