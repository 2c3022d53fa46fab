"""Lets a training finish its step before Ctrl-C, SIGTERM or SIGHUP ends it."""

import signal
from collections.abc import Callable
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interrupted(KeyboardInterrupt):
    """Is raised by a signal that does not wait for the end of the step."""


class Interruption:
    """Calls `stop` at the first SIGINT, SIGTERM or SIGHUP and raises `Interrupted` at the second.

    Args:
        stop: requests an end between two steps.
    """

    def __init__(self, stop: Callable[[], None]):
        self._stop = stop
        self._before: dict[signal.Signals, signal._HANDLER] = {}
        self.received: int | None = None
        """number of the first signal; None before it"""
        self.at_once = False
        """raise `Interrupted` at the first signal too"""

    def __enter__(self) -> "Interruption":
        signals = [*_SIGNALS]
        if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # nohup ignores it
            signals.append(signal.SIGHUP)
        self._before = {number: signal.signal(number, self._handle) for number in signals}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    @property
    def status(self) -> int:
        """The exit status after the signal: 130 for SIGINT, 143 for SIGTERM, 129 for SIGHUP."""
        return 128 + (self.received or signal.SIGINT)

    def _handle(self, number: int, _: FrameType | None) -> None:
        first = self.received is None
        self.received = self.received or number
        if not first or self.at_once:
            raise Interrupted
        self._stop()
