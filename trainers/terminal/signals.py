"""Handles signals that end a training, so that it can finish its step and save."""

import signal
import time
from collections.abc import Callable, Sequence
from types import FrameType

_NOTICES = (signal.SIGUSR1, signal.SIGUSR2)
"""signals that a cluster sends before it ends a process; they may follow another signal"""
_ENDS = (signal.SIGTERM, signal.SIGHUP)
"""signals that a machine sends together, in either order, when it ends a process"""
_TOGETHER = 2.0
"""seconds in which several of `_ENDS` are one"""
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, *_NOTICES)


class Interrupted(KeyboardInterrupt):
    """Reports a signal that ends the program at once."""


class Interruption:
    """Calls `stop` at the first signal and raises `Interrupted` at the second.

    The signals are SIGINT, SIGTERM, SIGHUP, SIGUSR1 and SIGUSR2. Clusters send several of them
    together. SIGUSR1 and SIGUSR2 therefore never count as the second signal. SIGTERM and SIGHUP
    count only `_TOGETHER` seconds after the first.

    Args:
        stop: called at the first signal; requests the end of the training after a step.
        signals: the signals to handle.
    """

    def __init__(
        self,
        stop: Callable[[], None],
        signals: Sequence[signal.Signals] = (*_SIGNALS, signal.SIGHUP),
    ):
        self._signals = signals
        self._stop, self._since, self._raised = stop, 0.0, False
        self._before: dict[signal.Signals, signal._HANDLER] = {}
        self.received: int | None = None
        """number of the first signal; None before it"""
        self.at_once = False
        """whether the first signal raises `Interrupted`, too"""

    def __enter__(self) -> "Interruption":
        for number in self._signals:
            if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:  # nohup
                self._before[number] = signal.signal(number, self._handle)
        return self

    def __exit__(self, _: object, error: BaseException | None, __: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        # A context manager of tensordict replaces the exception by another one.
        if self._raised and isinstance(error, Exception):
            raise Interrupted from error

    @property
    def status(self) -> int:
        """The exit status after the signal: 128 and its number, such as 130 for SIGINT."""
        return 128 + (self.received or signal.SIGINT)

    def _handle(self, number: int, _: FrameType | None) -> None:
        first = self.received is None
        self.received = self.received or number
        if first:
            self._since = time.monotonic()
        again = number in _ENDS and time.monotonic() - self._since < _TOGETHER
        if self.at_once or not (first or again or number in _NOTICES):
            self._raised = True
            raise Interrupted
        self._stop()
