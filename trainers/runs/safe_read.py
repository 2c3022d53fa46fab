"""Reads YAML and JSON from untrusted files: only plain values of limited size."""

import json
from collections.abc import Hashable
from pathlib import Path
from typing import Any

import yaml

from emberlink.envs.utils.atomic_io import read_bytes
from emberlink.envs.utils.errors import UserError

MAX_YAML = 100_000
"""maximum bytes of a config.yaml; a typical one has 2,000"""
MAX_JSON = 200_000_000
"""maximum bytes of eval.json and metrics.jsonl; the largest evaluation has half of it"""
_MAX_PARTS = 2_000_000
"""maximum number of lists, mappings and texts in a JSON text; they take up to thirty times their
bytes in memory"""
_MAX_DIGITS = 20
"""digits of an integer"""


def read_text(path: Path, max_bytes: int) -> str:
    """Returns the text of a regular file or of the target of a link.

    Raises:
        FileNotFoundError: there is no such file.
        UserError: it is not a regular file, is too large, or is not UTF-8.
    """
    try:
        return read_bytes(path, max_bytes).decode()
    except FileNotFoundError:
        raise
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror or error}") from None
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: cannot be read: {error}") from None


def read_yaml(path: Path) -> Any:
    """Returns the content of a YAML file: mappings, lists, text, numbers and dates.

    Raises:
        FileNotFoundError: there is no such file.
        UserError: it cannot be read, or holds a tag, an anchor, an alias or a repeated key.
    """
    text = read_text(path, MAX_YAML)
    try:
        return yaml.load(text, _PlainLoader)
    except (yaml.YAMLError, TypeError, ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())[:200]
        raise UserError(f"{path}: cannot be read: {reason}") from None


def check_parts(text: str) -> None:
    """Checks that a JSON text takes little more memory as a value than as a text.

    Raises:
        UserError: it has too many lists, mappings and texts.
    """
    parts = text.count("[") + text.count("{") + text.count('"') // 2
    if parts > _MAX_PARTS:
        raise UserError(f"too many lists, mappings and texts: {parts}")


def parse_json(text: str) -> Any:
    """Returns the value of a JSON text; integers of more than 20 digits become float.

    Raises:
        ValueError: the text is not JSON, repeats a key, or has too many levels, lists, mappings or
            texts.
    """
    check_parts(text)
    try:
        return json.loads(text, object_pairs_hook=_once, parse_int=_integer)
    except RecursionError:
        raise UserError("too many levels of lists or mappings") from None


class _PlainLoader(yaml.SafeLoader):
    """Refuses tags, which convert values, and aliases, which can expand a file to any size."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise UserError("aliases (*name) are not allowed")
        event: Any = self.peek_event()
        if event.tag is not None or event.anchor is not None:
            raise UserError("tags (!!name) and anchors (&name) are not allowed")
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Hashable, Any]:
        names: set[Hashable] = set()
        for key, _ in node.value:
            name = self.construct_object(key, deep=True)
            if name in names:
                raise UserError(f"key {str(name)[:100]!r} is repeated")
            names.add(name)
        return super().construct_mapping(node, deep=deep)


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    mapping = dict(pairs)
    if len(mapping) < len(pairs):
        raise UserError("a key is repeated")
    return mapping


def _integer(text: str) -> int | float:
    return int(text) if len(text) <= _MAX_DIGITS else float(text)
