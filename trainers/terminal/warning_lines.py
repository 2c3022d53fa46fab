"""Prints warnings as a command does: on one line, without the place in the program."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def one_line_warnings() -> Iterator[None]:
    """Prints each `UserWarning` as `emberlink: warning: ...`, until the end of the context.

    The same text is printed once, also if several parts of the program warn of it. Other categories
    are not meant for users and keep their place. Only what is printed changes: warnings can still
    be recorded, ignored, or turned into errors.
    """
    before, printed = warnings.formatwarning, set[str]()

    def formatted(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        line: str | None = None,
    ) -> str:
        if not issubclass(category, UserWarning):
            return before(message, category, filename, lineno, line)
        text = " ".join(str(message).split())
        if text in printed:
            return ""
        printed.add(text)
        return f"emberlink: warning: {''.join(c if c.isprintable() else '?' for c in text)}\n"

    warnings.formatwarning = formatted
    try:
        yield
    finally:
        warnings.formatwarning = before
