"""Writes JSON with one line per list of numbers, and the text "inf" for infinite numbers."""

import json
import math
from collections.abc import Mapping
from typing import Any

_WIDTH = 240
"""maximum number of characters of a mapping on one line"""


def dumps(value: Any) -> str:
    """Returns a value as compact, readable JSON, with the texts "inf" and "-inf" for infinities.

    A list of numbers or texts is on one line, however long. A mapping is on one line if that has at
    most 240 characters; otherwise each of its keys begins a line.

    Raises:
        ValueError: a number is NaN.
    """
    return _dumps(finite(value), "")


def _dumps(value: Any, indent: str) -> str:
    if isinstance(value, dict):
        line = json.dumps(value, allow_nan=False)
        if len(line) + len(indent) <= _WIDTH:
            return line
        inner = indent + " "
        items = [f"{inner}{json.dumps(key)}: {_dumps(item, inner)}" for key, item in value.items()]
        return "{\n" + ",\n".join(items) + f"\n{indent}}}"
    if isinstance(value, list) and any(isinstance(item, dict | list) for item in value):
        inner = indent + " "
        items = [inner + _dumps(item, inner) for item in value]
        return "[\n" + ",\n".join(items) + f"\n{indent}]"
    return json.dumps(value, allow_nan=False)


def finite(value: Any) -> Any:
    """Returns a value with the texts "inf" and "-inf" for infinite numbers, which JSON lacks."""
    if isinstance(value, Mapping):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    return str(value) if isinstance(value, float) and math.isinf(value) else value


def infinite(value: Any) -> Any:
    """Returns a value with infinite numbers for the texts "inf" and "-inf"."""
    if isinstance(value, dict):
        return {key: infinite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [infinite(item) for item in value]
    return float(value) if isinstance(value, str) and value in ("inf", "-inf") else value
