"""Checks of configurations and plain values, and the messages about them."""

import json
import reprlib
from collections.abc import Mapping
from importlib.resources import files
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import Field, TypeAdapter, ValidationError

from .errors import UserError

T = TypeVar("T")


TAG = "kind:"
"""begins the name of one of several types that a value may be of; no part of its key"""


Name = Annotated[str, Field(pattern=r"^\w[\w.+-]*$", max_length=100)]
"""what may be part of a file's name, and of a measure's"""


def known(group: str) -> list[str]:
    """The choices of a config group ("method", "setup" or "fire"), in alphabetical order."""
    names = (entry.name for entry in files("emberlink.configs").joinpath(group).iterdir())
    return sorted(name.removesuffix(".yaml") for name in names if name.endswith(".yaml"))


def from_plain(config_type: type[T], values: Mapping[str, Any]) -> T:
    """A configuration from plain values as YAML has them: nothing unknown, nothing coerced.

    Raises:
        pydantic.ValidationError: a ValueError that names what is wrong.
        ValueError: a value that no YAML of ours holds, such as bytes, or a list within itself.
    """
    # Through JSON, whose lists and mappings strict validation takes for tuples and dataclasses.
    return TypeAdapter(config_type).validate_json(json.dumps(plain(values)))


def plain(value: Any, key: str = "", deepest: int = 16) -> Any:
    """The value as JSON can hold it; numpy's numbers and arrays become Python's.

    Args:
        value: mappings, lists and tuples of text, numbers, bool and None.
        key: where it stands, for messages.
        deepest: levels that may be below it.

    Raises:
        ValueError: it holds something else; one line that names the key.
    """
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if isinstance(value, Mapping | list | tuple) and deepest == 0:
        raise UserError(f"{key[:60]}: lists or mappings within each other, too many levels")
    if isinstance(value, Mapping):
        for name in value:
            if not isinstance(name, str) or not name.isprintable():
                raise UserError(f"key {shown(name)} in {key or 'the configuration'} is no name")
        prefix = f"{key}." if key else ""
        return {name: plain(item, prefix + name, deepest - 1) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item, f"{key}.{place}", deepest - 1) for place, item in enumerate(value)]
    if isinstance(value, str) and not value.isprintable():
        raise UserError(f"{key}={shown(value)}: holds characters that cannot be printed")
    if isinstance(value, int) and value.bit_length() > 1024:
        raise UserError(f"{key}: a whole number of {value.bit_length()} bits is too large")
    if not isinstance(value, str | int | float | None):
        raise UserError(f"{key}={shown(value)}: {type(value).__name__} is no number, text or list")
    return value


def shown(value: Any) -> str:
    """A value in a message: as it is where it is short and can be printed, else cut and escaped."""
    text = value if isinstance(value, str) else reprlib.repr(value)
    return printable(text if len(text) <= 100 else f"{text[:60]}...{text[-20:]}")


def printable(text: str) -> str:
    """The text on one line, what cannot be printed escaped."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def describe(error: ValidationError, prefix: str = "") -> str:
    """One line for what pydantic found first: the key, the value, and what was expected."""
    first = error.errors()[0]
    parts = [str(part) for part in first["loc"] if not str(part).startswith(TAG)]
    key = ".".join([prefix, *parts] if prefix else parts)
    if isinstance(cause := first.get("ctx", {}).get("error"), ValidationError):
        return describe(cause, key)
    message = first["msg"].removeprefix("Value error, ").replace("Input should", "should", 1)
    if first["type"] in ("missing", "unexpected_keyword_argument"):
        wrong = "missing" if first["type"] == "missing" else "not known"
        return f"key {shown(key)!r} is {wrong}"
    if message.startswith((f"{key}=", f"{key}.")):
        return message
    value = "" if isinstance(first["input"], dict) else f"={shown(first['input'])}"
    return f"{key}{value}: {message}"
