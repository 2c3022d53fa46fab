"""Checks of configurations and plain values, and the messages about them."""

import difflib
import json
import reprlib
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import Field, TypeAdapter, ValidationError

from emberlink.envs.utils.errors import UserError

T = TypeVar("T")


TAG = "kind:"
"""begins the tags of pydantic's unions, which are no part of a key"""

Name = Annotated[str, Field(pattern=r"^\w[\w.+-]*$", max_length=100)]
"""text that can be part of the names of files and measures"""


def from_plain(config_type: type[T], values: Mapping[str, Any], key: str = "") -> T:
    """Returns a configuration from plain values as YAML has them.

    No key may be unknown, and no value is converted to another type.

    Args:
        config_type: a pydantic dataclass.
        values: mappings, lists and tuples of text, numbers, bool and None.
        key: of the values within a larger configuration, for messages.

    Raises:
        UserError: one line that names the first key that is wrong, its value and what is wrong.
    """
    # Through JSON, whose lists and mappings strict validation takes for tuples and dataclasses.
    text = json.dumps(plain(values, key))
    try:
        return TypeAdapter(config_type).validate_json(text)
    except ValidationError as error:
        raise UserError(describe(error, key)) from None


def plain(value: Any, key: str = "", deepest: int = 16) -> Any:
    """Returns the value as JSON can hold it; ranges and NumPy's arrays become lists.

    Args:
        value: mappings, lists and tuples of text, numbers, bool and None.
        key: of the value, for messages.
        deepest: levels that it may have.

    Raises:
        UserError: it holds something else; one line that names the key.
    """
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if isinstance(value, range):
        value = list(value)
    if isinstance(value, Mapping | list | tuple) and deepest == 0:
        raise UserError(f"{key[:60]}: too many levels of lists or mappings")
    if isinstance(value, Mapping):
        for name in value:
            if not isinstance(name, str) or not name.isprintable():
                raise UserError(f"key {shown(name)} in {key or 'the configuration'} is not a name")
        prefix = f"{key}." if key else ""
        return {name: plain(item, prefix + name, deepest - 1) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item, f"{key}.{place}", deepest - 1) for place, item in enumerate(value)]
    if isinstance(value, str) and not value.isprintable():
        raise UserError(f"{key}={shown(value)}: holds characters that cannot be printed")
    if isinstance(value, int) and value.bit_length() > 1024:
        raise UserError(f"{key}: a whole number of {value.bit_length()} bits is too large")
    if not isinstance(value, str | int | float | None):
        raise UserError(
            f"{key}={shown(value)}: expected a number, text or list, not {type(value).__name__}"
        )
    return value


def shown(value: Any) -> str:
    """Returns a value for a message: cut if it is long, escaped where it cannot be printed."""
    text = value if isinstance(value, str) else reprlib.repr(value)
    return printable(text if len(text) <= 100 else f"{text[:60]}...{text[-20:]}")


def printable(text: str) -> str:
    """Returns the text on one line, with characters that cannot be printed escaped."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def describe(error: ValidationError, prefix: str = "") -> str:
    """Returns one line about the first error: the key, the value and the expected.

    Args:
        error: of a validation by pydantic.
        prefix: the key of what was validated.
    """
    errors = error.errors()
    # A key that is mistyped is also a key that is missing.
    mistyped = [found for found in errors if found["type"] == "unexpected_keyword_argument"]
    first = (mistyped or errors)[0]
    parts = [str(part) for part in first["loc"] if not str(part).startswith(TAG)]
    key = ".".join([prefix, *parts] if prefix else parts)
    if isinstance(cause := first.get("ctx", {}).get("error"), ValidationError):
        return describe(cause, key)
    message = first["msg"].removeprefix("Value error, ").replace("Input should", "should", 1)
    if first["type"] in ("missing", "unexpected_keyword_argument"):
        wrong = "missing" if first["type"] == "missing" else "not known"
        return f"key {shown(key)!r} is {wrong}"
    if message.startswith((f"{key}=", f"{key}.", f"{key}: ", f"key '{key}.")):
        return message
    value = "" if isinstance(first["input"], dict) else f"={shown(first['input'])}"
    return f"{key}{value}: {message}"


def unknown(value: str, known: Iterable[str], *, listed: bool = True) -> str:
    """Returns the part of a message that says that a name is not known, and the nearest one.

    Args:
        value: the name.
        known: names that would do; of dotted keys the last part is compared too.
        listed: appends all known names; else only where none is near, and dotted ones left out.
    """
    names = list(known)
    last_parts = {name.rsplit(".", 1)[-1]: name for name in names}
    near = difflib.get_close_matches(value, names, n=1) or [
        last_parts[part] for part in difflib.get_close_matches(value, last_parts, n=1)
    ]
    hint = f"; did you mean {near[0]}?" if near else ""
    if listed:
        hint += f"{'' if hint else ';'} known: {', '.join(names)}"
    elif not near:
        hint = f"; known: {', '.join(name for name in names if '.' not in name)}"
    return f"{shown(value)!r} is not known{hint}"
