"""Communication between UAVs: the transform, its base class, and a module per method."""

from typing import TYPE_CHECKING

from emberlink.envs.utils.lazy import lazy

if TYPE_CHECKING:
    from emberlink.comm.base import CommModule, Communication
    from emberlink.comm.registry import build, find, known

__all__ = ["CommModule", "Communication", "build", "find", "known"]

__getattr__ = lazy(
    __name__,
    {
        "CommModule": "base",
        "Communication": "base",
        "build": "registry",
        "find": "registry",
        "known": "registry",
    },
)
