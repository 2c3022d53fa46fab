"""Changes settings of a trained run for an evaluation, also its world."""

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import shown
from emberlink.trainers.config.compose import from_values, override, resolve, to_values, with_radio
from emberlink.trainers.config.overrides import flat, parse, put
from emberlink.trainers.config.schema import RunConfig

_OF_A_WORLD = ("env.", "evaluation.")
"""prefixes of the keys that a world sets, besides its fire"""


def evaluated_with(config: RunConfig, overrides: Sequence[str]) -> RunConfig:
    """Returns the configuration of an evaluation with other settings than those of the training.

    Args:
        config: configuration of the run.
        overrides: texts `key=value`, as on the command line. `world=NAME` is applied first, with
            keys of `fire`.

    Raises:
        UserError: a key or a value is wrong.
    """
    worlds = [str(value) for key, value in map(parse, overrides) if key == "world"]
    fire = _of_the_fire(overrides)
    others = [text for text in overrides if parse(text)[0] != "world" and text not in fire]
    if fire and not worlds:
        raise UserError(f"{shown(fire[0])}: an evaluation on another fire needs world=NAME, too")
    for world in worlds:
        config = in_world(config, world, fire)
    return override(config, others) if others else config


def _of_the_fire(overrides: Sequence[str]) -> list[str]:
    return [text for text in overrides if text.startswith("fire.")]


def kept(config: RunConfig, overrides: Sequence[str]) -> list[str]:
    """Returns settings of `env`, as `key=value`, that a run keeps in the world of an evaluation.

    These are the settings in which the evaluation differs from a run of its setup in that world,
    apart from those that are changed. There are none without `world=NAME`.

    Args:
        config: result of `evaluated_with`.
        overrides: its overrides.
    """
    changed = [parse(text)[0] for text in overrides]
    if "world" not in changed:
        return []
    usual, own = flat(to_values(_usual(config))), flat(to_values(config))
    return [
        f"{key}={shown(value)}"
        for key, value in own.items()
        if key.startswith("env.") and key not in changed and value != usual[key]
    ]


def _usual(config: RunConfig) -> RunConfig:
    """Returns the configuration of a run's method, setup and world; any fire will do."""
    return resolve(config.method, [f"setup={config.setup}", f"world={config.world}", "fire=paper"])


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
    here = flat(to_values(_usual(config)))
    chosen = [f"setup={config.setup}", f"world={world}"]
    there = resolve(config.method, [*chosen, *fire], **settings)
    values = to_values(config)
    del values["baselines"]
    for key, value in flat(to_values(there)).items():
        if key.startswith(_OF_A_WORLD) and value != here.get(key):
            put(values, key, value)
    changed = from_values(values | {"world": world})
    changed = replace(changed, fire=there.fire, baselines=there.baselines)
    return with_radio(changed, asdict(there.env.radio))
