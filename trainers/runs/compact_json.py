"""Writes JSON with one line per list of numbers, and the text "inf" for infinite numbers."""

import json
import math
import re
from collections.abc import Mapping
from typing import Any


def dumps(value: Any) -> str:
    """Returns a value as readable JSON with infinities as text; a ValueError if a number is NaN."""
    text = json.dumps(finite(value), indent=1, allow_nan=False)
    # A line break after a bracket is never in a text, where it is escaped.
    return re.sub(r"\[\n[^\[\]{}\"]*\n *\]", lambda found: " ".join(found[0].split()), text)


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
