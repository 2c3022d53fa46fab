"""General utilities: errors, validation, random numbers, files, plugins and buffers."""

from emberlink.envs.utils.errors import UserError

__all__ = ["UserError"]
