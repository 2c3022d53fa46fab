"""Reads times in the forms of sbatch."""

import re

from emberlink.envs.utils.errors import UserError

_TIME = re.compile(r"(?:(\d+)-)?(\d+)(?::(\d+))?(?::(\d+))?")


def minutes(text: str) -> int:
    """Returns the minutes of a time in one of the forms of sbatch, at least 1.

    Raises:
        UserError: it has another form, or is 0, which SLURM reads as no limit.
    """
    found = _TIME.fullmatch(text)
    if not found or not any(int(part or 0) for part in found.groups()):
        raise UserError("expected minutes, or H:MM:SS, or D-HH:MM:SS")
    days, first, second, third = found.groups()
    if days is not None:
        parts = [int(days) * 24 + int(first), int(second or 0), int(third or 0)]
    elif third is not None:
        parts = [int(first), int(second), int(third)]
    else:
        parts = [0, int(first), int(second or 0)]
    return parts[0] * 60 + parts[1] + (parts[2] > 0)
