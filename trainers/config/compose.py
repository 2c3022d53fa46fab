"""Composes a run's configuration from YAML files and the user's settings."""

import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import asdict, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_module
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from hydra.version import VersionBase
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from pydantic import TypeAdapter
from yaml import YAMLError

from emberlink import configs
from emberlink.envs.scenarios import fires_of
from emberlink.envs.utils.config_files import find, place_of, read
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import from_plain, plain, shown, unknown
from emberlink.policies.scripted.registry import SCRIPTED
from emberlink.trainers.config.overrides import all_keys, flat, full_key, parse, put
from emberlink.trainers.config.owners import drop_settings_of_others, not_known
from emberlink.trainers.config.schema import Baseline, RunConfig

GROUPS = ("setup", "world", "fire", "learner")
"""groups whose file is chosen by `GROUP=NAME`, besides the method"""
_HYDRA = threading.RLock()


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
    if isinstance(overrides, str):
        raise UserError(f"{shown(overrides)!r}: expected a list of texts key=value")
    given = [parse(text) for text in overrides]
    chosen = {"setup": "paper", "world": "paper"} | {
        key: str(value) for key, value in given if key in GROUPS
    }
    values = _composed(str(method), chosen)
    drop_settings_of_others(values["learner"])
    radio = _radio(values)
    known = list(dict.fromkeys([*GROUPS, *all_keys(values)]))
    for key, value in given:
        if key in (*(f"{group}.name" for group in GROUPS), "fire.kind"):
            group = key.partition(".")[0]
            raise UserError(f"{key}={shown(value)}: choose it with {group}=NAME")
        if key not in known:
            raise UserError(not_known(key, known, method, values["learner"]["name"]))
        if key not in GROUPS:
            put(values, key, value)
    values = _interpolated(values) | {"method": method, "setup": chosen["setup"]}
    values["world"] = chosen["world"]
    _put_settings(values, settings)
    _choose_seed(values, any(key == "seed" for key in [*dict(given), *settings]))
    try:
        config = from_values(values)
    except UserError as error:
        given_keys = {key for key, _ in given} | settings.keys()
        own = f"{chosen['setup']}_{method}"
        files = {"setup_method": own} if own in configs.known("setup_method") else {}
        files |= {"method": method, **chosen}
        raise UserError(place_of(error, files, given_keys)) from None
    baselines = _baselines(chosen, _changes(radio, _radio(values)))
    return replace(config, baselines=baselines, fire=fires_of(config.fire).with_checksum())


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
    values = to_values(config)
    del values["baselines"]
    radio = _radio(values)
    known = list(flat(values))
    for key, value in map(parse, overrides):
        if key in GROUPS:
            name = values[key]["name"] if isinstance(values[key], dict) else values[key]
            if str(value) != name:
                raise UserError(f"{key}={shown(value)}: the run has {key}={name}")
        elif key not in known:
            raise UserError(f"key {unknown(key, known, listed=False)}")
        else:
            put(values, key, value)
    _put_settings(values, settings)
    changed = from_values(values)
    changed = with_radio(replace(changed, baselines=config.baselines), radio)
    # The run's own fire also holds the path of the run's copy of a fire file.
    return replace(changed, fire=config.fire) if changed.fire == config.fire else changed


def with_radio(config: RunConfig, usual: Mapping[str, Any]) -> RunConfig:
    """Returns a configuration whose other methods have the run's changes of the radio, too.

    Args:
        config: configuration of a run.
        usual: settings of the radio without the changes.
    """
    other = _changes(usual, asdict(config.env.radio))
    baselines = {
        method: replace(baseline, radio=replace(baseline.radio, **other))
        for method, baseline in config.baselines.items()
    }
    return replace(config, baselines=baselines)


def from_values(values: Mapping[str, Any]) -> RunConfig:
    """Returns a configuration from plain values, such as those of a run folder's config.yaml.

    Raises:
        UserError: a key or a value is wrong; the message names the first one and the reason.
    """
    return from_plain(RunConfig, values)


def to_values(config: RunConfig) -> dict[str, Any]:
    """Returns a configuration as plain values, for YAML and trackers."""
    return _lists(TypeAdapter(RunConfig).dump_python(config))


def _lists(value: Any) -> Any:
    """Returns a value with lists in place of tuples; unlike JSON, it keeps infinite numbers."""
    if isinstance(value, Mapping):
        return {key: _lists(item) for key, item in value.items()}
    return [_lists(item) for item in value] if isinstance(value, list | tuple) else value


