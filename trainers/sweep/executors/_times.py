"""Reads times in the forms of sbatch."""

import re

from emberlink.envs.utils.errors import UserError

_TIME = re.compile(r"(?:(\d+)-)?(\d+)(?::(\d+))?(?::(\d+))?")


def minutes(text: int | str) -> int:
    """Returns the minutes of a time in one of the forms of sbatch, at least 1.

    Raises:
        UserError: it has another form.
    """
    found = _TIME.fullmatch(str(text))
    if not found:
        raise UserError("expected minutes, or H:MM:SS, or D-HH:MM:SS")
    days, first, second, third = found.groups()
    if days is not None:
        parts = [int(days) * 24 + int(first), int(second or 0), int(third or 0)]
    elif third is not None:
        parts = [int(first), int(second), int(third)]
    else:
        parts = [0, int(first), int(second or 0)]
    return max(parts[0] * 60 + parts[1] + (parts[2] > 0), 1)
