"""Compares runs and returns the numbers."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from emberlink.envs.utils.errors import UserError

from .groups import gather
from .rankings import Numbers, numbers
from .record import to_values
from .runs import LeftOut, read_all


@dataclass(frozen=True)
class Comparison:
    """The numbers of several runs.

    Attributes:
        sections: rankings, claims and training curves for each setup and fire trained on.
        left_out: folders and files that are no part of it, with the reason.
        notes: differences between runs that a reader should know of.
    """

    sections: list[Numbers]
    left_out: list[LeftOut]
    notes: list[str]

    def to_values(self) -> dict[str, Any]:
        """Returns everything as plain values, as in compare.json."""
        return to_values(self.sections, self.left_out, self.notes)


def compare(paths: Iterable[Path | str]) -> Comparison:
    """Compares the finished runs among folders; nothing is printed or written.

    Args:
        paths: run folders, folders that hold some, or names such as `pretrained:tuned`; or one of
            them.

    Raises:
        UserError: there is no finished run, runs of a section were evaluated on different fires,
            or a file is damaged.
    """
    runs, left_out = read_all([paths] if isinstance(paths, str | Path) else paths)
    if not runs:
        reasons = "; ".join(f"{path}: {why}" for path, why in left_out[:3])
        raise UserError(f"no finished run among {len(left_out)}: {reasons}")
    sections, notes = gather(runs)
    results = [numbers(section) for section in sections]
    notes += [note for result in results for note in result.notes]
    return Comparison(results, left_out, notes)
