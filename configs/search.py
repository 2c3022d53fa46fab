"""Finds the YAML files of configuration groups of emberlink, other packages and the user.

A group is a folder such as `method` or `fire`. Each file in it is a choice of the group.
"""

import os
import re
import warnings
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from emberlink.configs import entry_points

VARIABLE = "EMBERLINK_CONFIGS"
"""environment variable with folders of groups, separated as in PATH"""
ENTRY_POINTS = "emberlink.configs"
"""group of entry points; each names a package whose folder holds groups"""


def folders() -> list[Path]:
    """Returns the folders of groups: those in `VARIABLE`, of other packages, and of emberlink.

    Folders that do not exist are ignored, as in PATH. For an entry point whose package does not
    exist, there is a warning.
    """
    listed = [Path(text) for text in os.environ.get(VARIABLE, "").split(os.pathsep) if text]
    plugins = [path for point in entry_points.read(ENTRY_POINTS) for path in _package(point.value)]
    every = [path.resolve() for path in (*listed, *plugins, Path(__file__).parent)]
    return [path for path in dict.fromkeys(every) if path.is_dir()]


def known(group: str, within: Sequence[Path] | None = None) -> list[str]:
    """Returns the choices of a group in alphabetical order.

    Args:
        group: name of the group, such as "method", "setup", "setup_method" or "fire".
        within: folders to search; `folders()` if None.
    """
    searched = folders() if within is None else within
    files = (file for folder in searched for file in (folder / group).glob("*.yaml"))
    return sorted({file.stem for file in files if file.is_file()})


def describe(group: str, name: str) -> str:
    """Returns the first sentence of the comment at the beginning of a choice's file.

    Args:
        group: name of the group.
        name: a choice in `known(group)`.

    Returns:
        The sentence without its full stop; "" if the file does not begin with a comment.
    """
    file = next(path for folder in folders() if (path := folder / group / f"{name}.yaml").is_file())
    words: list[str] = []
    for line in file.read_text(encoding="utf-8", errors="replace").splitlines():
        if not line.startswith("#"):
            break
        if not line.startswith("# @package"):
            words += line.lstrip("# ").split()
    text = "".join(c for c in " ".join(words) if c.isprintable())
    return re.split(r"\.(?= |$)", text, maxsplit=1)[0]


def _package(name: str) -> list[Path]:
    """Returns the folders of a package, without importing it; its parents are imported."""
    spec, why = None, f"there is no package {name}"
    try:
        spec = find_spec(name)
    except Exception as error:  # of the parents' code
        why += f" ({type(error).__name__}: {error})"
    if spec is None or not spec.submodule_search_locations:
        warnings.warn(f"entry point of {ENTRY_POINTS}: {why}", stacklevel=4)
        return []
    return [Path(folder) for folder in spec.submodule_search_locations]
