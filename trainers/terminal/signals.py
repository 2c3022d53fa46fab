"""Handles signals that end a training, so that it can finish its step and save."""

import signal
from collections.abc import Callable, Sequence
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2)


class Interruption:
    """Calls `stop` at the first signal and raises KeyboardInterrupt at a later Ctrl-C (SIGINT).

    Clusters send several of the other signals together, so these never end the program at once.
    """

    def __init__(self, stop: Callable[[], None], signals: Sequence[signal.Signals] = _SIGNALS):
        self._signals = signals
        self._stop, self._raised = stop, False
        self._before: dict[signal.Signals, signal._HANDLER] = {}
        self.received: int | None = None
        """number of the first signal; None before it"""
        self.at_once = False
        """whether even the first signal raises KeyboardInterrupt"""

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
            raise KeyboardInterrupt from error

    @property
    def status(self) -> int:
        """The exit status after the signal: 128 and its number, such as 130 for SIGINT."""
        return 128 + (self.received or signal.SIGINT)

    def _handle(self, number: int, _: FrameType | None) -> None:
        again = self.received is not None and number == signal.SIGINT
        self.received = self.received or number
        if self.at_once or again:
            self._raised = True
            raise KeyboardInterrupt
        self._stop()
