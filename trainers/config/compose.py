"""Composes a run's configuration from YAML files and overrides."""

import difflib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from hydra import compose, initialize_config_module
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, QuotedString
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from pydantic import (
    TypeAdapter,
    ValidationError,
)

from emberlink.envs.scenarios import fires_of
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import describe, from_plain, known, plain, shown

from .schema import RunConfig

_GROUPS = ("setup", "fire")


def resolve(method: str, overrides: Sequence[str] = (), **settings: Any) -> RunConfig:
    """The configuration of a recipe.

    Args:
        method: a file in configs/method.
        overrides: `key=value`, as on the command line.
        settings: the same from Python, a key's last part being enough where it is the only one
            so called: `horizon=50` for `env.horizon`.

    Raises:
        ValueError: one line that names the method, key or value that is wrong, and what is known.
    """
    if not isinstance(method, str) or method not in known("method"):
        raise UserError(f"method {_quote(str(method), known('method'))}")
    choices = {"method": method, "setup": "paper"}
    with initialize_config_module(config_module="emberlink.configs", version_base="1.3"):
        _check_overrides(method, overrides, choices)
        try:
            composed = compose("base", overrides=[f"method={method}", *overrides])
            values: Any = OmegaConf.to_container(composed, resolve=True, throw_on_missing=True)
        except (HydraException, OmegaConfBaseException) as error:
            raise UserError(" ".join(str(error).split())[:300]) from None
    if "method" in values:  # then its content did not go to the top
        raise UserError(f"configs/method/{method}.yaml must begin with '# @package _global_'")
    values = {**values, **choices}
    for key, value in settings.items():
        if key in choices:
            raise UserError(f"{key}={shown(value)}: not a setting but a choice of several")
        several = isinstance(value, Iterable) and not isinstance(value, str | bytes | Mapping)
        _set(values, key, plain(list(value) if key == "seeds" and several else value, key))
    if values["seeds"]:
        if "seed" in settings or any(text.startswith("seed=") for text in overrides):
            raise UserError(f"seed={values['seed']} and seeds={values['seeds']}: give one of them")
        if isinstance(values["seeds"], list | tuple):
            values["seed"] = values["seeds"][0]
    config = from_values(values)
    return replace(config, fire=fires_of(config.fire).with_checksum())


def override(config: RunConfig, overrides: Sequence[str]) -> RunConfig:
    """A configuration with some values changed.

    Args:
        config: of a run.
        overrides: `key=value`, as on the command line; `setup` and `fire` must be what they are.

    Raises:
        ValueError: a key is not known, or a value does not fit.
    """
    values = to_values(config)
    known_keys = list(flat(values))
    for text in overrides:
        key, value = _parsed(text)
        if key in _GROUPS:
            there = config.setup if key == "setup" else config.fire.name
            if str(value) != there:
                raise UserError(f"{text}: the run has {key}={there}")
        elif key not in known_keys:
            raise UserError(f"key {_quote(key, known_keys, listed=False)}")
        else:
            _set(values, key, value)
    changed = from_values(values)
    # As it was opened: with the run's own copy of the fires.
    return replace(changed, fire=config.fire) if changed.fire == config.fire else changed


def _parsed(text: str) -> tuple[str, Any]:
    """Key and value of one `key=value`."""
    parsed = _override(text)
    value: Any = parsed.value()
    return parsed.key_or_group, value.text if isinstance(value, QuotedString) else value


def _override(text: str) -> Override:
    """What Hydra makes of one `key=value`."""
    try:
        parsed = OverridesParser.create().parse_override(text)
    except (HydraException, ValueError, RecursionError):
        raise UserError(f"{shown(text)!r} is not of the form key=value") from None
    adds = parsed.is_add() or parsed.is_force_add()
    if parsed.is_delete() or adds or parsed.is_sweep_override():
        raise UserError(f"{shown(text)!r}: only key=value with one value is understood here")
    return parsed


