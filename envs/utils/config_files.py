"""Finds and reads YAML files of configuration groups."""

from pathlib import Path
from typing import Any

from emberlink.configs import folders, known
from emberlink.envs.utils.errors import UserError, unknown


def find(group: str, name: str) -> Path:
    """Returns the path of a configuration file.

    Args:
        group: name of the group, such as "method", "setup", "setup_method" or "fire".
        name: name of the file without `.yaml`.

    Raises:
        UserError: there is no such file, or several folders have one.
    """
    searched = folders()
    files = [file for folder in searched if (file := folder / group / f"{name}.yaml").is_file()]
    if not files:
        raise UserError(f"{group} {unknown(name, known(group))}")
    if len(files) > 1:
        raise UserError(f"{group} {name!r} is in several folders: {', '.join(map(str, files))}")
    return files[0]


def read(group: str, name: str) -> dict[str, Any]:
    """Returns the content of a configuration file.

    Raises:
        UserError: there is no such file, or it does not hold keys and values.
    """
    from omegaconf import OmegaConf  # imported here, since `find` answers a mistyped name at once

    file = find(group, name)
    try:
        values: Any = OmegaConf.to_container(OmegaConf.load(file))
    except Exception as error:  # of the file, YAML or OmegaConf
        raise UserError(f"{file}: cannot be read: {' '.join(str(error).split())[:200]}") from None
    if not isinstance(values, dict):
        raise UserError(f"{file}: expected keys and values")
    return values
