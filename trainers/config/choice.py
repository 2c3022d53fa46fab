"""Validates settings of the form `{"name": NAME, ...}` with the configuration type of a class.

`comm` and `learner` have this form: each file in comm/ and in trainers/learners/ defines a class
with its own settings.
"""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import from_plain, shown


def settings(key: str, values: Any, registry: Any) -> Any:
    """Returns the settings as an instance of the named class's `config_type`.

    Args:
        key: key of the settings in the configuration, for messages.
        values: name and settings as plain values, or an instance of a `config_type`.
        registry: module with `known()` and `find(name)`; each class has a `config_type`.

    Raises:
        UserError: the name or a setting is missing or not known, or a value does not fit.
    """
    if not isinstance(values, Mapping):
        if is_dataclass(values):
            return values
        raise UserError(f"{key}={shown(values)}: expected keys and values")
    if not isinstance(values.get("name"), str):
        raise UserError(f"{key}.name is missing; known: {', '.join(registry.known())}")
    config_type = registry.find(values["name"]).config_type
    known = [field.name for field in fields(config_type)]
    # A type may have the name among its fields.
    given = {name: value for name, value in values.items() if name != "name" or name in known}
    for name in given.keys() - set(known):
        listed = ", ".join(known) or "none"
        raise UserError(f"{key}.{name} is not a setting of {values['name']}; known: {listed}")
    return from_plain(config_type, given, key)
