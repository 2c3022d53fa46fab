"""Looks up what other installed packages register under an entry point group."""

from importlib.metadata import EntryPoint, entry_points


def registered(group: str) -> dict[str, EntryPoint]:
    """Returns the entry points of a group by name.

    Args:
        group: such as "emberlink.comm".
    """
    return {point.name: point for point in entry_points(group=group)}
