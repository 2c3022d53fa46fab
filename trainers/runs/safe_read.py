"""Text files that anybody may have written: plain values or an error, within bounds."""

import json
from collections.abc import Hashable
from pathlib import Path
from typing import Any

import yaml

from emberlink.envs.utils.atomic_io import read_bytes
from emberlink.envs.utils.errors import UserError

LONGEST_YAML = 100_000
"""bytes of a config.yaml; ours have two thousand"""
LONGEST_JSON = 500_000_000
"""bytes of eval.json and metrics.jsonl; the largest evaluation that can be set has a fifth"""
_LONGEST_INTEGER = 20
"""digits"""


def read_text(path: Path, longest: int) -> str:
    """The text of a regular file, or of one that a link leads to.

    Raises:
        FileNotFoundError: there is none.
        ValueError: one line: it is something else, such as a pipe, longer, or no UTF-8.
    """
    try:
        return read_bytes(path, longest).decode()
    except FileNotFoundError:
        raise
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror or error}") from None
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: cannot be read: {error}") from None


def read_yaml(path: Path) -> Any:
    """Mappings, lists, text, numbers and dates; no tag makes an object, no key stands twice.

    Raises:
        FileNotFoundError: there is none.
        ValueError: one line: it cannot be read, or holds what is not read here.
    """
    text = read_text(path, LONGEST_YAML)
    try:
        return yaml.load(text, _PlainLoader)
    except (yaml.YAMLError, TypeError, ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())[:200]
        raise UserError(f"{path}: cannot be read: {reason}") from None


def parse_json(text: str) -> Any:
    """JSON; whole numbers of more digits than any of ours are float.

    Raises:
        ValueError: it is none, has a key twice, or too many levels.
    """
    try:
        return json.loads(text, object_pairs_hook=_once, parse_int=_integer)
    except RecursionError:
        raise UserError("lists or mappings within each other, too many levels") from None


class _PlainLoader(yaml.SafeLoader):
    """SafeLoader without tags, which turn one value into another, and without aliases, with which
    a short file can stand for an endless one."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise UserError("aliases (*name) are not read here")
        event: Any = self.peek_event()
        if event.tag is not None or event.anchor is not None:
            raise UserError("tags (!!name) and anchors (&name) are not read here")
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Hashable, Any]:
        names: set[Hashable] = set()
        for key, _ in node.value:
            name = self.construct_object(key, deep=True)
            if name in names:
                raise UserError(f"key {str(name)[:100]!r} stands twice")
            names.add(name)
        return super().construct_mapping(node, deep=deep)


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise UserError("a key stands twice")
    return found


def _integer(text: str) -> int | float:
    return int(text) if len(text) <= _LONGEST_INTEGER else float(text)
