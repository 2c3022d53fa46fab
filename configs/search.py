"""Finds the YAML files of configuration groups, installed with emberlink or added by a user.

A group is a folder such as `method` or `fire`; each file in it is one choice of the group.
"""

import os
from collections.abc import Sequence
from importlib.metadata import EntryPoint
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.plugins import registered
from emberlink.envs.utils.validation import unknown

VARIABLE = "EMBERLINK_CONFIGS"
"""the environment variable that lists folders of groups, separated as in PATH"""
ENTRY_POINTS = "emberlink.configs"
"""the entry points of installed packages whose folder holds groups"""


def folders() -> list[Path]:
    """Returns the folders that hold groups: of the environment, of other packages, emberlink's.

    Folders in the environment variable that do not exist are left out, as in PATH.

    Raises:
        UserError: an entry point names a package that is not there.
    """
    listed = [Path(text) for text in os.environ.get(VARIABLE, "").split(os.pathsep) if text]
    plugins = [folder for point in registered(ENTRY_POINTS).values() for folder in _package(point)]
    every = [path.resolve() for path in (*listed, *plugins, Path(__file__).parent)]
    return [path for path in dict.fromkeys(every) if path.is_dir()]


def known(group: str, within: Sequence[Path] | None = None) -> list[str]:
    """Returns the choices of a group, in alphabetical order.

    Args:
        group: such as "method", "setup", "setup_method" or "fire".
        within: the folders to look in; `folders()` if None.
    """
    searched = folders() if within is None else within
    return sorted({file.stem for folder in searched for file in (folder / group).glob("*.yaml")})


def find(group: str, name: str, within: Sequence[Path] | None = None) -> Path:
    """Returns the file of a choice.

    Args:
        group: as for `known`.
        name: the file's name without `.yaml`.
        within: as for `known`.

    Raises:
        UserError: there is no such file, or there are several; the message lists them.
    """
    searched = folders() if within is None else within
    if name not in (names := known(group, searched)):
        raise UserError(f"{group} {unknown(name, names)}")
    files = [folder / group / f"{name}.yaml" for folder in searched]
    found = [file for file in files if file.is_file()]
    if len(found) > 1:
        raise UserError(f"{group} {name!r} is in several folders: {', '.join(map(str, found))}")
    return found[0]


def read(group: str, name: str) -> dict[str, Any]:
    """Returns the content of a choice's file.

    Raises:
        UserError: see `find`; or the file is not YAML with keys and values.
    """
    file = find(group, name)
    try:
        values: Any = OmegaConf.to_container(OmegaConf.create(file.read_text(encoding="utf-8")))
    except (OSError, UnicodeError, YAMLError, OmegaConfBaseException) as error:
        reason = " ".join(str(error).split())[:200]
        raise UserError(f"{file}: cannot be read: {reason}") from None
    if not isinstance(values, dict):
        raise UserError(f"{file}: expected keys and values")
    return values


def _package(point: EntryPoint) -> list[Path]:
    """Returns the folders of the package that an entry point names, without importing it."""
    try:
        spec = find_spec(point.module)
    except ModuleNotFoundError:
        spec = None
    if spec is None or not spec.submodule_search_locations:
        raise UserError(f"entry point {point.name!r} of {ENTRY_POINTS}: no package {point.module}")
    return [Path(folder) for folder in spec.submodule_search_locations]
