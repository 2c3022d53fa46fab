"""Finds and reads YAML files of configuration groups."""

import copy
import re
from collections.abc import Collection, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from emberlink.configs import folders, known
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import unknown

_KEY = re.compile(r"(?:key ')?([a-z_]+(?:\.\w+)*)")
_NONE = object()


def find(group: str, name: str, within: Sequence[Path] | None = None) -> Path:
    """Returns the path of a configuration file.

    Args:
        group: name of the group, such as "method", "setup", "setup_method" or "fire".
        name: name of the file without `.yaml`.
        within: the folders to search; those of `emberlink.configs.folders` if None.

    Raises:
        UserError: there is no such file, or several folders have one.
    """
    searched = folders() if within is None else within
    if name not in (names := known(group, searched)):
        raise UserError(f"{group} {unknown(name, names)}")
    files = [folder / group / f"{name}.yaml" for folder in searched]
    existing = [file for file in files if file.is_file()]
    if len(existing) != 1:
        raise UserError(f"{group} {name!r} is in several folders: {', '.join(map(str, existing))}")
    return existing[0]


def place_of(error: Exception, chosen: Mapping[str, str], given: Collection[str]) -> str:
    """Returns an error's message, with the user's file in front in which its key stands, if any.

    Args:
        error: begins with the key of the configuration that is wrong.
        chosen: group -> name of the chosen file.
        given: keys that the user gave elsewhere, such as on the command line.
    """
    text = str(error)
    key = _KEY.match(text)
    if key is None or key[1] in given:
        return text
    own = folders()[-1]
    for group, name in chosen.items():
        file = find(group, name)
        value: Any = read(group, name)
        parts = key[1].split(".")
        # Files of fires and learners hold the keys below the name of their group.
        for part in parts[1:] if group in ("fire", "learner") and parts[0] == group else parts:
            if not isinstance(value, list):  # the numbers of a list stand in one file
                value = value.get(part, _NONE) if isinstance(value, dict) else _NONE
        if value is not _NONE and own not in file.parents:
            return f"{file}: {text}"
    return text


def read(group: str, name: str) -> dict[str, Any]:
    """Returns the content of a configuration file.

    Args:
        group: name of the group.
        name: name of the file without `.yaml`.

    Raises:
        UserError: there is no such file, or it does not hold keys and values.
    """
    file = find(group, name)
    try:
        about = file.stat()
        values = copy.deepcopy(_parsed(file, about.st_mtime_ns, about.st_size))
    except (OSError, UnicodeError, YAMLError, OmegaConfBaseException) as error:
        reason = " ".join(str(error).split())[:200]
        raise UserError(f"{file}: cannot be read: {reason}") from None
    if not isinstance(values, dict):
        raise UserError(f"{file}: expected keys and values")
    return values


@lru_cache(maxsize=256)
def _parsed(file: Path, _changed: int, _size: int) -> Any:
    """Returns the content of a file, which is parsed again if its time or its size changes."""
    return OmegaConf.to_container(OmegaConf.create(file.read_text(encoding="utf-8")))
