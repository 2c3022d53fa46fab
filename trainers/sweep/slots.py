"""Remembers how many tasks an executor takes at a time."""

import time

RETRY = 60.0
"""seconds after which a full cluster is asked again, even if no task has ended"""


class Slots:
    """The tasks that may run at a time; fewer for a while after a cluster refused one.

    Args:
        most: largest number of tasks.
    """

    def __init__(self, most: int):
        self._most = self._now = most
        self._since = 0.0
        self._reasons: set[str] = set()

    def has_room(self, running: int) -> bool:
        """Returns whether another task may be submitted.

        Args:
            running: number of submitted tasks that have not ended.
        """
        if time.monotonic() - self._since > RETRY:
            self._now = self._most
        return running < self._now

    def refused(self, running: int, reason: str) -> bool:
        """Records that the cluster took no more tasks, and returns whether the reason is new."""
        self._now, self._since = running, time.monotonic()
        new = reason not in self._reasons
        self._reasons.add(reason)
        return new
