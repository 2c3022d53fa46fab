"""Finds learners by name: the files of this folder and entry points of other packages."""

from collections.abc import Mapping
from typing import Any

from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.plugins import Registry
from emberlink.envs.utils.validation import from_plain

from .base import Learner, LearnerConfig, LearnerContext

_REGISTRY = Registry(
    Learner,
    "emberlink.trainers.learners",
    "learner.name",
    other_files=("base", "nan_guard", "off_policy", "registry", "replay_buffer", "tensors"),
    group="emberlink.learners",
)
known, find = _REGISTRY.known, _REGISTRY.find


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