def _set(values: dict[str, Any], key: str, value: Any) -> None:
    """Sets the one value whose dotted key is, or ends in, `key`.

    Of a mapping, what it holds and nothing else; but another communication module takes the place
    of the one that was there.
    """
    names = list(_flat(values))
    found = [name for name in names if name == key] or [
        name for name in names if name.endswith("." + key)
    ]
    if len(found) != 1:
        among = f" is one of {', '.join(found)}: say which" if found else ""
        raise UserError(f"key {key!r}{among}" if found else f"key {_quote(key, names)}")
    *path, last = found[0].split(".")
    for part in path:
        values = values[part]
    there = values[last]
    both = isinstance(there, dict) and isinstance(value, dict)
    if not both or there.get("name") != value.get("name", there.get("name")):
        values[last] = value
        return
    for name, one in value.items():
        if name not in there:
            raise UserError(f"key {_quote(f'{found[0]}.{name}', names)}")
        _set(values, f"{last}.{name}", one)


def from_values(values: Mapping[str, Any]) -> RunConfig:
    """A configuration from plain values, such as a run folder's config.yaml.

    Raises:
        ValueError: one line that names the first key that is wrong, its value and what is wrong.
    """
    try:
        return from_plain(RunConfig, values)
    except ValidationError as error:
        raise UserError(describe(error)) from None


def to_values(config: RunConfig) -> dict[str, Any]:
    """The configuration as plain values, for YAML and trackers."""
    return _lists(TypeAdapter(RunConfig).dump_python(config))


def _lists(value: Any) -> Any:
    """Lists for tuples, within mappings too; infinite numbers stay, as they would not in JSON."""
    if isinstance(value, Mapping):
        return {key: _lists(one) for key, one in value.items()}
    return [_lists(one) for one in value] if isinstance(value, list | tuple) else value


def _check_overrides(method: str, overrides: Sequence[str], choices: dict[str, str]) -> None:
    """Finds what Hydra would explain at length, and writes down which groups were chosen."""
    others: list[str] = []
    for text in overrides:
        parsed = _override(text)
        key = parsed.key_or_group
        if isinstance(parsed.value(), dict):
            raise UserError(f"{shown(text)!r}: give its keys one by one, as {key}.KEY=VALUE")
        if key in ("fire.name", "fire.kind"):
            raise UserError(f"{shown(text)!r}: a scenario is chosen with fire=NAME")
        if key in _GROUPS:
            chosen = str(parsed.value())
            if chosen not in known(key):
                raise UserError(f"{key} {_quote(chosen, known(key))}")
            choices[key] = chosen
        else:
            others.append(key)
    keys = _known_keys(method, choices) if others else []
    for key in others:
        if key not in keys:
            raise UserError(f"key {_quote(key, keys, listed=False)}")
    choices.pop("fire", None)


def _known_keys(method: str, choices: dict[str, str]) -> list[str]:
    chosen = [f"{group}={choices[group]}" for group in _GROUPS if group in choices]
    composed = compose("base", overrides=[f"method={method}", *chosen])
    return list(dict.fromkeys([*_GROUPS, *_flat(OmegaConf.to_container(composed))]))


def _flat(values: Any, prefix: str = "") -> Iterator[str]:
    for key, value in values.items():
        yield prefix + key
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}.")


def flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested values by dotted key."""
    found: dict[str, Any] = {}
    for key, value in values.items():
        found |= (
            flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
        )
    return found


def _quote(value: str, among: Sequence[str], *, listed: bool = True) -> str:
    """`value`, that it is unknown, and the near or all known ones."""
    leaves = {name.rsplit(".", 1)[-1]: name for name in among}
    near = difflib.get_close_matches(value, among, n=1)
    near = near or [leaves[m] for m in difflib.get_close_matches(value, leaves, n=1)]
    hint = f"; did you mean {near[0]}?" if near else ""
    if listed:
        hint += f" known: {', '.join(among)}" if hint else f"; known: {', '.join(among)}"
    elif not near:
        hint = f"; known: {', '.join(name for name in among if '.' not in name)}"
    return f"{shown(value)!r} is not known{hint}"
