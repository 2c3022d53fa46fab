"""Writes JSON with one line per list of numbers."""

import json
from typing import Any

_WIDTH = 240
"""maximum number of characters of a mapping on one line"""


def dumps(value: Any, indent: str = "") -> str:
    """Returns a value as compact, readable JSON.

    A list of numbers or texts is on one line, however long. A mapping is on one line if that has at
    most 240 characters; otherwise each of its keys begins a line.

    Args:
        value: mappings, lists, texts, numbers, bool and None.
        indent: indentation of the line on which the value begins.
    """
    if isinstance(value, dict):
        line = json.dumps(value)
        if len(line) + len(indent) <= _WIDTH:
            return line
        inner = indent + " "
        items = [f"{inner}{json.dumps(key)}: {dumps(item, inner)}" for key, item in value.items()]
        return "{\n" + ",\n".join(items) + f"\n{indent}}}"
    if isinstance(value, list | tuple) and any(isinstance(i, dict | list | tuple) for i in value):
        inner = indent + " "
        items = [inner + dumps(item, inner) for item in value]
        return "[\n" + ",\n".join(items) + f"\n{indent}]"
    return json.dumps(value)
