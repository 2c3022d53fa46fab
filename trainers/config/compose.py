"""Composes and changes the configuration of a run."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from pydantic import TypeAdapter

from emberlink.envs.scenarios import fires_of
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import from_plain, shown
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.config.values import GROUPS, change, composed, flat, put


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

    Arguments as for `resolve`; `setup`, `world`, `fire` and `learner` cannot change.
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


def evaluated_with(config: RunConfig, changes: Mapping[str, Any]) -> RunConfig:
    """Returns a configuration with the `world` and its `fire`, then other keys changed."""
    fire = {key: value for key, value in changes.items() if key.startswith("fire.")}
    if fire and "world" not in changes:
        raise UserError(f"{', '.join(fire)}: an evaluation on another fire needs world=NAME, too")
    others = {key: value for key, value in changes.items() if key != "world" and key not in fire}
    return override(in_world(config, str(changes.get("world", config.world)), **fire), **others)


def in_world(config: RunConfig, world: str, **fire: Any) -> RunConfig:
    """Returns a run's configuration in another world, with its fire changed by `fire`.

    Of `env` and `evaluation`, the keys in which the two worlds differ have the values of the other
    world; the run keeps the rest.
    """
    if world == config.world and not fire:
        return config
    setup = f"setup={config.setup}"
    there = resolve(config.method, [setup, f"world={world}"], **fire)
    origin = resolve(config.method, [setup, f"world={config.world}", "fire=paper"])
    if origin.edition != config.edition:
        was = f"{config.world} was trained in edition {config.edition}, which is gone"
        raise UserError(f"world={world}: {was}; known: {origin.edition}")
    values, here = to_values(config), flat(to_values(origin))
    for key, value in flat(to_values(there)).items():
        if key.startswith(("env.", "evaluation.")) and value != here.get(key):
            put(values, key, value)
    changed = from_values(values | {"world": world, "edition": there.edition})
    return replace(changed, fire=there.fire)


def differences(
    one: RunConfig | Mapping[str, Any], other: RunConfig | Mapping[str, Any]
) -> dict[str, tuple[Any, Any]]:
    """Returns the dotted keys of both configurations whose values differ, with both values."""
    first, second = (flat(c if isinstance(c, Mapping) else to_values(c)) for c in (one, other))
    return {key: (v, second[key]) for key, v in first.items() if second.get(key, v) != v}


def from_values(values: Mapping[str, Any]) -> RunConfig:
    """Returns a configuration from plain values, such as the content of a config.yaml."""
    return from_plain(RunConfig, values)


def to_values(config: RunConfig) -> dict[str, Any]:
    """Returns a configuration as plain values, for YAML and trackers."""
    return TypeAdapter(RunConfig).dump_python(config, mode="json")
