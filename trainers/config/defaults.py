"""Looks up the settings that a run would have if none had been given."""

from contextlib import suppress
from typing import Any

from emberlink.envs.fire_files.config import FileFireConfig
from emberlink.envs.utils.errors import UserError
from emberlink.trainers.config.compose import resolve, to_values
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.config.values import flat


def defaults_of(config: RunConfig) -> dict[str, Any]:
    """Returns the default settings of a run's method, setup, world, fire and learner.

    `learner.name` is that of the setup. Settings of what is not installed are left out, and those
    of a fire from a file, which has no default.

    Args:
        config: configuration of the run.

    Returns:
        dotted key -> value.
    """
    from_file = isinstance(config.fire, FileFireConfig)
    fire = "paper" if from_file else config.fire.name
    choices = [f"setup={config.setup}", f"world={config.world}", f"fire={fire}"]
    defaults: dict[str, Any] = {}
    for more in ([f"learner={config.learner.name}"], []):
        with suppress(UserError):
            usual = flat(to_values(resolve(config.method, [*choices, *more])))
            defaults = (defaults or usual) | {"learner.name": usual["learner.name"]}
    return {k: v for k, v in defaults.items() if not (from_file and k.startswith("fire."))}
