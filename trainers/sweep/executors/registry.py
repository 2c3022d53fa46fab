"""Finds executors by name: files of this folder, and entry points of other packages."""

from collections.abc import Mapping
from types import UnionType
from typing import Any, get_type_hints

import yaml

from emberlink.envs.utils.config_files import read
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.plugins import Registry
from emberlink.envs.utils.validation import from_plain, shown
from emberlink.trainers.sweep.executors.base import Executor

_REGISTRY = Registry(
    Executor, "emberlink.trainers.sweep.executors", "executor", group="emberlink.executors"
)
known, find = _REGISTRY.known, _REGISTRY.find


def make(name: str, settings: dict[str, Any]) -> Executor:
    """Returns a new executor.

    Args:
        name: name of a file in this folder, or of an entry point of `emberlink.executors`.
        settings: values that replace those of configs/executor/NAME.yaml.

    Raises:
        UserError: the name or a key is not known, or a value is wrong.
    """
    executor = _REGISTRY.find(name)
    values = {key: value for key, value in read("executor", name).items() if key != "name"}
    for key, value in settings.items():
        if key not in values:
            listed = ", ".join(f"executor.{other}" for other in values)
            raise UserError(f"key 'executor.{key}' is not known; known: {listed}")
        values[key] = value
    return executor(from_plain(executor.config_type, values, "executor"))


def from_texts(name: str, texts: Mapping[str, str]) -> Executor:
    """Returns a new executor with the settings of a command line.

    Args:
        name: see `make`.
        texts: key -> value. It is read as YAML, unless the setting may be a text: an account 007
            or a time 4:00:00 are not numbers.

    Raises:
        UserError: the name or a key is not known, or a value is wrong.
    """
    hints = get_type_hints(_REGISTRY.find(name).config_type)
    return make(name, {key: _value(hints.get(key), key, text) for key, text in texts.items()})


def _value(hint: Any, key: str, text: str) -> Any:
    choices = hint.__args__ if isinstance(hint, UnionType) else (hint,)
    if str in choices and text not in ("", "null"):
        return text
    try:
        return yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError):
        raise UserError(f"executor.{key}={shown(text)} is not YAML") from None
