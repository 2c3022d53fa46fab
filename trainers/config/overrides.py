"""Parses `key=value` and sets values of nested mappings by their dotted key."""

import re
from collections.abc import Iterator, Mapping
from functools import reduce
from operator import getitem
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException

from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import shown, unknown

# Hydra's grammar lacks letters such as ä, and parentheses.
_SPECIAL = r"\[\]{}\"'`=,$\\\x00-\x1f"
_PLAIN_TEXT = re.compile(rf"(?P<key>[A-Za-z_][\w.]*)=(?P<value>[^\s{_SPECIAL}][^{_SPECIAL}]*)")


_INFINITY = (".inf", "+.inf", "-.inf")


def parse(text: str) -> tuple[str, Any]:
    """Returns the key and the value of a `key=value`, read as Hydra reads it.

    Text that Hydra's grammar refuses for a character alone, as in `output=Läufe`, is a string.

    Raises:
        UserError: the text is of another form, or gives several values or a mapping.
    """
    try:
        parsed = OverridesParser.create().parse_override(text)
    except (HydraException, ValueError, RecursionError):
        if plain_text := _PLAIN_TEXT.fullmatch(text):
            return plain_text["key"], plain_text["value"]
        hint = "; put special characters into quotes: 'key=\"value\"'" if "=" in text else ""
        raise UserError(f"{shown(text)!r} is not of the form key=value{hint}") from None
    key, value = parsed.get_key_element(), parsed.value()
    if parsed.is_sweep_override():
        several = f"{'seeds' if key == 'seed' else key}=[{text.partition('=')[2]}]"
        hint = f"; a list is written in brackets: {several}" if "," in text else ""
        raise UserError(f"{shown(text)!r}: only one value is possible here{shown(hint)}")
    if parsed.is_delete() or parsed.is_add() or parsed.is_force_add():
        raise UserError(f"{shown(text)!r}: expected key=value without a sign before the key")
    if isinstance(value, dict):
        raise UserError(f"{shown(text)!r}: give its keys one by one, as {key}.KEY=VALUE")
    return key, _with_infinity(value)


def _with_infinity(value: Any) -> Any:
    """Returns a value with YAML's infinity, `.inf`, as a number; Hydra knows `inf` only."""
    if isinstance(value, list):
        return [_with_infinity(item) for item in value]
    infinite = isinstance(value, str) and value in _INFINITY
    return float(value.replace(".", "", 1)) if infinite else value


def put(values: dict[str, Any], key: str, value: Any) -> None:
    """Sets the value of an existing dotted key.

    A mapping changes only the keys that it holds. If it has another `name`, as in `comm`, it
    replaces the whole mapping.

    Raises:
        UserError: the mapping has a key that is not known.
    """
    *path, last = key.split(".")
    parent = reduce(getitem, path, values)
    old = parent[last]
    both = isinstance(old, dict) and isinstance(value, Mapping)
    if not both or value.get("name", old.get("name")) != old.get("name"):
        parent[last] = value
        return
    for name, item in value.items():
        if name not in old:
            raise UserError(f"key {unknown(f'{key}.{name}', all_keys(values))}")
        put(values, f"{key}.{name}", item)


def full_key(values: Mapping[str, Any], key: str) -> str:
    """Returns the dotted key that equals `key`, or else the only one that ends with it.

    Raises:
        UserError: there is no such key, or several.
    """
    names = list(all_keys(values))
    if key in names:
        return key
    matching = [name for name in names if name.endswith(f".{key}")]
    if len(matching) > 1:
        raise UserError(f"key {key!r} is ambiguous: {', '.join(matching)}")
    if not matching:
        raise UserError(f"key {unknown(key, names, listed=False)}")
    return matching[0]


def all_keys(values: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """Yields the dotted keys of nested mappings, including those of inner mappings."""
    for key, value in values.items():
        yield f"{prefix}{key}"
        if isinstance(value, Mapping):
            yield from all_keys(value, f"{prefix}{key}.")


def flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Returns the values of nested mappings by dotted key."""
    result: dict[str, Any] = {}
    for key, value in values.items():
        below = flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else None
        result |= {f"{prefix}{key}": value} if below is None else below
    return result
