"""Writes JSON with one line per list of numbers, and the text "inf" for infinite numbers."""

import json
import math
import re
from collections.abc import Callable, Mapping
from typing import Any


def dumps(value: Any) -> str:
    """Returns a value as readable JSON with infinities as text; a ValueError if a number is NaN."""
    text = json.dumps(finite(value), indent=1, allow_nan=False)
    # A line break after a bracket is never in a text, where it is escaped.
    return re.sub(r"\[\n[^\[\]{}\"]*\n *\]", lambda found: " ".join(found[0].split()), text)


def finite(value: Any) -> Any:
    """Returns a value with the texts "inf" and "-inf" for infinite numbers, which JSON lacks."""
    return _changed(value, lambda x: str(x) if isinstance(x, float) and math.isinf(x) else x)


def infinite(value: Any) -> Any:
    """Returns a value with infinite numbers for the texts "inf" and "-inf"."""
    return _changed(value, lambda x: float(x) if x in ("inf", "-inf") else x)


def _changed(value: Any, change: Callable[[Any], Any]) -> Any:
    if isinstance(value, Mapping):
        return {key: _changed(item, change) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_changed(item, change) for item in value]
    return change(value)
