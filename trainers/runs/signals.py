"""Ctrl-C, SIGTERM and SIGHUP: the step is finished first."""

import signal
from collections.abc import Callable
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interrupted(KeyboardInterrupt):
    """A signal ended what was being done."""


class Interruption:
    """Within, a first SIGINT, SIGTERM or SIGHUP calls `stop`; a second one raises `Interrupted`.

    Args:
        stop: asks for an end between two steps.
    """

    def __init__(self, stop: Callable[[], None]):
        self._stop = stop
        self._before: dict[signal.Signals, signal._HANDLER] = {}
        self.received: int | None = None
        """the first signal that came"""
        self.at_once = False
        """whether the first one is not to wait either"""

    def __enter__(self) -> "Interruption":
        signals = [*_SIGNALS]
        if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # nohup ignores it
            signals.append(signal.SIGHUP)
        self._before = {one: signal.signal(one, self._handle) for one in signals}
        return self

    def __exit__(self, *_: object) -> None:
        for one, handler in self._before.items():
            signal.signal(one, handler)

    @property
    def status(self) -> int:
        """The exit status of a program that the signal ended: 130, 143 or 129."""
        return 128 + (self.received or signal.SIGINT)

    def _handle(self, number: int, _: FrameType | None) -> None:
        first = self.received is None
        self.received = self.received or number
        if not first or self.at_once:
            raise Interrupted
        self._stop()
