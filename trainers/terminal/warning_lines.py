"""Prints warnings as a command does: on one line, without the place in the program."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def one_line_warnings() -> Iterator[None]:
    """Prints each `UserWarning` once as `emberlink: warning: ...`, until the end of the context.

    Other categories are not meant for users and keep their place. Only what is printed changes:
    warnings can still be recorded, ignored, or turned into errors.
    """
    before, printed = warnings.formatwarning, set[str]()

    def formatted(message, category, *place) -> str:
        if not issubclass(category, UserWarning):
            return before(message, category, *place)
        text = "".join(c if c.isprintable() else "?" for c in " ".join(str(message).split()))
        line = "" if text in printed else f"emberlink: warning: {text}\n"
        printed.add(text)
        return line

    warnings.formatwarning = formatted
    try:
        yield
    finally:
        warnings.formatwarning = before
