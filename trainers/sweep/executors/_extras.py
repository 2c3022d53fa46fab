"""Imports the packages of executors, which are extras of emberlink."""

from importlib import import_module
from importlib.util import find_spec
from typing import Any

from emberlink.envs.utils.errors import UserError, how_to_install


def require(executor: str, package: str, extra: str) -> None:
    """Checks that a package is installed.

    Args:
        executor: name of the executor that needs it.
        package: name of the package.
        extra: the extra of emberlink that installs it.

    Raises:
        UserError: it is not installed; the message says how to install it.
    """
    if find_spec(package) is None:
        raise UserError(f"executor={executor}: {package} is not installed: {how_to_install(extra)}")


def load(name: str) -> Any:
    """Returns a module of such a package; type checkers do not need the package."""
    return import_module(name)
