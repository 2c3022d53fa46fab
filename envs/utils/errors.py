"""Defines the error for mistakes of the user, and texts for its messages."""

import difflib
import reprlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import PurePath
from typing import Any


class UserError(ValueError):
    """Reports wrong input: a value, a key, a file or a folder that the user chose.

    The command line prints its message in one line. Any other exception is a defect of the program
    and keeps its traceback.
    """


@contextmanager
def naming(path: object, *more: type[Exception]) -> Iterator[None]:
    """Raises errors of the system, of values and of `more` types as a UserError naming a file."""
    try:
        yield
    except (OSError, ValueError, RecursionError, *more) as error:
        text = " ".join(str(getattr(error, "strerror", None) or error).split())[:300]
        raise UserError(text if str(path) in text else f"{path}: {text}") from None


def require(package: str, extra: str, key: str) -> None:
    """Checks that a package of an extra, which the setting `key` needs, is installed."""
    if find_spec(package) is None:
        raise missing(package, extra, key)


def missing(package: str, extra: str, what: str) -> UserError:
    """Returns the error that a package of an extra, which `what` needs, is not installed."""
    how = f"pip install '.[{extra}]' in the folder of emberlink"
    return UserError(f"{what}: {package} is not installed: {how}")


def shown(value: Any) -> str:
    """Returns a value as YAML writes it, on one line, shortened if it is long."""
    words = {"None": "null", "True": "true", "False": "false"}
    text = str(value) if isinstance(value, str | PurePath) else reprlib.repr(value)
    text = text if isinstance(value, str) else words.get(text, text)
    return printable(text if len(text) <= 100 else f"{text[:60]}...{text[-20:]}")


def printable(text: str) -> str:
    """Returns the text on one line, with escapes for characters that cannot be printed."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def one_line(text: str) -> str:
    """Returns a message on one line, without control characters, with long words cut."""
    return printable(" ".join(word[:400] for word in text.split()))


def unknown(value: str, known: Iterable[str]) -> str:
    """Returns a message that a name is not known, with the most similar and all known names."""
    names = list(known)
    near = difflib.get_close_matches(value, names, n=1)
    hint = f"; did you mean {near[0]}?" if near else ";"
    return f"{shown(value)!r} is not known{hint} known: {', '.join(names)}"
