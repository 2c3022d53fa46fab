"""Handles SIGINT, SIGTERM and SIGHUP, so that a training can finish its step and save."""

import signal
from collections.abc import Callable
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interrupted(KeyboardInterrupt):
    """Reports a signal that ends the program at once."""


class Interruption:
    """Calls `stop` at the first SIGINT, SIGTERM or SIGHUP and raises `Interrupted` at the second.

    Args:
        stop: called at the first signal; requests the end of the training after a step.
    """

    def __init__(self, stop: Callable[[], None]):
        self._stop = stop
        self._before: dict[signal.Signals, signal._HANDLER] = {}
        self.received: int | None = None
        """number of the first signal; None before it"""
        self.at_once = False
        """whether the first signal raises `Interrupted`, too"""

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
