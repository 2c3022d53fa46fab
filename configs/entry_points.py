"""Reads the entry points of installed packages."""

import sys
from functools import lru_cache
from importlib.metadata import EntryPoint, entry_points


def read(group: str) -> tuple[EntryPoint, ...]:
    """Returns the entry points of a group.

    They are read again when `sys.path` changes. Reading takes 20 ms, and an evaluation asks a
    hundred times.

    Args:
        group: such as "emberlink.comm".
    """
    return _read(group, tuple(sys.path))


@lru_cache(maxsize=64)
def _read(group: str, path: tuple[str, ...]) -> tuple[EntryPoint, ...]:
    return tuple(entry_points(group=group))
