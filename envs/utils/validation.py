"""Validates configurations and plain values, and describes errors in one line."""

import difflib
import json
import math
import operator
import re
import reprlib
import shlex
from collections.abc import Iterable, Mapping
from pathlib import PurePath
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from emberlink.envs.utils.errors import UserError

T = TypeVar("T")

STRICT = ConfigDict(extra="forbid", strict=True)
"""configuration of a pydantic dataclass without unknown keys and without conversions of types"""

TAG = "kind:"
"""prefix of the tags of pydantic's unions, which are not part of a key"""

_NAME = r"^\w[\w.+-]*$"
Name = Annotated[str, Field(pattern=_NAME, max_length=100)]
"""text that can be part of file names and measures"""

CountOrZero = Annotated[int, Field(ge=0)]

_EXPECTED = {
    "dataclass_type": "expected keys and values",
    "dict_type": "expected keys and values",
    "tuple_type": "expected a list",
    "too_long": "expected a list of at most {max_length}",
    "too_short": "expected a list of at least {min_length}",
    "int_type": "expected a whole number",
    "float_type": "expected a number",
    "bool_type": "expected true or false",
    "string_type": "expected text",
}
"""type of a pydantic error -> its message; the others keep pydantic's"""
_UPPER_BOUNDS = ("less_than", "less_than_equal")


def from_plain(config_type: type[T], values: Mapping[str, Any], key: str = "") -> T:
    """Returns a configuration from plain values, such as those of a YAML file.

    Unknown keys are errors, and no value is converted to another type.

    Args:
        config_type: a pydantic dataclass.
        values: mappings, lists and tuples of text, numbers, bool and None.
        key: key of the values in the whole configuration, for messages.

    Raises:
        UserError: a key or a value is wrong; the message names the first one and the reason.
    """
    # From JSON, strict validation accepts lists as tuples and mappings as dataclasses.
    text = json.dumps(plain(values, key))
    try:
        return TypeAdapter(config_type).validate_json(text)
    except ValidationError as error:
        raise UserError(describe(error, key)) from None


def check_whole(name: str, number: Any) -> int:
    """Returns a whole number, such as a tensor's or NumPy's, as an int.

    Raises:
        UserError: it is another number or no number; the message begins with `name`.
    """
    try:
        if not isinstance(number, bool):
            return operator.index(number)
    except TypeError:
        pass
    given = json.dumps(number) if isinstance(number, str) else number
    raise UserError(f"{name}={shown(given)}: expected a whole number")


def plain(value: Any, key: str = "", deepest: int = 16) -> Any:
    """Returns a value with types that JSON has: of ranges and NumPy arrays lists, of a path text.

    Args:
        value: mappings, lists and tuples of text, numbers, bool, None and paths.
        key: key of the value, for messages.
        deepest: maximum number of nested levels.

    Raises:
        UserError: the value holds another type or too many levels; the message names the key.
    """
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if isinstance(value, PurePath):
        value = str(value)
    if isinstance(value, range):
        value = list(value)
    if isinstance(value, Mapping | list | tuple) and deepest == 0:
        raise UserError(f"{key[:60]}: too many levels of lists or mappings")
    if isinstance(value, Mapping):
        for name in value:
            if not isinstance(name, str) or not name.isprintable():
                where = key or "the configuration"
                raise UserError(f"{where}: the key {shown(name)} is not a name")
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


def is_index(text: str, end: int) -> bool:
    """Returns whether a text is a whole number from 0 to `end` - 1."""
    return text.isdecimal() and len(text) <= len(str(end)) and int(text) < end


_LIKE_A_NUMBER = re.compile(
    r"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?|[-+]?\.?inf|\.?nan|true|false|null", re.IGNORECASE
)
_AS_YAML = {"None": "null", "True": "true", "False": "false"}
"""values that YAML writes in another way, by what Python writes"""


def shown(value: Any) -> str:
    """Returns a value as text for a message, shortened if it is long, with escaped characters."""
    text = value if isinstance(value, str) else _AS_YAML.get(repr(value)) or reprlib.repr(value)
    return printable(text if len(text) <= 100 else f"{text[:60]}...{text[-20:]}")


def printable(text: str) -> str:
    """Returns the text on one line, with escapes for characters that cannot be printed."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def as_argument(key: str, value: str) -> str:
    """Returns `key=value` as it is written in a shell, for a message."""
    words = ("true", "false", "null", "nan", "inf")  # Hydra reads them as other types
    if re.fullmatch(r"[^\W\d][\w-]*", value) and value.lower() not in words:
        return f"{key}={value}"
    escaped = value.replace('"', '\\"')
    return shlex.quote(f'{key}="{escaped}"')


def describe(error: ValidationError, prefix: str = "") -> str:
    """Describes the first error of a validation in one line: key, value and reason.

    Args:
        error: pydantic's error.
        prefix: key of the validated values, for the message.
    """
    errors = error.errors()
    # A mistyped key is reported as missing, too.
    mistyped = [entry for entry in errors if entry["type"] == "unexpected_keyword_argument"]
    first = (mistyped or errors)[0]
    parts = [str(part) for part in first["loc"] if not str(part).startswith(TAG)]
    key = ".".join([prefix, *parts] if prefix else parts)
    if isinstance(cause := first.get("ctx", {}).get("error"), ValidationError):
        return describe(cause, key)
    usual = first["msg"].removeprefix("Value error, ").replace("Input should", "should", 1)
    expected = _EXPECTED.get(first["type"])
    message = usual if expected is None else expected.format(**first.get("ctx", {}))
    given = first["input"]
    if first.get("ctx", {}).get("pattern") == _NAME:
        message = "expected a name of letters, digits and _ . + -"
    if first["type"] in _UPPER_BOUNDS and isinstance(given, float) and not given < math.inf:
        message = "expected a finite number"
    if first["type"] in ("missing", "unexpected_keyword_argument"):
        wrong = "missing" if first["type"] == "missing" else "not known"
        return f"key {shown(key)!r} is {wrong}"
    if not key or message.startswith((f"{key}=", f"{key}.", f"{key}: ", f"key '{key}.")):
        return message
    if isinstance(given, str) and _LIKE_A_NUMBER.fullmatch(given):
        given = json.dumps(given)  # in quotes: why the text is not the number that it looks like
    value = "" if isinstance(given, dict) else f"={shown(given)}"
    return f"{key}{value}: {message}"


def unknown(value: str, known: Iterable[str], *, listed: bool = True) -> str:
    """Returns a message that a name is not known, with the most similar known name.

    Args:
        value: the name.
        known: all known names. One with the same last part is the most similar.
        listed: whether to append all known names. If not, names without dots are appended only if
            no name is similar.
    """
    names = list(known)
    last_parts = {name.rsplit(".", 1)[-1]: name for name in names}
    same = [name for name in names if name.endswith(f".{value.rpartition('.')[2]}")]
    near = (
        difflib.get_close_matches(value, same, n=1, cutoff=0.0)
        or difflib.get_close_matches(value, names, n=1)
        or [last_parts[part] for part in difflib.get_close_matches(value, last_parts, n=1)]
    )
    hint = f"; did you mean {near[0]}?" if near else ""
    if listed:
        hint += f"{'' if hint else ';'} known: {', '.join(names)}"
    elif not near:
        hint = f"; known: {', '.join(name for name in names if '.' not in name)}"
    return f"{shown(value)!r} is not known{hint}"
