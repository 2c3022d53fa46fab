"""Small tools without knowledge of fires: errors, validation, random numbers, files, buffers."""

from emberlink.envs.utils.errors import UserError

__all__ = ["UserError"]
