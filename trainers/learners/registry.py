"""Finds learners by name: the files of this folder and entry points of other packages."""

import importlib
from collections.abc import Mapping
from pathlib import Path
from pkgutil import iter_modules
from typing import Any

from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.plugins import registered
from emberlink.envs.utils.validation import from_plain, shown

from .base import Learner, LearnerConfig, LearnerContext

_GROUP = "emberlink.learners"
_OTHER_FILES = ("base", "nan_guard", "off_policy", "registry", "replay_buffer", "tensors")


def known() -> list[str]:
    """Returns the names of the learners, in alphabetical order."""
    files = [module.name for module in iter_modules([str(Path(__file__).parent)])]
    return sorted({*files, *registered(_GROUP)} - {*_OTHER_FILES})


def find(name: str) -> type[Learner]:
    """Returns a learner's class.

    Raises:
        UserError: the name is not known, or an entry point cannot be loaded.
    """
    if name not in known():
        raise UserError(f"learner.name={shown(name)!r} is not known; known: {', '.join(known())}")
    points = registered(_GROUP)
    if name in points:
        return points[name].load()
    file = importlib.import_module(f"{__package__}.{name}")
    classes = [
        item
        for item in vars(file).values()
        if isinstance(item, type) and issubclass(item, Learner) and item.__module__ == file.__name__
    ]
    if len(classes) != 1:
        raise UserError(f"learners/{name}.py defines {len(classes)} learners; expected 1")
    return classes[0]


def parse_config(values: Any) -> LearnerConfig:
    """Returns the configuration of the learner that `name` says, from plain values.

    Raises:
        ValueError: the name or a value is wrong.
    """
    if isinstance(values, LearnerConfig):
        return values
    if not isinstance(values, Mapping) or not isinstance(values.get("name"), str):
        raise UserError(f"learner.name is missing; known: {', '.join(known())}")
    return from_plain(find(values["name"]).config_type, values, "learner")


def build(config: LearnerConfig, context: LearnerContext) -> Learner:
    """Returns a new learner."""
    return find(config.name)(config, context)
