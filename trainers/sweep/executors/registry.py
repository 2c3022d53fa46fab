"""The executors: the files beside this one, each with a YAML file in configs/executor."""

import importlib
from importlib.resources import files
from pathlib import Path
from pkgutil import iter_modules
from typing import Any

import yaml
from pydantic import ValidationError

from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import describe, from_plain

from .base import Executor

_NO_EXECUTORS = ("base", "registry")


def known() -> list[str]:
    """Returns the names of the executors, in alphabetical order."""
    names = [module.name for module in iter_modules([str(Path(__file__).parent)])]
    return sorted(n for n in names if n not in _NO_EXECUTORS and not n.startswith("_"))


def make(name: str, settings: dict[str, Any]) -> Executor:
    """Returns an executor.

    Args:
        name: a file of this folder.
        settings: values in place of those in configs/executor/NAME.yaml.

    Raises:
        UserError: the name or a key is not known, or a value does not fit.
    """
    if name not in known():
        raise UserError(f"executor={name!r} is not known; known: {', '.join(known())}")
    file = importlib.import_module(f"{__package__}.{name}")
    (executor,) = (
        item
        for item in vars(file).values()
        if isinstance(item, type) and issubclass(item, Executor) and item is not Executor
    )
    values: dict[str, Any] = _defaults(name)
    for key, value in settings.items():
        if key not in values:
            listed = ", ".join(f"executor.{one}" for one in values)
            raise UserError(f"key 'executor.{key}' is not known; known: {listed}")
        values[key] = value
    try:
        return executor(from_plain(executor.config_type, values))
    except ValidationError as error:
        raise UserError(describe(error, "executor")) from None


def _defaults(name: str) -> dict[str, Any]:
    text = files("emberlink.configs").joinpath("executor", f"{name}.yaml").read_text("utf-8")
    return {key: value for key, value in yaml.safe_load(text).items() if key != "name"}
