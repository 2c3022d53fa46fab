"""Finds executors by name: files of this folder, and entry points of other packages."""

from typing import Any

from emberlink.envs.utils.config_files import read
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.plugins import Registry
from emberlink.envs.utils.validation import from_plain
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
