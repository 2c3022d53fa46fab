"""Finds executors: the files beside this one, and those of other packages."""

from collections.abc import Mapping
from typing import Any

from emberlink.configs import read
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.plugins import Registry
from emberlink.envs.utils.validation import from_plain

from .base import Executor

_REGISTRY = Registry(Executor, __package__ or "", "executor")
known, find = _REGISTRY.known, _REGISTRY.find


def make(name: str, settings: Mapping[str, Any]) -> Executor:
    """Returns an executor.

    Args:
        name: a file of this folder, or an entry point of other packages.
        settings: values in place of those in configs/executor/NAME.yaml.

    Raises:
        UserError: the name or a key is not known, or a value does not fit.
    """
    executor = find(name)
    values = {key: value for key, value in read("executor", name).items() if key != "name"}
    for key in settings:
        if key not in values:
            listed = ", ".join(f"executor.{one}" for one in values)
            raise UserError(f"key 'executor.{key}' is not known; known: {listed}")
    return executor(from_plain(executor.config_type, {**values, **settings}, "executor"))
