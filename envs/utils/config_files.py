"""Finds and reads YAML files: each is a choice of a group, a folder such as `method` or `fire`."""

import os
import re
import sys
import warnings
from contextlib import suppress
from copy import deepcopy
from functools import lru_cache
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from emberlink import configs
from emberlink.envs.utils.atomic_io import user_path
from emberlink.envs.utils.errors import UserError, naming, unknown

PACKAGES = "emberlink.configs"
"""group of entry points; each names a package whose folder holds groups"""


def entry_points(group: str) -> metadata.EntryPoints:
    """Returns the entry points of a group, such as "emberlink.comm"."""
    return _entry_points(group, tuple(sys.path))


@lru_cache(maxsize=64)
def _entry_points(group: str, _: tuple[str, ...]) -> metadata.EntryPoints:
    """Reads the entry points, which takes 20 ms; an evaluation asks a hundred times."""
    return metadata.entry_points(group=group)


def folders() -> list[Path]:
    """Returns the folders of groups: of EMBERLINK_CONFIGS, other packages, emberlink."""
    given = os.environ.get("EMBERLINK_CONFIGS", "").split(os.pathsep)  # as in PATH
    listed = [user_path(text) for text in given if text]
    plugins = [path for point in entry_points(PACKAGES) for path in _package(point.value)]
    every = [path.resolve() for path in (*listed, *plugins, Path(str(configs.__file__)).parent)]
    return [path for path in dict.fromkeys(every) if path.is_dir()]


def _package(name: str) -> list[Path]:
    """Returns the folders of a package, without importing it; warns if there is none."""
    spec = None
    with suppress(Exception):  # of the code of its parents, which are imported
        spec = find_spec(name)
    if spec is None or not spec.submodule_search_locations:
        warnings.warn(f"entry point of {PACKAGES}: there is no package {name}", stacklevel=4)
        return []
    return [Path(folder) for folder in spec.submodule_search_locations]


def known(group: str) -> list[str]:
    """Returns the choices of a group, such as "method" or "fire", in alphabetical order."""
    files = (file for folder in folders() for file in (folder / group).glob("*.yaml"))
    return sorted({file.stem for file in files if file.is_file()})


def find(group: str, name: str) -> Path:
    """Returns the file of a choice of a group, such as "tuned" of "setup"."""
    files = [file for folder in folders() if (file := folder / group / f"{name}.yaml").is_file()]
    if not files:
        raise UserError(f"{group} {unknown(name, known(group))}")
    if len(files) > 1:
        raise UserError(f"{group} {name!r} is in several folders: {', '.join(map(str, files))}")
    return files[0]


def summary(group: str, name: str) -> str:
    """Returns the first sentence of the comment at the beginning of a file, or ""."""
    text = find(group, name).read_text(encoding="utf-8", errors="replace")
    (comment,) = re.findall(r"\A(?:# @package.*\n)?((?:#.*\n)*)", text)
    words = "".join(c for c in " ".join(comment.replace("#", " ").split()) if c.isprintable())
    return re.split(r"\.(?= |$)", words, maxsplit=1)[0]


def read(group: str, name: str) -> dict[str, Any]:
    """Returns the content of a configuration file, without the files in its `defaults`."""
    file = find(group, name)
    with naming(file, Exception):  # of the file, YAML or OmegaConf
        values = deepcopy(_content(file, file.stat().st_mtime_ns))
        if not isinstance(values, dict):
            raise UserError("expected keys and values")
        return values


@lru_cache(maxsize=256)
def _content(file: Path, _: int) -> Any:
    """Reads a file once per modification: each composition asks for its learner's keys."""
    from omegaconf import OmegaConf  # imported here, since `find` answers a mistyped name at once

    return OmegaConf.to_container(OmegaConf.load(file))
