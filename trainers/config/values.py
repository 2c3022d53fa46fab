"""Composes a run's values from YAML files and `key=value` texts.

Imports no torch, so that a wrong name or key is reported at once.
"""

import math
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from functools import lru_cache, reduce
from operator import getitem
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_module
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from hydra.version import VersionBase
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from emberlink.envs.utils import config_files
from emberlink.envs.utils.config_files import find, read
from emberlink.envs.utils.errors import UserError, naming, shown, unknown
from emberlink.envs.utils.validation import plain

GROUPS = ("setup", "world", "fire", "learner")
"""groups whose file is chosen by `GROUP=NAME`, besides the method"""
_HYDRA = threading.RLock()


def composed(method: str, overrides: Sequence[str] = (), **settings: Any) -> dict[str, Any]:
    """Returns the values of a method's run, whose types and ranges are not checked.

    `overrides` are texts `key=value`, as on the command line; see `full_key` for `settings`.
    """
    names = {"method": str(method), "setup": "paper", "world": "paper"}
    chosen = [text for text in overrides if text.partition("=")[0] in GROUPS]
    names |= {key: str(name) for key, name in map(parse, chosen)}
    values = _from_files(names)
    _drop_settings_of_others(values["learner"])
    change(values, [text for text in overrides if text not in chosen], settings)
    values = _interpolated(values)
    return values | {group: names[group] for group in ("method", "setup", "world")}


def _drop_settings_of_others(learner: dict[str, Any]) -> None:
    """Removes settings of other learners that a setup holds, such as `critic_lr` for PPO."""
    own = _keys_of(learner["name"])
    if learner.keys() - own:
        others = set().union(*map(_keys_of, config_files.known("learner")))
        for key in learner.keys() & others - own:
            del learner[key]


def _keys_of(learner: str) -> set[str]:
    """Returns the keys in the file of a learner and in the files of its `defaults`."""
    values = read("learner", learner)
    bases = [base for base in values.pop("defaults", ()) if base != "_self_"]
    return values.keys() | {key for base in bases for key in _keys_of(base)}


def change(
    values: dict[str, Any], overrides: Sequence[str] = (), settings: Mapping[str, Any] | None = None
) -> None:
    """Sets values by texts `key=value` and by keyword arguments."""
    known = list(all_keys(values))
    given = [parse(text) for text in overrides]
    given += [(full_key(known, name), plain(value)) for name, value in (settings or {}).items()]
    for key, value in given:
        group, _, last = key.partition(".")
        masks = (key, value) == ("fire.kind", "masks")  # of a file
        if group in GROUPS and last in ("", "name", "kind") and not masks:
            raise UserError(f"{key}={shown(value)}: choose it with {group}=NAME")
        if key not in known:
            raise UserError(unknown_key(key, known))
        put(values, key, value)


def parse(text: str) -> tuple[str, Any]:
    """Returns the key and the value of `key=value` by Hydra's grammar.

    A value that the grammar cannot read, as in `output=Läufe`, is a text.
    """
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise UserError(f"{shown(text)!r} is not of the form key=value")
    if (override := parsed(text)) is None:
        return key, value
    if override.is_sweep_override():
        raise UserError(
            f"{shown(text)!r}: only one value is possible here; a list stands in brackets, several "
            "runs are a sweep (emberlink sweep --help)"
        )
    given = override.value()
    # As in the files; Hydra's grammar knows `inf` only.
    return override.get_key_element(), math.inf if given == ".inf" else given


def parsed(text: str) -> Override | None:
    """Returns Hydra's view of `key=value`; None if its grammar cannot read the text."""
    try:
        return OverridesParser.create().parse_override(text)
    except (HydraException, ValueError, RecursionError):
        return None


def put(values: dict[str, Any], key: str, value: Any) -> None:
    """Sets the value of a dotted key.

    A mapping changes only the keys that it holds. If it has another `name`, as in `comm`, it
    replaces the whole mapping.
    """
    *path, last = key.split(".")
    parent = reduce(getitem, path, values)
    old = parent.get(last)
    both = isinstance(old, dict) and isinstance(value, Mapping)
    if both and old.get("name") == value.get("name", old.get("name")):  # pyright: ignore
        for name, item in value.items():
            put(values, f"{key}.{name}", item)
    else:
        parent[last] = value


def full_key(known: Sequence[str], key: str) -> str:
    """Returns the known key that equals `key`, or else the only one that ends with it.

    The key itself if there is none.
    """
    if key in known:
        return key
    matching = [name for name in known if name.endswith(f".{key}")]
    if len(matching) > 1:
        raise UserError(f"key {key!r} is ambiguous: {', '.join(matching)}")
    return matching[0] if matching else key


def unknown_key(key: str, known: Iterable[str]) -> str:
    """Returns a message that a key is not known, with keys of the same end or those beside it."""
    names = list(known)
    parent, _, last = key.rpartition(".")
    if near := [name for name in names if name.endswith((f".{last}", f"_{last}"))]:
        return f"key {shown(key)!r} is not known; did you mean {' or '.join(near[:4])}?"
    beside = [name for name in names if name.rpartition(".")[0] == parent * (parent in names)]
    return f"key {unknown(key, beside)}"


def all_keys(values: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """Yields the dotted keys of nested mappings, inner mappings included."""
    for key, value in values.items():
        yield f"{prefix}{key}"
        if isinstance(value, Mapping):
            yield from all_keys(value, f"{prefix}{key}.")


def flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Returns the values of nested mappings by dotted key."""
    result: dict[str, Any] = {}
    for key, value in values.items():
        nested = isinstance(value, Mapping)
        result |= flat(value, f"{prefix}{key}.") if nested else {f"{prefix}{key}": value}
    return result


def _from_files(names: Mapping[str, str]) -> dict[str, Any]:
    """Returns the values that Hydra composes from the files of groups, with `${...}` in them."""
    own = f"{names['setup']}_{names['method']}"
    more = {"setup_method": own} if own in config_files.known("setup_method") else {}
    for group, name in {**names, **more}.items():
        find(group, name)
    folders = config_files.folders()
    files = sorted(file for folder in folders for file in folder.glob("**/*.yaml"))
    # Editors lock a file with a link to nowhere.
    stamps = tuple((file, file.stat().st_mtime_ns) for file in files if file.is_file())
    values = deepcopy(_compose(tuple(names.items()), tuple(folders), stamps))
    for group in ("method", "setup", "world"):
        if group in values:  # without the header, Hydra puts the content under the group
            raise UserError(f"{find(group, names[group])} must begin with '# @package _global_'")
    return values


@lru_cache(maxsize=256)
def _compose(
    names: tuple[tuple[str, str], ...], folders: tuple[Path, ...], stamps: tuple
) -> dict[str, Any]:
    """Calls Hydra, which takes 0.2 s, if a name or the modification time of a file is new."""
    # The last folder is emberlink's own, which Hydra searches anyway.
    paths = ["'file://" + str(folder).replace("'", "\\'") + "'" for folder in folders[:-1]]
    overrides = [f"{group}={name}" for group, name in names]
    with (
        naming("the configuration", HydraException, OmegaConfBaseException, YAMLError),
        _own_hydra(),
    ):
        whole = compose("base", [*overrides, f"hydra.searchpath=[{','.join(paths)}]"])
        values: Any = OmegaConf.to_container(whole)
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
    with naming("the configuration", OmegaConfBaseException):
        whole = OmegaConf.create(values)
        resolved: Any = OmegaConf.to_container(whole, resolve=True, throw_on_missing=True)
    return resolved
