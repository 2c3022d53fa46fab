"""Composes and changes the configuration of a run."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from pydantic import TypeAdapter

from emberlink.envs.scenarios import fires_of
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import from_plain, plain, shown
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.config.values import (
    GROUPS,
    change,
    check_not_removed,
    composed,
    flat,
    parse,
    put,
)

__all__ = ["evaluated_with", "flat", "from_values", "in_world", "override", "resolve", "to_values"]


def resolve(method: str, overrides: Sequence[str] = (), **settings: Any) -> RunConfig:
    """Returns the configuration of a method.

    Args:
        method: name of a file in configs/method.
        overrides: texts `key=value`, as on the command line.
        settings: other keys and their values. The last part of a key suffices if it is unique, such
            as `horizon=50` for `env.horizon`.

    Raises:
        UserError: the method, a key or a value is wrong; the message names it and what is known.
    """
    config = from_values(composed(method, overrides, **settings))
    return replace(config, fire=fires_of(config.fire).with_checksum())


def override(config: RunConfig, overrides: Sequence[str] = (), **settings: Any) -> RunConfig:
    """Returns a run's configuration with some values changed, without reading YAML files.

    Args:
        config: configuration of the run.
        overrides: texts `key=value`, as on the command line; `setup`, `world`, `fire` and `learner`
            cannot change.
        settings: as for `resolve`.

    Raises:
        UserError: a key is not known, or a value does not fit.
    """
    values, texts = to_values(config), []
    for text in overrides:
        key, _, name = text.partition("=")
        has = values.get(key)
        has = has["name"] if isinstance(has, dict) else has
        if key in GROUPS and name != has:
            raise UserError(f"{shown(text)}: the run has {key}={has}")
        texts += [] if key in GROUPS else [text]
    change(values, texts, settings)
    changed = from_values(values)
    # The run's own fire also holds the path of the run's copy of a fire file.
    return replace(changed, fire=config.fire) if changed.fire == config.fire else changed


def evaluated_with(config: RunConfig, overrides: Sequence[str]) -> RunConfig:
    """Returns the configuration of an evaluation with other settings than those of the training.

    Args:
        config: configuration of the run.
        overrides: texts `key=value`, as on the command line. `world=NAME` is applied first, with
            keys of `fire`.

    Raises:
        UserError: a key or a value is wrong.
    """
    given = [(text, text.partition("=")[0]) for text in overrides]
    worlds = [str(parse(text)[1]) for text, key in given if key == "world"]
    fire = [text for text, key in given if key.startswith("fire.")]
    others = [text for text, key in given if key != "world" and text not in fire]
    if fire and not worlds:
        raise UserError(f"{shown(fire[0])}: an evaluation on another fire needs world=NAME, too")
    for world in worlds:
        config = in_world(config, world, fire)
    return override(config, others) if others else config


def in_world(config: RunConfig, world: str, fire: Sequence[str] = (), **settings: Any) -> RunConfig:
    """Returns a run's configuration in another world.

    The fire is that of the world. Of `env` and `evaluation`, the keys in which the two worlds
    differ have the values of the other world; the run keeps the rest.

    Args:
        config: configuration of the run.
        world: name of a file in configs/world.
        fire: texts `key=value` of the world's fire, such as `fire.path=ArrivalTime.asc`.
        settings: the same as keyword arguments.

    Raises:
        UserError: the world is not known, or needs other settings.
    """
    if world == config.world and not (fire or settings):
        return config
    setup = f"setup={config.setup}"
    here = flat(to_values(resolve(config.method, [setup, f"world={config.world}", "fire=paper"])))
    there = resolve(config.method, [setup, f"world={world}", *fire], **settings)
    values = to_values(config)
    for key, value in flat(to_values(there)).items():
        if key.startswith(("env.", "evaluation.")) and value != here.get(key):
            put(values, key, value)
    return replace(from_values(values | {"world": world}), fire=there.fire)


def from_values(values: Mapping[str, Any]) -> RunConfig:
    """Returns a configuration from plain values, such as those of a run folder's config.yaml.

    Raises:
        UserError: a key or a value is wrong; the message names the first one and the reason.
    """
    if isinstance(values, Mapping):
        values = {key: value for key, value in values.items() if key != "baselines"}
        for key, value in flat(values).items():
            check_not_removed(key, value)
    return from_plain(RunConfig, values)


def to_values(config: RunConfig) -> dict[str, Any]:
    """Returns a configuration as plain values, for YAML and trackers."""
    return plain(TypeAdapter(RunConfig).dump_python(config))