def _composed(method: str, chosen: Mapping[str, str]) -> dict[str, Any]:
    """Returns the values that Hydra composes from the chosen files, without resolving `${...}`.

    Args:
        method: name of a file in configs/method.
        chosen: group -> name of the chosen file, for the setup and other `GROUPS`.

    Raises:
        UserError: a file is not known or not a configuration.
    """
    folders = configs.folders()
    chosen = {"method": method, **chosen}
    for group, name in chosen.items():
        find(group, name, folders)
    if (name := f"{chosen['setup']}_{method}") in configs.known("setup_method", folders):
        find("setup_method", name, folders)
    files = sorted(file for folder in folders for file in folder.glob("**/*.yaml"))
    # Editors lock a file with a link to nowhere.
    stamps = tuple((file, file.stat().st_mtime_ns) for file in files if file.is_file())
    values = deepcopy(_compose(tuple(chosen.items()), tuple(folders), stamps))
    for group in ("method", "setup", "world"):
        if group in values:  # without the header, Hydra puts the content under the group
            file = find(group, chosen[group])
            raise UserError(f"{file} must begin with '# @package _global_'")
    return values


@lru_cache(maxsize=256)
def _compose(
    chosen: tuple[tuple[str, str], ...], folders: tuple[Path, ...], stamps: tuple
) -> dict[str, Any]:
    """Calls Hydra; results are cached by the choices and the modification times of all files."""
    # The last folder is emberlink's own, which Hydra searches anyway.
    paths = ["'file://" + str(folder).replace("'", "\\'") + "'" for folder in folders[:-1]]
    overrides = [f"{group}={name}" for group, name in chosen]
    try:
        with _own_hydra():
            composed = compose("base", [*overrides, f"hydra.searchpath=[{','.join(paths)}]"])
            values: Any = OmegaConf.to_container(composed)
    except (HydraException, OmegaConfBaseException, YAMLError) as error:
        raise UserError(" ".join(str(error).split())[:300]) from None
    except UnicodeError as error:
        for group, name in chosen:
            read(group, name)  # raises an error that names the file
        raise UserError(str(error)) from None
    return values


@contextmanager
def _own_hydra() -> Iterator[None]:
    """Initialises Hydra for one composition, then restores the caller's state of Hydra."""
    with _HYDRA:
        callers, version = GlobalHydra.instance().hydra, VersionBase.instance().getbase()
        GlobalHydra.instance().clear()
        try:
            with initialize_config_module(config_module="emberlink.configs", version_base="1.3"):
                yield
        finally:
            GlobalHydra.instance().hydra = callers
            VersionBase.instance().version_base = version


def _interpolated(values: dict[str, Any]) -> dict[str, Any]:
    """Returns the values with each `${key}` replaced by the value of the key."""
    if not any(mark in str(values) for mark in ("${", "???")):
        return values  # OmegaConf takes several milliseconds.
    try:
        whole: Any = OmegaConf.to_container(
            OmegaConf.create(values), resolve=True, throw_on_missing=True
        )
    except OmegaConfBaseException as error:
        raise UserError(" ".join(str(error).split())[:300]) from None
    return whole


def _put_settings(values: dict[str, Any], settings: Mapping[str, Any]) -> None:
    """Sets the values of keyword arguments."""
    for key, value in settings.items():
        if key in ("method", *GROUPS):
            raise UserError(f"{key}={shown(value)}: names a file, so it is not a setting")
        put(values, full_key(values, key), plain(value, key))


def _baselines(chosen: Mapping[str, str], radio: Mapping[str, Any]) -> dict[str, Baseline]:
    """Returns the settings of the methods whose communication scripted policies use.

    Args:
        chosen: group -> name of the chosen file.
        radio: settings of the radio that the user changed; they hold for all methods.

    Returns:
        method -> its communication.
    """
    methods = {policy.recipe for policy in SCRIPTED.values() if policy.recipe}
    groups = {group: chosen[group] for group in ("setup", "world")}
    baselines = {}
    for method in sorted(methods):
        values = _interpolated(_composed(method, groups))
        settings = {"comm": values["comm"], "radio": values["env"]["radio"] | radio}
        baselines[method] = from_plain(Baseline, settings, f"baselines.{method}")
    return baselines


def _radio(values: Mapping[str, Any]) -> dict[str, Any]:
    """Returns a copy of the settings of the radio; empty if a user has replaced them by a value."""
    env = values["env"]
    radio = env.get("radio") if isinstance(env, Mapping) else None
    return dict(radio) if isinstance(radio, Mapping) else {}


def _changes(before: Mapping[str, Any], after: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the values of `after` that differ from those of `before`."""
    return {key: value for key, value in after.items() if value != before.get(key)}


def _choose_seed(values: dict[str, Any], seed_is_given: bool) -> None:
    """Sets `seed` to the first of `seeds`, if `seeds` is not empty.

    Raises:
        UserError: the user gave both.
    """
    seeds = values["seeds"]
    if seeds and seed_is_given:
        raise UserError(f"seed={values['seed']} and seeds={seeds}: give only one of them")
    if seeds and isinstance(seeds, list):
        values["seed"] = seeds[0]
