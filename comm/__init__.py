"""Communication modules: one file per method, and the transform that adds one to an environment."""

from emberlink.comm.base import CommModule

__all__ = ["CommModule"]
