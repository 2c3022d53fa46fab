"""Versions of the packages that a number depends on."""

import platform
from collections.abc import Mapping
from functools import cache
from importlib.metadata import version

_PACKAGES = ("emberlink", "torch", "torchrl", "tensordict", "numpy")


def versions() -> dict[str, str]:
    """Returns the installed version of each package that a training's numbers depend on."""
    return dict(_installed())


@cache
def _installed() -> dict[str, str]:
    # Looking up a version takes 40 ms; a training asks at each checkpoint.
    installed = {name: version(name) for name in _PACKAGES}
    return installed | {"python": platform.python_version()}


def changed(before: Mapping[str, str]) -> str:
    """Describes the packages whose version has changed; an empty text if there are none.

    Args:
        before: what `versions` returned.
    """
    now = versions()
    return ", ".join(
        f"{name} {old} (now {now.get(name, 'not installed')})"
        for name, old in before.items()
        if now.get(name) != old
    )
