"""Finds the methods and learners that a setting belongs to."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import fields
from typing import Any

from emberlink import configs
from emberlink.envs.utils.config_files import read
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import unknown
from emberlink.trainers.config.overrides import all_keys
from emberlink.trainers.learners import registry as learners


def not_known(key: str, known: Sequence[str], method: str, learner: str) -> str:
    """Returns a message that a key is not known, with the methods or learners that have it."""
    of_learners = _learners_with(key)
    if of_learners:
        return f"key {key!r} is a setting of learner {', '.join(of_learners)}, not of {learner}"
    others = []
    for name in configs.known("method"):
        with suppress(UserError):  # a file that cannot be read is an error only where it is chosen
            others += [name] if key in all_keys(read("method", name)) else []
    if others:
        return f"key {key!r} is a setting of method {', '.join(others)}, not of {method}"
    return f"key {unknown(key, known, listed=False)}"


def drop_settings_of_others(learner: Any) -> None:
    """Removes the settings that a setup gives to another learner, such as `critic_lr` for DDPG.

    A setting that no learner has stays, and is an error later.
    """
    if not isinstance(learner, dict) or learner.get("name") not in learners.known():
        return
    foreign = learner.keys() - _settings_of(learner["name"])
    for other in learners.known() if foreign else ():
        # Another package's learner that cannot be imported is an error only where it is chosen.
        with suppress(UserError):
            for name in foreign & _settings_of(other) & learner.keys():
                del learner[name]


def _learners_with(key: str) -> list[str]:
    """Returns the names of the learners that have a key."""
    group, _, setting = key.partition(".")
    names = []
    for name in configs.known("learner") if group == "learner" else []:
        with suppress(UserError):  # as in `not_known`
            names += [name] if setting in _settings_of(name) else []
    return names


def _settings_of(learner: str) -> set[str]:
    """Returns the names of a learner's settings."""
    return {field.name for field in fields(learners.find(learner).config_type)}
