"""Validates plain values with pydantic, and describes its first error in one line."""

import json
import re
import shlex
from collections.abc import Mapping
from functools import partial
from typing import Annotated, Any, TypeVar

from pydantic import AfterValidator, ConfigDict, Field, Strict, TypeAdapter, ValidationError
from pydantic_core import to_json, to_jsonable_python

from emberlink.envs.utils.errors import UserError, shown

T = TypeVar("T")

STRICT = ConfigDict(extra="forbid", strict=True)
"""configuration of a pydantic dataclass without unknown keys and without conversions of types"""

TAG = "kind:"
"""prefix of the tags of pydantic's unions, which are not part of a key"""

Name = Annotated[str, Field(pattern=r"^\w[\w.+-]*$", max_length=100)]
"""text that can be part of file names and measures"""

N = TypeVar("N", bound=float)


def _ordered(pair: tuple[float, float]) -> tuple[float, float]:
    if pair[0] > pair[1]:
        raise UserError(f"a range is (low, high), got {pair}")
    return pair


Range = Annotated[tuple[N, N], Strict(False), AfterValidator(_ordered)]
"""(low, high); a list, as in YAML, is valid for the tuple"""

CountOrZero = Annotated[int, Field(ge=0)]

_JSON: Any = {"inf_nan_mode": "constants", "fallback": lambda array: array.tolist()}
plain = partial(to_jsonable_python, **_JSON)
"""Returns a value with types that JSON has: lists of arrays and ranges, text of paths."""


def from_plain(config_type: type[T], values: Mapping[str, Any], key: str = "") -> T:
    """Returns a pydantic dataclass of plain values, such as the content of a YAML file.

    Unknown keys are errors, and no value is converted to another type. `key` is the place of
    the values in the whole configuration, for messages.
    """
    # From JSON, strict validation accepts lists as tuples and mappings as dataclasses.
    try:
        return TypeAdapter(config_type).validate_json(to_json(values, **_JSON))
    except ValidationError as error:
        raise UserError(describe(error, key)) from None


def describe(error: ValidationError, prefix: str = "") -> str:
    """Describes the first error in one line: key, which begins with `prefix`, value and reason."""
    errors = error.errors()
    # A mistyped key is also reported as missing.
    mistyped = [entry for entry in errors if entry["type"] == "unexpected_keyword_argument"]
    first = (mistyped or errors)[0]
    parts = [str(part) for part in first["loc"] if not str(part).startswith(TAG)]
    key = ".".join([prefix, *parts] if prefix else parts)
    if first["type"] in ("missing", "unexpected_keyword_argument"):
        wrong = "missing" if first["type"] == "missing" else "not known"
        return f"key {shown(key)!r} is {wrong}"
    message = first["msg"].removeprefix("Value error, ").replace("Input should", "should", 1)
    if not key or message.startswith((f"{key}=", f"{key}.", f"{key}: ", f"key '{key}.")):
        return message
    given = first["input"]
    if isinstance(given, str):
        given = json.dumps(given)  # in quotes: why the text is not the number that it looks like
    value = "" if isinstance(given, dict) else f"={shown(given)}"
    return f"{key}{value}: {message}"


def is_index(text: str, end: int) -> bool:
    """Returns whether a text is a whole number from 0 to `end` - 1."""
    return text.isdecimal() and len(text) <= len(str(end)) and int(text) < end


def as_argument(key: str, *values: str) -> str:
    """Returns `key=value`, or a list of values, as it is written in a shell, for a message."""
    word = re.compile(r"(?!(true|false|null|nan|inf)$)[a-z_][\w-]*|[*]", re.IGNORECASE | re.ASCII)
    texts = []
    for value in values:
        # In quotes, Hydra reads \" as ", two backslashes before a quote as one, and ${ as a key.
        escaped = re.sub(r'(\\+)(?="|$)', r"\1\1", value).replace('"', r"\"")
        escaped = escaped.replace("${", r"\${")
        texts.append(value if word.fullmatch(value) else f'"{escaped}"')
    return shlex.quote(f"{key}={texts[0] if len(texts) == 1 else '[' + ','.join(texts) + ']'}")


def check_device(name: str) -> str:
    """Checks that a device is available and returns its name."""
    import torch

    present = ["cpu", *(f"cuda:{i}" for i in range(torch.cuda.device_count()))]
    if name not in present and not (name == "cuda" and len(present) > 1):
        raise UserError(f"device={shown(name)} is not available; known: {', '.join(present)}")
    return name
